"""The vote on how bodies lie to one another."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from rings import Ring

from corrsfm.reconstruction.folds.bodies import RotationVote, outvoted_pairs, photo_bodies, rotation_votes
from corrsfm.reconstruction.folds.sightings import explained_shares, read_sightings


def about_y(angle_deg):
    sine, cosine = np.sin(np.radians(angle_deg)), np.cos(np.radians(angle_deg))
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


def vote(name1, angle_deg, num_inliers=20, bodies=(0, 1)):
    return RotationVote(
        pair=("a", name1), bodies=bodies, num_inliers=num_inliers, rotation=about_y(angle_deg)
    )


def matches(num):
    return np.zeros((num, 2), np.int32)


@pytest.fixture(scope="module")
def torn_ring():
    """A ring without confused pairs, whose second half the model has turned by 90 degrees about the axis."""
    ring = Ring(12, lambda angle_deg, height: height > 2)
    model = ring.model(folded=False)
    turn = pycolmap.Rigid3d(np.column_stack([about_y(90.0), np.zeros(3)]))
    for image in list(model.images.values()):
        if ring.is_behind(image.name):
            image.frame.rig_from_world = image.cam_from_world() * turn.inverse()
    return ring, model


def test_photos_are_one_body_if_explained_pairs_link_them():
    verified = {("a", "b"): matches(40), ("b", "c"): matches(40), ("c", "d"): matches(40)}
    explained = {("a", "b"): 1.0, ("b", "c"): 0.6, ("c", "d"): 0.4}
    assert photo_bodies(explained, verified) == (("a", "b", "c"), ("d",))


def test_few_explained_matches_make_no_body():
    assert photo_bodies({("a", "b"): 0.9}, {("a", "b"): matches(16)}) == (("a",), ("b",))


def test_true_pairs_vote_for_the_turn_that_was_made(torn_ring):
    ring, model = torn_ring
    sightings = read_sightings(model)
    explained = explained_shares(sightings, ring.verified)
    votes = rotation_votes(sightings, ring.verified, explained)
    across = {pair for pair in explained if ring.is_behind(pair[0]) != ring.is_behind(pair[1])}
    assert len(across) > 2
    assert {vote.pair for vote in votes} == across
    for one in votes:
        np.testing.assert_allclose(one.rotation, about_y(90.0), atol=1e-3)


def test_pair_against_the_majority_is_outvoted():
    votes = [vote("b", 80), vote("c", 84), vote("d", 10), vote("e", 150)]
    assert outvoted_pairs(votes) == (("a", "d"), ("a", "e"))


def test_bodies_that_lie_as_the_majority_says_lose_no_pair():
    assert outvoted_pairs([vote("b", 2), vote("c", 5), vote("d", 90)]) == ()


def test_one_pair_is_no_majority():
    assert outvoted_pairs([vote("b", 80, num_inliers=500), vote("c", 10)]) == ()


def test_two_opinions_of_like_weight_decide_nothing():
    votes = [vote("b", 80), vote("c", 84), vote("d", 170, num_inliers=28)]
    assert outvoted_pairs(votes) == ()
    assert outvoted_pairs([*votes[:2], vote("d", 170, num_inliers=26)]) == (("a", "d"),)


def test_each_two_bodies_have_a_vote_of_their_own():
    votes = [vote("b", 80), vote("c", 84), vote("d", 10), vote("x", 10, bodies=(0, 2))]
    assert outvoted_pairs(votes) == (("a", "d"),)


def test_no_votes_name_no_pairs():
    assert outvoted_pairs([]) == ()
