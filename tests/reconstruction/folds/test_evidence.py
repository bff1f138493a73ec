"""Fold evidence: silent on a right model, loud where two sides lie on one another."""

from __future__ import annotations

import dataclasses

import numpy as np
import pycolmap
import pytest
from rings import Ring

from corrsfm.reconstruction.folds.evidence import FoldEvidence, NearPair, find_folds
from corrsfm.reconstruction.folds.sightings import explained_shares, read_sightings


def lower_third(angle_deg, height):
    return height < -0.4


def all_but_a_patch(angle_deg, height):
    """Two sides that differ only in a label, a third of the height and 120 degrees wide."""
    return (np.abs(height) > 0.5) | (np.abs(angle_deg - 90) > 60)


@pytest.fixture(scope="module")
def ring():
    return Ring(24, lower_third)


@pytest.fixture(scope="module")
def labelled_ring():
    return Ring(24, all_but_a_patch)


def near_pair(name0, name1, *, share_conflict=0.0, hole=0.0, guarded=True):
    return NearPair(
        name0=name0,
        name1=name1,
        angle_deg=10.0,
        share=0.5,
        share_conflict=share_conflict,
        hole=hole,
        guarded=guarded,
    )


def test_right_ring_shows_no_conflict(ring):
    evidence = find_folds(ring.model(folded=False), ring.verified)
    # Each photo is near the next one only: 15 degrees of azimuth are 18 of viewing angle.
    assert evidence.num_near_pairs == 24
    assert evidence.num_all_conflicts == 0
    assert evidence.folded is False


def test_every_pair_of_a_photo_and_its_opposite_conflicts_in_a_folded_ring(ring):
    evidence = find_folds(ring.model(folded=True), ring.verified)
    assert evidence.folded is True
    conflicts = {(pair.name0, pair.name1) for pair in evidence.near_pairs if pair.conflicts}
    assert conflicts >= {(ring.names[i], ring.names[i + 12]) for i in range(12)}


def test_conflicts_of_a_folded_ring_join_front_and_back_only(ring):
    evidence = find_folds(ring.model(folded=True), ring.verified)
    for pair in evidence.near_pairs:
        assert not pair.conflicts or ring.is_behind(pair.name0) != ring.is_behind(pair.name1)


def test_sides_that_differ_in_one_patch_conflict_by_holes_not_by_shares(labelled_ring):
    evidence = find_folds(labelled_ring.model(folded=True), labelled_ring.verified)
    opposite = [
        pair
        for pair in evidence.near_pairs
        if int(pair.name1) - int(pair.name0) == 12 and 3 <= int(pair.name0) <= 9
    ]
    assert len(opposite) == 7
    assert all(pair.hole > 0.1 and pair.share_conflict < 0.5 for pair in opposite)
    assert evidence.folded is True


def test_right_ring_with_almost_equal_sides_shows_no_conflict(labelled_ring):
    evidence = find_folds(labelled_ring.model(folded=False), labelled_ring.verified)
    assert evidence.num_all_conflicts == 0
    assert evidence.folded is False


def test_fold_of_sides_that_are_equal_everywhere_stays_unseen():
    ring = Ring(24, lambda angle_deg, height: height < 2)
    evidence = find_folds(ring.model(folded=True), ring.verified)
    assert evidence.num_all_conflicts == 0


def test_photos_far_from_one_another_are_not_judged():
    ring = Ring(12, lower_third)
    evidence = find_folds(ring.model(folded=False), ring.verified)
    assert evidence.num_near_pairs == 0
    assert evidence.value == 0.0
    assert evidence.folded is None


def test_verified_matches_count_as_found_where_the_model_has_no_track(ring):
    model = ring.model(folded=False)
    name0, name1 = ring.names[:2]
    image = model.find_image_with_name(name1)
    for row in image.get_observation_point2D_idxs()[::2]:
        model.delete_observation(image.image_id, row)

    def share(verified):
        pairs = find_folds(model, verified).near_pairs
        return next(pair.share for pair in pairs if (pair.name0, pair.name1) == (name0, name1))

    without = {pair: matches for pair, matches in ring.verified.items() if pair != (name0, name1)}
    assert share(ring.verified) > 0.8
    assert share(without) < 0.7


def test_evidence_does_not_depend_on_the_order_of_pairs(ring):
    model = ring.model(folded=True)
    backwards = dict(reversed(ring.verified.items()))
    assert find_folds(model, backwards) == find_folds(model, ring.verified)


def test_orientation_of_a_verified_pair_does_not_matter(ring):
    model = ring.model(folded=True)
    turned = {(name1, name0): matches[:, ::-1] for (name0, name1), matches in ring.verified.items()}
    assert find_folds(model, turned) == find_folds(model, ring.verified)


def test_model_without_photos_gives_no_verdict():
    evidence = find_folds(pycolmap.Reconstruction(), {})
    assert evidence == FoldEvidence(near_pairs=())
    assert evidence.folded is None


def test_model_whose_points_are_all_of_two_photos_gives_no_verdict(ring):
    model = ring.model(folded=False)
    for point_id in [one for one, point in model.points3D.items() if point.track.length() > 2]:
        model.delete_point3D(point_id)
    assert find_folds(model, ring.verified).folded is None


def test_unguarded_pairs_are_kept_and_not_judged():
    pairs = (near_pair("a", "b", share_conflict=0.9, guarded=False), near_pair("a", "c"))
    evidence = FoldEvidence(near_pairs=pairs)
    assert (evidence.num_near_pairs, evidence.num_conflicts, evidence.num_all_conflicts) == (1, 0, 1)


def test_value_is_the_share_of_judged_pairs_in_conflict():
    conflicts = [
        near_pair("a", "b", hole=0.2),
        near_pair("c", "d", share_conflict=0.6),
        near_pair("e", "f", hole=1.0),
    ]
    silent = [near_pair("k", f"k{i}") for i in range(21)]
    evidence = FoldEvidence(near_pairs=(*conflicts, *silent))
    assert evidence.value == 3 / 24
    assert evidence.folded is True


def test_two_conflicts_are_too_few_to_call_a_model_folded():
    silent = [near_pair("k", f"k{i}") for i in range(18)]
    conflicts = [near_pair("a", "b", hole=0.2), near_pair("c", "d", hole=0.2)]
    assert FoldEvidence(near_pairs=(*conflicts, *silent)).folded is False


def test_ten_pairs_can_show_a_fold_and_twenty_are_needed_to_deny_one():
    conflicts = [near_pair(f"a{i}", f"b{i}", hole=0.2) for i in range(3)]
    silent = [near_pair("k", f"k{i:02d}") for i in range(20)]
    assert FoldEvidence(near_pairs=(*conflicts, *silent[:6])).folded is None
    assert FoldEvidence(near_pairs=(*conflicts, *silent[:7])).folded is True
    assert FoldEvidence(near_pairs=tuple(silent[:19])).folded is None
    assert FoldEvidence(near_pairs=tuple(silent)).folded is False


def test_conflicts_about_one_photo_are_not_a_fold():
    silent = [near_pair("k", f"k{i}") for i in range(20)]
    star = [near_pair("blurred", f"n{i}", hole=0.5) for i in range(6)]
    assert FoldEvidence(near_pairs=(*star, *silent)).folded is False
    others = (near_pair("n0", "n1", hole=0.5), near_pair("n2", "n3", hole=0.5))
    assert FoldEvidence(near_pairs=(*star, others[0], *silent)).folded is False
    assert FoldEvidence(near_pairs=(*star, *others, *silent)).folded is True


def test_worst_pairs_come_first_and_silent_ones_never():
    pairs = (
        near_pair("a", "b", share_conflict=0.6),
        near_pair("a", "c", hole=0.4),
        near_pair("a", "d"),
        near_pair("b", "c", share_conflict=1.0, guarded=False),
    )
    worst = FoldEvidence(near_pairs=pairs).worst(5)
    assert [(pair.name0, pair.name1) for pair in worst] == [("a", "c"), ("a", "b")]
    assert FoldEvidence(near_pairs=pairs).worst(1) == worst[:1]


def test_right_model_explains_true_pairs_wholly_and_confused_ones_not(ring):
    explained = explained_shares(read_sightings(ring.model(folded=False)), ring.verified)
    assert explained["00", "01"] == 1.0
    assert explained["04", "16"] < 0.2


def test_folded_model_explains_confused_pairs_wholly(ring):
    explained = explained_shares(read_sightings(ring.model(folded=True)), ring.verified)
    assert explained["04", "17"] == 1.0
    # The true neighbours at the seam are torn apart.
    assert explained["11", "12"] < 0.5


def test_pairs_of_unregistered_photos_are_left_out_of_explained_shares(ring):
    sightings = read_sightings(ring.model(folded=False))
    fewer = dataclasses.replace(sightings, views=sightings.views[1:])
    explained = explained_shares(fewer, ring.verified)
    assert set(explained) == {pair for pair in ring.verified if "00" not in pair}


def test_photos_with_many_points_are_sampled(ring):
    sightings = read_sightings(ring.model(folded=False), max_points_per_photo=100)
    assert {len(view.point_rows) for view in sightings.views} == {100}
    full = read_sightings(ring.model(folded=False))
    assert set(sightings.views[0].point_rows) <= set(full.views[0].point_rows)
