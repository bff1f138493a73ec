"""Focal lengths that made-up pairs of known cameras vote for."""

import itertools

import cv2  # noqa: F401
import numpy as np
import pytest

from corrsfm.database.focal_evidence import CANDIDATE_RATIOS, PairPoints, misfit, mode_of_votes, weigh_pair
from corrsfm.database.focal_votes import (
    FocalVotes,
    VoteDecision,
    count_votes,
    pairs_that_vote,
)

SIDE_PX = 1000.0


def rotation_about(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def make_photos(
    focals_px: list[float],
    *,
    seed: int = 0,
    num_points: int = 90,
    num_wrong: int = 15,
    depth: float = 3.0,
    translation: float = 1.5,
    around: bool = False,
) -> list[PairPoints]:
    """All pairs of photos of random points, with 0.3 px of noise and some wrong matches.

    ``around``: the cameras stand on a circle and look at its centre.
    """
    generator = np.random.default_rng(seed)
    points = generator.uniform([-2, -1.5, 6], [2, 1.5, 6 + depth], (num_points, 3))
    images = []
    for number, focal_px in enumerate(focals_px):
        if around:
            turn = rotation_about(np.array([0.0, 1.0, 0.0]), 0.15 * number)
            centre = np.array([0.0, 0.0, 7.5])
            in_camera = (points - centre) @ turn.T + centre
        else:
            turn = rotation_about(generator.normal(size=3), generator.uniform(0.1, 0.3))
            in_camera = (points - generator.uniform(-translation, translation, 3)) @ turn.T
        pixels = focal_px * in_camera[:, :2] / in_camera[:, 2:]
        images.append(pixels + generator.normal(0, 0.3, pixels.shape))
    pairs = []
    for i, j in itertools.combinations(range(len(images)), 2):
        wrong = generator.uniform(-400, 400, (2, num_wrong, 2))
        pairs.append(
            PairPoints(
                name0=f"{i:02}.jpg",
                name1=f"{j:02}.jpg",
                points0_px=np.vstack([images[i], wrong[0]]),
                points1_px=np.vstack([images[j], wrong[1]]),
            )
        )
    return pairs


@pytest.fixture(scope="module")
def one_camera() -> list[PairPoints]:
    return make_photos([800.0] * 6)


@pytest.fixture(scope="module")
def votes_of_one(one_camera: list[PairPoints]) -> FocalVotes:
    return count_votes(one_camera, SIDE_PX)


def test_photos_of_one_camera_vote_for_its_focal_length(votes_of_one: FocalVotes) -> None:
    assert votes_of_one.decision is VoteDecision.DECIDED
    assert votes_of_one.focal_px == pytest.approx(800, rel=0.03)
    assert votes_of_one.focal_ratio == votes_of_one.focal_px / SIDE_PX
    assert votes_of_one.mode_ratio == pytest.approx(0.8, rel=0.03)
    assert votes_of_one.num_votes == 15
    assert votes_of_one.agreement > 0.9
    low, high = votes_of_one.range_ratios
    assert low <= 0.82 and high >= 0.78 and high < 1.25 * low
    assert votes_of_one.groups == ()


def test_the_same_pairs_in_another_order_give_the_same_votes(
    one_camera: list[PairPoints], votes_of_one: FocalVotes
) -> None:
    assert count_votes(one_camera[::-1], SIDE_PX) == votes_of_one
    assert count_votes(one_camera, SIDE_PX, num_threads=3) == votes_of_one


def test_without_pairs_nothing_is_decided() -> None:
    votes = count_votes([], SIDE_PX)
    assert votes.decision is VoteDecision.UNDECIDED
    assert votes.num_votes == 0
    assert np.isnan(votes.focal_px)


def test_one_pair_is_too_few(one_camera: list[PairPoints]) -> None:
    assert count_votes(one_camera[:1], SIDE_PX).decision is VoteDecision.UNDECIDED


def test_two_zoom_settings_are_told_apart_photo_by_photo() -> None:
    votes = count_votes(make_photos([700.0, 1100.0] * 3, seed=1), SIDE_PX)
    assert votes.decision is VoteDecision.TWO_GROUPS
    near, far = votes.groups
    assert near.names == ("00.jpg", "02.jpg", "04.jpg")
    assert far.names == ("01.jpg", "03.jpg", "05.jpg")
    assert near.focal_px == pytest.approx(700, rel=0.04)
    assert far.focal_px == pytest.approx(1100, rel=0.04)


def test_photos_that_may_not_be_split_scatter_instead() -> None:
    votes = count_votes(make_photos([700.0, 1100.0] * 3, seed=1), SIDE_PX, may_split=False)
    assert votes.decision is VoteDecision.SCATTERED
    assert votes.groups == ()


def test_photos_of_many_cameras_scatter() -> None:
    votes = count_votes(make_photos([500.0, 660.0, 870.0, 1150.0, 1500.0, 760.0]), SIDE_PX)
    assert votes.decision is VoteDecision.SCATTERED


def test_a_circle_around_an_object_leaves_the_focal_length_open() -> None:
    # The optical axes of all cameras meet at equal distances: no pair refuses any focal length.
    votes = count_votes(make_photos([800.0] * 6, around=True), SIDE_PX)
    assert votes.decision is VoteDecision.UNDECIDED
    low, high = votes.range_ratios
    assert high > 2 * low


def test_a_camera_that_only_turns_votes_right_or_not_at_all() -> None:
    votes = count_votes(make_photos([800.0] * 6, translation=0.0), SIDE_PX)
    assert votes.decision is not VoteDecision.DECIDED or votes.focal_px == pytest.approx(800, rel=0.1)
    assert votes.decision in (VoteDecision.DECIDED, VoteDecision.UNDECIDED)


def test_a_flat_wall_votes_right_or_not_at_all() -> None:
    votes = count_votes(make_photos([800.0] * 6, depth=0.0), SIDE_PX)
    assert votes.decision is not VoteDecision.DECIDED or votes.focal_px == pytest.approx(800, rel=0.1)
    assert votes.decision in (VoteDecision.DECIDED, VoteDecision.UNDECIDED)


def test_a_pair_of_few_or_wrong_matches_has_no_say(one_camera: list[PairPoints]) -> None:
    few = PairPoints(
        name0="a",
        name1="b",
        points0_px=one_camera[0].points0_px[:59],
        points1_px=one_camera[0].points1_px[:59],
    )
    assert weigh_pair(few, SIDE_PX) is None
    generator = np.random.default_rng(0)
    wrong = PairPoints(
        name0="a",
        name1="b",
        points0_px=generator.uniform(-500, 500, (80, 2)),
        points1_px=generator.uniform(-500, 500, (80, 2)),
    )
    assert weigh_pair(wrong, SIDE_PX) is None


def test_the_curve_of_a_pair_is_lowest_at_its_focal_length(one_camera: list[PairPoints]) -> None:
    evidence = weigh_pair(one_camera[0], SIDE_PX)
    assert evidence is not None
    assert CANDIDATE_RATIOS[evidence.curve.argmin()] == pytest.approx(0.8, rel=0.11)
    assert 85 <= evidence.num_inliers <= 100


def test_the_misfit_counts_wrong_matches_as_one_each(one_camera: list[PairPoints]) -> None:
    right, _ = misfit(one_camera[0], 800.0, 800.0)
    wrong, _ = misfit(one_camera[0], 800.0, 1200.0)
    # 15 of 105 matches are wrong; a few of them lie near their epipolar lines, and noise costs 90 · 0.04.
    assert 10 < right < 22 < 30 < wrong


def test_the_mode_follows_the_weight_of_the_votes() -> None:
    ratios = np.array([0.8, 0.81, 2.0])
    assert mode_of_votes(ratios, np.ones(3)) == pytest.approx(0.805, rel=0.01)
    assert mode_of_votes(ratios, np.array([1.0, 1.0, 5.0])) == pytest.approx(2.0, rel=0.01)


def test_of_many_pairs_every_photo_sends_its_strongest(one_camera: list[PairPoints]) -> None:
    chosen = pairs_that_vote(one_camera[::-1], max_num=6)
    assert len(chosen) == 6
    assert chosen == pairs_that_vote(one_camera, max_num=6)
    assert {name for pair in chosen for name in (pair.name0, pair.name1)} == {f"{i:02}.jpg" for i in range(6)}
