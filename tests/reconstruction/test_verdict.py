"""What a verdict is drawn from, and that there always is one."""

import dataclasses
import math

import numpy as np
import pytest
from scene_of_points import bend, make_scene, turn

from corrsfm.reconstruction.explained import Explained, explain
from corrsfm.reconstruction.focal_slack import FocalSlack
from corrsfm.reconstruction.verdict import Evidence, Grade, judge, thickness

SCENE = make_scene()
GOOD = Evidence(num_photos=5, explained=explain(SCENE.views, SCENE.keypoints, SCENE.verified()))


def evidence_of(views, verified=None, num_photos: int = 5, **more) -> Evidence:
    verified = SCENE.verified() if verified is None else verified
    return Evidence(num_photos=num_photos, explained=explain(views, SCENE.keypoints, verified), **more)


def test_a_right_model_is_good_and_says_why() -> None:
    verdict = judge(GOOD)
    assert verdict.grade is Grade.GOOD
    assert str(verdict) == "good: 5 of 5 photos registered, 100 % of the verified matches explained"
    assert verdict.next_steps == ()


def test_the_agreement_of_another_candidate_speaks_for_a_model() -> None:
    verdict = judge(dataclasses.replace(GOOD, support=0.9))
    assert verdict.grade is Grade.GOOD
    assert verdict.reasons[-1] == "another candidate agrees about 90 % of the relative poses"


def test_a_good_model_with_a_lens_that_does_not_fit_says_how_to_make_it_exact() -> None:
    verdict = judge(dataclasses.replace(GOOD, lens_misfit=0.46))
    assert verdict.grade is Grade.GOOD
    assert "a richer lens model would take away 46 % of the squared errors" in str(verdict)
    assert verdict.next_steps == ("--camera-model OPENCV --refine-principal-point for more exact poses",)
    assert judge(dataclasses.replace(GOOD, lens_misfit=0.2)).next_steps == ()


def test_a_photo_in_the_wrong_place_is_named_and_so_are_its_pairs() -> None:
    verdict = judge(evidence_of({**SCENE.views, "2.jpg": bend(SCENE.views["2.jpg"], 15.0)}))
    assert verdict.grade is Grade.DOUBTFUL
    assert "many matches contradict the place of 2.jpg" in verdict.reasons
    assert any("4 of 10 verified pairs contradict it (" in reason for reason in verdict.reasons)
    assert all("2.jpg" in pair for reason in verdict.reasons if "contradict it (" in reason
               for pair in reason.partition("(")[2].split(", "))  # fmt: skip


def test_two_of_five_photos_in_the_wrong_place_are_wrong() -> None:
    places = {name: bend(SCENE.views[name], degrees) for name, degrees in (("1.jpg", 15.0), ("2.jpg", -15.0))}
    verdict = judge(evidence_of({**SCENE.views, **places}))
    assert verdict.grade is Grade.WRONG


def test_a_model_that_explains_a_part_of_every_pair_is_doubtful_although_no_pair_contradicts_it() -> None:
    verified = SCENE.verified()
    for matches in verified.values():
        matches[::5, 1] = np.roll(matches[::5, 1], 1)
    evidence = evidence_of(SCENE.views, verified)
    assert evidence.explained.contradicted == evidence.explained.misplaced == ()
    assert 0.8 <= evidence.explained.share_of_supported < 0.85
    verdict = judge(evidence)
    assert verdict.grade is Grade.DOUBTFUL
    assert len(verdict.reasons) == 1
    assert "of the matches of the pairs that agree with it" in verdict.reasons[0]


@pytest.mark.parametrize(
    ("change", "grade", "words"),
    [
        ({"num_photos": 6}, Grade.DOUBTFUL, "only 5 of 6 photos"),
        ({"num_photos": 50}, Grade.DOUBTFUL, "only 5 of 50 photos"),
        ({"support": 0.6}, Grade.DOUBTFUL, "agrees about 60 %"),
        ({"support": 0.0}, Grade.DOUBTFUL, "no other candidate comes near it"),
        ({"implausible_intrinsics": "a focal length of 12 m"}, Grade.WRONG, "a focal length of 12 m"),
        ({"is_folded": True, "conflicts": ["a – b"]}, Grade.WRONG, "(such as a – b)"),
        ({"thickness": 0.0}, Grade.DOUBTFUL, "one plane"),
        ({"focal_slack": FocalSlack(factor=1.02, pose_change_deg=1.4)}, Grade.DOUBTFUL, "2 % longer"),
        ({"focal_slack": FocalSlack(factor=1.2, pose_change_deg=0.7)}, Grade.DOUBTFUL, "20 % longer"),
    ],
)
def test_each_evidence_alone_lowers_the_grade(change: dict, grade: Grade, words: str) -> None:
    verdict = judge(dataclasses.replace(GOOD, **change))
    assert verdict.grade is grade
    assert words in verdict.reasons[0]
    assert len(verdict.reasons) == len(verdict.next_steps) == 1
    assert str(verdict) == f"{grade}: {verdict.reasons[0]}; try {verdict.next_steps[0]}"


@pytest.mark.parametrize(
    "change",
    [
        {"is_folded": False},
        {"is_folded": None},
        {"thickness": None},
        {"focal_slack": None},
        {"focal_slack": FocalSlack(factor=1.03, pose_change_deg=0.9)},
        {"focal_slack": FocalSlack(factor=1.2, pose_change_deg=0.5)},
        {"thickness": math.nan},
        {"thickness": 0.0, "has_prior_focal_lengths": True},
        {"support": None},
    ],
)
def test_no_evidence_leaves_the_grade(change: dict) -> None:
    assert judge(dataclasses.replace(GOOD, **change)).grade is Grade.GOOD


@pytest.mark.parametrize(
    ("could", "step"), [(True, "a larger --max-models-tried"), (False, "another --seed")]
)
def test_more_models_are_advised_only_where_there_are_more(could: bool, step: str) -> None:
    evidence = dataclasses.replace(evidence_of(SCENE.views), support=0.1, could_try_more=could)
    assert judge(evidence).next_steps == (f"{step}, or photos closer to each other",)


def test_the_gravest_reason_comes_first() -> None:
    verdict = judge(dataclasses.replace(GOOD, num_photos=6, thickness=0.0, is_folded=True))
    assert verdict.grade is Grade.WRONG
    assert "may be folded" in verdict.reasons[0]
    assert len(verdict.reasons) == 3


def test_a_scene_without_pairs_is_wrong() -> None:
    for views in ({}, SCENE.views):
        verdict = judge(evidence_of(views, {}))
        assert verdict.grade is Grade.WRONG
        assert "no pair of photos is verified" in verdict.reasons[0]
    assert judge(Evidence(num_photos=0, explained=Explained(pairs=(), registered=()))).grade is Grade.WRONG


def test_pairs_of_unregistered_photos_only_are_wrong() -> None:
    verdict = judge(evidence_of({}))
    assert verdict.grade is Grade.WRONG
    assert "only 0 of 5 photos are in the model" in verdict.reasons[0]


def test_two_photos_are_doubtful() -> None:
    names = ("0.jpg", "1.jpg")
    views = {name: SCENE.views[name] for name in names}
    verdict = judge(evidence_of(views, {names: SCENE.matches(names)}, num_photos=2))
    assert verdict.grade is Grade.DOUBTFUL
    assert verdict.reasons == ("two photos make a model that nothing checks",)


def test_a_camera_that_hardly_moved_is_doubtful() -> None:
    centre = SCENE.views["0.jpg"].centre
    still = {
        name: dataclasses.replace(view, translation=-view.rotation @ (centre + [0.01 * i, 0.0, 0.0]))
        for i, (name, view) in enumerate(SCENE.views.items())
    }
    keypoints = {}
    for name, view in still.items():
        in_camera = SCENE.points[SCENE.order[name]] @ view.rotation.T + view.translation
        keypoints[name] = in_camera[:, :2] / in_camera[:, 2:] * 500.0 + [320.0, 240.0]
    explained = explain(still, keypoints, SCENE.verified())
    assert explained.share == 1.0
    verdict = judge(Evidence(num_photos=5, explained=explained))
    assert verdict.grade is Grade.DOUBTFUL
    assert "the camera hardly moved" in verdict.reasons[0]


def test_a_camera_that_only_turned_is_wrong() -> None:
    turned = {
        name: dataclasses.replace(view, rotation=turn("y", 10.0 * i), translation=np.zeros(3))
        for i, (name, view) in enumerate(SCENE.views.items())
    }
    verdict = judge(evidence_of(turned))
    assert verdict.grade is Grade.WRONG


def test_a_photo_held_by_one_pair_is_named() -> None:
    verified = {pair: matches for pair, matches in SCENE.verified().items() if "3.jpg" not in pair}
    verified["2.jpg", "3.jpg"] = SCENE.matches(("2.jpg", "3.jpg"))
    verdict = judge(evidence_of(SCENE.views, verified))
    assert (verdict.grade, verdict.reasons) == (Grade.DOUBTFUL, ("held by one pair only: 3.jpg",))


def test_an_impossible_focal_length_gives_a_verdict() -> None:
    broken = {}
    for name, view in SCENE.views.items():
        camera = dataclasses.replace(view.camera, params=(1e-9 if name == "1.jpg" else 1e12, 320.0, 240.0))
        broken[name] = dataclasses.replace(view, camera=camera)
    verdict = judge(evidence_of(broken, implausible_intrinsics="focal lengths from 1e-12 to 1e+09"))
    assert verdict.grade is Grade.WRONG
    assert "nan" not in str(verdict)


def test_matches_on_a_plane_give_a_verdict() -> None:
    flat = make_scene(flat=True)
    explained = explain(flat.views, flat.keypoints, flat.verified())
    assert judge(Evidence(num_photos=5, explained=explained, thickness=0.0)).grade is Grade.DOUBTFUL
    assert judge(Evidence(num_photos=5, explained=explained, thickness=0.1)).grade is Grade.GOOD


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_thickness_is_a_ratio_that_outliers_do_not_change(scale: float) -> None:
    generator = np.random.default_rng(0)
    points = generator.uniform(-1.0, 1.0, (2000, 3)) * [1.0, 1.0, 0.05] @ turn("x", 35.0)
    points[::50] *= 1000.0
    assert thickness(scale * points) == pytest.approx(0.05, rel=0.1)


def test_points_on_a_plane_have_no_thickness() -> None:
    flat = make_scene(flat=True)
    assert thickness(flat.points @ turn("x", 35.0)) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    "points", [np.zeros((0, 3)), np.ones((9, 3)), np.ones((20, 3)), np.full((20, 3), np.nan)]
)
def test_points_without_extent_have_no_thickness_to_tell(points: np.ndarray) -> None:
    assert thickness(points) is None


def test_shares_are_rounded_down() -> None:
    verdict = judge(dataclasses.replace(GOOD, support=0.79999))
    assert "79.9 %" in verdict.reasons[0]
