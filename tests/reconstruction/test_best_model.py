"""The first model stays if it convinces; a bent one gives way to the true one, and the record says why."""

import dataclasses
import itertools
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pycolmap
import pytest
from synthetic_database import synthesize

from corrsfm.colmap.pairs import read_verified_matches
from corrsfm.reconstruction import best_model, budget, unfolding
from corrsfm.reconstruction.agreement import agreement
from corrsfm.reconstruction.best_model import Selection, select_model
from corrsfm.reconstruction.budget import policy_for
from corrsfm.reconstruction.calibration import Refinement
from corrsfm.reconstruction.candidates import (
    Candidate,
    MapperKind,
    StartingCameras,
    change_cameras,
    map_candidate,
)
from corrsfm.reconstruction.choice import Tried
from corrsfm.reconstruction.record import record_of
from corrsfm.reconstruction.scene_evidence import SceneEvidence
from corrsfm.reconstruction.verdict import Grade
from corrsfm.reconstruction.views import views_of
from corrsfm.types import Features


class Scene:
    """A synthesized database with descriptors: photos that see a point describe it alike."""

    def __init__(self, folder: Path) -> None:
        self.database = folder / "database.db"
        self.workdir = folder / "candidates"
        self.truth = synthesize(self.database)
        self.loaded: list[str] = []
        prints = np.random.default_rng(0).integers(0, 256, (1 + max(self.truth.points3D), 128))
        self._features = {}
        for image in self.truth.images.values():
            ids = [point.point3D_id if point.has_point3D() else 0 for point in image.points2D]
            num = len(ids)
            self._features[image.name] = Features(
                keypoints=np.array([point.xy for point in image.points2D], np.float32),
                scales=np.ones(num, np.float32),
                orientations=np.zeros(num, np.float32),
                scores=np.ones(num, np.float32),
                descriptors=prints[ids].astype(np.uint8),
                image_size=(image.camera.width, image.camera.height),
            )
        self.evidence = SceneEvidence(
            list(self._features), read_verified_matches(self.database), self._features.__getitem__
        )

    def select(self, first: pycolmap.Reconstruction | None, **options: object) -> Selection | None:
        return select_model(
            first,
            self.evidence,
            self.database,
            self.workdir,
            policy=policy_for(8, 1.0),
            first_seconds=1.0,
            **options,  # type: ignore[arg-type]
        )


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path)


def bent(truth: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The true model with one photo turned away by 20 degrees."""
    model = pycolmap.Reconstruction(truth)
    image = min(model.images.values(), key=lambda image: image.name)
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, np.radians(20), 0.0])), np.zeros(3))
    image.frame.set_cam_from_world(image.camera_id, turn * image.cam_from_world())
    return model


def test_a_first_model_that_convinces_stays_and_nothing_else_is_mapped(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(best_model.CandidatePool, "map", lambda *_, **__: pytest.fail("mapped a candidate"))
    selected = scene.select(scene.truth)
    assert selected is not None and selected.model is scene.truth
    assert selected.verdict.grade is Grade.GOOD
    assert selected.choice.chosen.num_predicted is None
    assert selected.left_out == ()


def test_a_bent_first_model_gives_way_to_one_that_predicts_more(scene: Scene) -> None:
    first = bent(scene.truth)
    assert agreement(views_of(scene.truth), views_of(first)).share < 0.8
    selected = scene.select(first)
    assert selected is not None
    common = agreement(views_of(scene.truth), views_of(selected.model))
    assert (common.num_photos, common.share) == (8, 1.0)
    tried = selected.choice.tried
    assert tried[0].name == "first" and tried[0].explained.misplaced
    assert (selected.choice.chosen.num_predicted or 0) > (tried[0].num_predicted or 0) > 0


def test_a_candidate_stands_in_for_a_first_model_that_did_not_come(scene: Scene) -> None:
    selected = scene.select(None)
    assert selected is not None
    assert agreement(views_of(scene.truth), views_of(selected.model)).share == 1.0


def test_all_that_the_round_of_a_stand_in_mapped_is_chosen_from(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    rounds = [[None, bent(scene.truth), scene.truth]]
    monkeypatch.setattr(
        best_model.CandidatePool,
        "map",
        lambda _, bank, **__: rounds.pop() if rounds else [None] * len(bank),
    )
    monkeypatch.setattr(best_model.CandidatePool, "seconds", lambda *_: 0.1)
    selected = scene.select(None, unfold=False)
    assert selected is not None
    assert selected.model is scene.truth


def test_all_attempts_to_unfold_share_half_of_the_time_for_other_models(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = itertools.count(start=0, step=10)
    monkeypatch.setattr(budget, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    bounds, outcomes = [], []

    def map_candidate(*given: object, max_runtime_seconds: int, **more: object) -> pycolmap.Reconstruction:
        bounds.append(max_runtime_seconds)
        return scene.truth

    def try_unfolding(first: object, verified: object, map_without: Any, *, rules: object) -> list:
        outcomes.extend(map_without([]) for _ in range(7))
        return []

    monkeypatch.setattr(unfolding, "map_candidate", map_candidate)
    monkeypatch.setattr(unfolding, "try_unfolding", try_unfolding)
    assert scene.select(scene.truth) is not None
    # Three steps of the clock went to looking for parts in the wrong place.
    half = round((policy_for(8, 1.0).max_time_factor + 1 - 30) / 2)
    assert bounds == list(range(half, 0, -10))
    assert outcomes == [scene.truth] * len(bounds) + [None] * (7 - len(bounds))
    assert 0 < len(bounds) < 7


def test_candidates_hold_intrinsics_as_the_first_model_did(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    mappers = []
    for name in ("incremental_mapping", "global_mapping"):
        original = getattr(pycolmap, name)

        def spy(*arguments: Any, original: Any = original, **options: Any) -> object:
            mappers.append(arguments[3])
            return original(*arguments, **options)

        monkeypatch.setattr(pycolmap, name, spy)
    scene.select(bent(scene.truth), refinement=Refinement(intrinsics=False, principal_point=True))
    assert len(mappers) > 2
    for options in mappers:
        if isinstance(options, pycolmap.GlobalPipelineOptions):
            adjustment = options.mapper.bundle_adjustment
            assert not adjustment.refine_focal_length and adjustment.refine_principal_point
        else:
            assert not options.ba_refine_focal_length and options.ba_refine_principal_point


def test_a_model_with_a_camera_for_each_photo_gives_way_to_one_that_predicts_as_much(
    scene: Scene, tmp_path: Path
) -> None:
    change_cameras(scene.database, StartingCameras.SEPARATE)
    first = map_candidate(Candidate(mapper=MapperKind.INCREMENTAL), scene.database, tmp_path / "first")
    assert first is not None
    alone = scene.select(first)
    assert alone is not None and alone.model is first
    # Photos of as many sizes are taken for those of as many people.
    several = pycolmap.Reconstruction(first)
    for number, camera in enumerate(several.cameras.values()):
        camera.width += 2 * number
    kept = scene.select(several, cameras_on_trial=StartingCameras.SHARED)
    assert kept is not None and kept.model is several
    selected = scene.select(first, cameras_on_trial=StartingCameras.SHARED)
    assert selected is not None and selected.cameras is StartingCameras.SHARED
    assert len({image.camera_id for image in selected.model.images.values()}) == 1
    assert "one camera for all photos" in record_of(selected, scene.evidence)["camera_remark"]
    assert record_of(alone, scene.evidence)["camera_remark"] == ""
    assert agreement(views_of(scene.truth), views_of(selected.model)).share == 1.0


def test_nothing_is_selected_where_nothing_can_be_mapped(scene: Scene) -> None:
    with pycolmap.Database.open(scene.database) as database:
        database.clear_two_view_geometries()
    assert scene.select(None) is None


def test_candidates_of_an_interrupted_choice_are_not_mapped_again(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene.select(bent(scene.truth))
    finished = {path.parent.name for path in scene.workdir.glob("*/candidate.json")}
    assert finished
    mapped: list[str] = []
    original = pycolmap.incremental_mapping

    def spy(*arguments: object, **options: object) -> object:
        mapped.append(str(arguments[2]))
        return original(*arguments, **options)

    monkeypatch.setattr(pycolmap, "incremental_mapping", spy)
    scene.select(bent(scene.truth))
    assert not [path for path in mapped if Path(path).parent.name in finished]


def test_the_record_is_plain_and_tells_the_choice(scene: Scene) -> None:
    selected = scene.select(bent(scene.truth))
    assert selected is not None
    record = json.loads(json.dumps(record_of(selected, scene.evidence), allow_nan=False))
    assert record["verdict"]["grade"] == str(selected.verdict.grade)
    assert [model["chosen"] for model in record["models_tried"]].count(True) == 1
    assert record["num_predicted_matches"] == selected.choice.chosen.num_predicted
    assert len(record["pairs"]) == len(scene.evidence.verified)
    assert record["folds"]["left_out"] == []


def test_the_record_tells_which_matches_of_contradicted_pairs_are_explained(scene: Scene) -> None:
    views = views_of(bent(scene.truth))
    explained = scene.evidence.explain(views)
    chosen = Tried(name="bent", way="incremental", views=views, explained=explained, seconds=1.0)
    selected = scene.select(None)
    assert selected is not None and explained.contradicted
    choice = dataclasses.replace(selected.choice, chosen=chosen)
    record = record_of(dataclasses.replace(selected, choice=choice), scene.evidence)
    for pair in record["contradicted_pairs"][:12]:
        assert len(pair["explained_matches"]) == pair["num_verified"]
        assert pair["explained_matches"].count("1") == pair["num_explained"]
    assert not any("explained_matches" in pair for pair in record["contradicted_pairs"][12:])
