"""A part that stands in the wrong place is put where most points say; one that stands right stays."""

import copy
import itertools
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from two_parts import make_two_parts

from corrsfm.reconstruction import joining, mending, parts
from corrsfm.reconstruction.agreement import relative_pose_differences_deg
from corrsfm.reconstruction.best_model import select_model
from corrsfm.reconstruction.budget import policy_for
from corrsfm.reconstruction.explained import Explained, ExplainedPair
from corrsfm.reconstruction.joining import join_models
from corrsfm.reconstruction.mending import Mender
from corrsfm.reconstruction.parts import put_together_again, weak_links
from corrsfm.reconstruction.pool import CandidatePool
from corrsfm.reconstruction.verdict import Grade
from corrsfm.reconstruction.views import views_of
from corrsfm.types import Pair

NEXT_TO = (range(0, 50, 10), range(50, 100, 10))
SIDE_BY_SIDE = (range(0, 50, 10), range(5, 55, 10))
LEFT, RIGHT = ("a", "b", "c", "d"), ("w", "x", "y")


def explained(counts: Mapping[Pair, tuple[int, int]]) -> Explained:
    """What a model explains, from verified and explained matches of pairs."""
    pairs = tuple(
        ExplainedPair(name0=pair[0], name1=pair[1], num_verified=num, num_explained=held, is_registered=True)
        for pair, (num, held) in sorted(counts.items())
    )
    return Explained(pairs=pairs, registered=tuple(sorted({name for pair in counts for name in pair})))


def within(part: tuple[str, ...], num: int = 200) -> dict[Pair, tuple[int, int]]:
    return {(one, two): (num, num) for i, one in enumerate(part) for two in part[i + 1 :]}


def test_parts_that_a_weak_pair_holds_together_are_named() -> None:
    (link,) = weak_links(explained({**within(LEFT), **within(RIGHT), ("a", "w"): (30, 25)}))
    assert (link.part0, link.part1) == (LEFT, RIGHT)
    assert link.strength == pytest.approx(25 / 200)


def test_parts_whose_pairs_all_contradict_the_model_are_held_by_nothing() -> None:
    (link,) = weak_links(explained({**within(LEFT), **within(RIGHT), ("a", "w"): (300, 40)}))
    assert (link.part0, link.part1, link.strength) == (LEFT, RIGHT, 0.0)


@pytest.mark.parametrize("across", [{("a", "w"): (90, 85)}, {("a", "w"): (60, 60), ("b", "y"): (80, 70)}])
def test_parts_that_are_held_as_their_photos_are_stay_one(across: dict[Pair, tuple[int, int]]) -> None:
    assert not weak_links(explained({**within(LEFT), **within(RIGHT), **across}))


def test_two_photos_are_no_part() -> None:
    assert not weak_links(explained({**within(LEFT), **within(RIGHT[:2]), ("a", "w"): (20, 20)}))


def test_the_weakest_link_comes_first_and_a_part_may_have_parts() -> None:
    others = ("m", "n", "o")
    links = weak_links(
        explained({
            **within(LEFT), **within(RIGHT), **within(others), ("a", "w"): (50, 50), ("c", "m"): (20, 20),
        })
    )  # fmt: skip
    assert [link.part1 for link in links] == [others, RIGHT]
    assert links[0].part0 == (*LEFT, *RIGHT) and links[1].part0 == LEFT


def as_one(a: pycolmap.Reconstruction, b: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The photos and points of b put into a where they stand in their own frame."""
    whole = pycolmap.Reconstruction(a)
    for image_id, image in sorted(b.images.items()):
        if image.has_pose:
            frame = whole.frames[whole.images[image_id].frame_id]
            frame.set_cam_from_world(image.camera_id, image.cam_from_world())
            whole.register_frame(frame.frame_id)
    for _, point in sorted(b.points3D.items()):
        whole.add_point3D(point.xyz, point.track, point.color)
    return whole


def test_a_part_in_the_wrong_place_is_put_where_few_matches_of_many_pairs_say(tmp_path: Path) -> None:
    made = make_two_parts(
        tmp_path / "d.db", angles_deg=NEXT_TO, num_common_points=40, num_cross_matches=4, num_false_matches=8
    )
    wrong = as_one(*made.models)
    before = views_of(wrong)
    again = put_together_again(wrong, made.evidence.explain(before), made.database, made.evidence)
    assert again is not None
    assert relative_pose_differences_deg(views_of(again), views_of(made.truth)).max() < 0.6
    assert views_of(wrong).keys() == before.keys()
    assert all((views_of(wrong)[name].rotation == view.rotation).all() for name, view in before.items())


def test_a_part_where_most_verified_matches_across_say_is_not_moved(tmp_path: Path) -> None:
    made = make_two_parts(tmp_path / "d.db", angles_deg=NEXT_TO, num_common_points=60)
    model = as_one(*made.models)
    found = made.evidence.explain(views_of(model))
    held = ExplainedPair(
        name0="a4.jpg", name1="b0.jpg", num_verified=20, num_explained=12, is_registered=True
    )
    holding = Explained(pairs=(*found.pairs, held), registered=found.registered)
    assert weak_links(holding)
    assert put_together_again(model, holding, made.database, made.evidence) is None
    assert put_together_again(model, found, made.database, made.evidence) is not None


def with_a_camera_each(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The same model with a camera for each photo; only the first has the one of the database."""
    camera_ids = {
        image_id: image_id if image_id == 1 else 100 + image_id for image_id in sorted(model.images)
    }
    separate = pycolmap.Reconstruction()
    for camera_id in camera_ids.values():
        camera = copy.deepcopy(model.cameras[1])
        camera.camera_id = camera_id
        separate.add_camera_with_trivial_rig(camera)
    for image_id, image in sorted(model.images.items()):
        keypoints = np.array([point.xy for point in image.points2D])
        own = pycolmap.Image(
            name=image.name, keypoints=keypoints, camera_id=camera_ids[image_id], image_id=image_id
        )
        separate.add_image_with_trivial_frame(own, image.cam_from_world())
    for _, point in sorted(model.points3D.items()):
        separate.add_point3D(point.xyz, point.track, point.color)
    return separate


def test_photos_with_cameras_of_their_own_of_which_one_is_in_no_part(tmp_path: Path) -> None:
    made = make_two_parts(
        tmp_path / "d.db", angles_deg=(range(0, 60, 10), range(60, 110, 10)), num_common_points=60
    )
    model = with_a_camera_each(as_one(*made.models))
    found = made.evidence.explain(views_of(model))
    pairs = tuple(pair for pair in found.pairs if "a5.jpg" not in (pair.name0, pair.name1))
    again = put_together_again(
        model, Explained(pairs=pairs, registered=found.registered), made.database, made.evidence
    )
    assert again is not None and len(views_of(again)) == 10
    assert relative_pose_differences_deg(views_of(again), views_of(made.truth)).max() < 2.0


def test_a_place_that_gives_impossible_cameras_is_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = make_two_parts(tmp_path / "d.db", angles_deg=NEXT_TO, num_common_points=60)

    def refine(model: pycolmap.Reconstruction, options: object) -> None:
        model.cameras[1].params = [-3.0, *model.cameras[1].params[1:]]

    monkeypatch.setattr(joining, "refine", refine)
    model = as_one(*made.models)
    found = made.evidence.explain(views_of(model))
    assert put_together_again(model, found, made.database, made.evidence) is None
    _, (attempt,) = join_models(made.models, made.database, made.evidence)
    assert not attempt.is_joined and "a camera that cannot be" in attempt.reason


def test_a_few_predicted_matches_more_are_no_reason_to_move_a_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = make_two_parts(tmp_path / "d.db", angles_deg=NEXT_TO, num_common_points=60)
    model = as_one(*made.models)
    found = made.evidence.explain(views_of(model))
    monkeypatch.setattr(made.evidence, "predicted", lambda views, pairs=None: {})
    assert put_together_again(model, found, made.database, made.evidence) is None


def test_a_part_of_a_part_is_moved_and_what_stood_right_stays(tmp_path: Path) -> None:
    made = make_two_parts(
        tmp_path / "d.db", angles_deg=(range(0, 60, 10), range(60, 160, 10)), num_common_points=60
    )
    (right,), _ = join_models(made.models, made.database, made.evidence)
    far = tuple(f"b{number}.jpg" for number in (7, 8, 9))
    rest = pycolmap.Reconstruction(right)
    moved = pycolmap.Reconstruction(right)
    for image in list(right.images.values()):
        (rest if image.name in far else moved).deregister_frame(image.frame_id)
    moved.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(np.array([0.0, 1.2, 0.0])), [2.0, 0.0, 1.0]))
    wrong = as_one(rest, moved)
    for pair in list(made.evidence.verified):
        if (pair[0] in far) != (pair[1] in far):
            del made.evidence.verified[pair]
    links = [len(link.part1) for link in weak_links(made.evidence.explain(views_of(wrong)))]
    assert links == [3, 6]
    again = put_together_again(wrong, made.evidence.explain(views_of(wrong)), made.database, made.evidence)
    assert again is not None and len(views_of(again)) == 16
    assert relative_pose_differences_deg(views_of(again), views_of(made.truth)).max() < 1.0


def test_no_other_place_is_tried_once_the_time_is_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = make_two_parts(tmp_path / "d.db", angles_deg=NEXT_TO, num_common_points=60)
    model = as_one(*made.models)
    clock = itertools.count(step=10)
    monkeypatch.setattr(parts, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    found = made.evidence.explain(views_of(model))
    given = model, found, made.database, made.evidence
    assert put_together_again(*given, max_runtime_seconds=5) is None
    assert put_together_again(*given) is not None


def test_a_first_model_with_a_part_in_the_wrong_place_is_mended_and_nothing_else_is_mapped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = make_two_parts(tmp_path / "d.db", angles_deg=NEXT_TO, num_common_points=60)
    monkeypatch.setattr(CandidatePool, "map", lambda *_, **__: pytest.fail("mapped a candidate"))
    selected = select_model(
        as_one(*made.models), made.evidence, made.database, tmp_path / "work",
        policy=policy_for(8, 1.0), first_seconds=1.0,
    )  # fmt: skip
    assert selected is not None and selected.choice.chosen.name == "first+mended"
    assert [model.name for model in selected.choice.tried] == ["first", "first+mended"]
    assert relative_pose_differences_deg(views_of(selected.model), views_of(made.truth)).max() < 0.6
    assert selected.verdict.grade is Grade.GOOD


def test_parts_in_their_right_places_stay(tmp_path: Path) -> None:
    made = make_two_parts(tmp_path / "d.db", angles_deg=NEXT_TO, num_common_points=60)
    (right,), _ = join_models(made.models, made.database, made.evidence)
    found = made.evidence.explain(views_of(right))
    assert weak_links(found)
    assert put_together_again(right, found, made.database, made.evidence) is None


@pytest.mark.parametrize(("angles_deg", "num_common"), [(NEXT_TO, 6), (SIDE_BY_SIDE, 100)])
def test_parts_stay_where_too_little_speaks_or_a_fold_would_come(
    angles_deg: tuple[range, range], num_common: int, tmp_path: Path
) -> None:
    made = make_two_parts(tmp_path / "d.db", angles_deg=angles_deg, num_common_points=num_common)
    model = as_one(*made.models)
    found = made.evidence.explain(views_of(model))
    assert weak_links(found)
    assert put_together_again(model, found, made.database, made.evidence) is None


def test_photos_that_fell_out_are_registered_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = make_two_parts(tmp_path / "d.db", angles_deg=(range(0, 60, 10), ()), num_common_points=80)
    (whole, _) = made.models
    without = pycolmap.Reconstruction(whole)
    without.deregister_frame(without.find_image_with_name("a5.jpg").frame_id)
    monkeypatch.setattr(mending, "put_together_again", lambda *_, **__: without)
    mender = Mender(made.evidence, made.database, tmp_path / "work")
    mended = mender.put_parts(whole, made.evidence.explain(views_of(whole)))
    assert mended is not None
    assert relative_pose_differences_deg(views_of(mended), views_of(made.truth)).max() < 0.6
    assert len(views_of(mended)) == 6
