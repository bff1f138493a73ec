"""Unfolding: which verified pairs are left out, and which of the new models is taken."""

from __future__ import annotations

import dataclasses

import numpy as np
import pycolmap
import pytest
from rings import Ring

from corrsfm.reconstruction.folds.evidence import FoldEvidence, NearPair
from corrsfm.reconstruction.folds.sightings import Sightings
from corrsfm.reconstruction.folds.unfold import (
    Attempt,
    UnfoldRule,
    best_unfolding,
    judge_model,
    pairs_to_leave_out,
    photo_groups,
    try_unfolding,
    weak_pairs,
)


@pytest.fixture(scope="module")
def ring():
    return Ring(24, lambda angle_deg, height: height < -0.4)


@pytest.fixture(scope="module")
def folded(ring):
    return judge_model(ring.model(folded=True), ring.verified)


def crosses(ring, pair):
    return ring.is_behind(pair[0]) != ring.is_behind(pair[1])


def matches(num):
    return np.zeros((num, 2), np.int32)


def attempt(*, conflicts=0, near=20, num_photos=10, explained=None, explained_share=0.9, removed=()):
    pairs = tuple(
        NearPair(
            name0="a",
            name1=f"b{i:02d}",
            angle_deg=5.0,
            share=0.5,
            share_conflict=0.9 if i < conflicts else 0.0,
            hole=0.0,
            guarded=True,
        )
        for i in range(near)
    )
    return Attempt(
        rules=(),
        removed=tuple(removed),
        model=pycolmap.Reconstruction(),
        sightings=Sightings(views=(None,) * num_photos, positions=np.zeros((0, 3))),
        evidence=FoldEvidence(near_pairs=pairs),
        explained=explained or {},
        explained_share=explained_share,
    )


def test_groups_of_a_folded_ring_are_its_two_sides_and_at_odds(ring, folded):
    groups = photo_groups(folded.evidence)
    assert groups.groups == (tuple(ring.names[:12]), tuple(ring.names[12:]))
    assert groups.at_odds == ((0, 1),)


def test_right_ring_is_one_group(ring):
    right = judge_model(ring.model(folded=False), ring.verified)
    assert photo_groups(right.evidence).groups == (tuple(ring.names),)


@pytest.mark.parametrize("rule", [UnfoldRule.SHARES, UnfoldRule.HOLES])
def test_pairs_that_hold_the_two_sides_together_are_left_out(ring, folded, rule):
    found = pairs_to_leave_out(rule, folded, ring.verified)
    assert found == tuple(
        sorted(pair for pair, share in folded.explained.items() if share >= 0.5 and crosses(ring, pair))
    )
    assert ("04", "17") in found


def test_true_links_that_a_fold_contradicts_stay(ring, folded):
    found = pairs_to_leave_out(UnfoldRule.SHARES, folded, ring.verified)
    assert ("11", "12") in ring.verified
    assert ("11", "12") not in found


@pytest.mark.parametrize("rule", [UnfoldRule.SHARES, UnfoldRule.HOLES, UnfoldRule.VOTES])
def test_right_ring_loses_no_pair(ring, rule):
    right = judge_model(ring.model(folded=False), ring.verified)
    assert pairs_to_leave_out(rule, right, ring.verified) == ()


def test_weak_pairs_are_measured_by_the_second_strongest_of_either_photo():
    verified = {
        ("a", "b"): matches(100),
        ("a", "c"): matches(80),
        ("b", "c"): matches(30),
        ("c", "d"): matches(20),
    }
    # Second strongest: a 80, b 30, c 30, d none. So b-c asks for 15, c-d for nothing.
    assert weak_pairs(verified) == ()
    verified["b", "d"] = matches(9)
    # d's second is now 9, b's stays 30; at twice the strength c-d asks for 18 and b-d for 18.
    assert weak_pairs(verified, strength=2.0) == (("b", "c"), ("b", "d"))


def test_only_pair_of_a_photo_is_never_weak():
    assert weak_pairs({("a", "b"): matches(900), ("a", "c"): matches(800), ("c", "d"): matches(1)}) == ()


def test_pairs_that_were_left_out_already_are_not_named_again(ring, folded):
    once = dataclasses.replace(folded, removed=(("04", "17"),))
    found = pairs_to_leave_out(UnfoldRule.SHARES, once, ring.verified)
    assert ("04", "17") not in found
    assert len(found) == len(pairs_to_leave_out(UnfoldRule.SHARES, folded, ring.verified)) - 1


def test_folded_ring_is_unfolded_when_its_false_links_go(ring, folded):
    asked = []

    def map_without(removed):
        asked.append(removed)
        holds = any(crosses(ring, pair) and pair not in removed for pair in folded_links)
        return ring.model(folded=holds)

    folded_links = [pair for pair, share in folded.explained.items() if share >= 0.5]
    attempts = try_unfolding(folded, ring.verified, map_without, rules=(UnfoldRule.SHARES,))
    assert [one.removed for one in attempts] == asked
    best = best_unfolding(folded, attempts)
    assert best is attempts[0]
    assert best.rules == (UnfoldRule.SHARES,)
    assert best.evidence.folded is False


def test_evidence_of_an_attempt_counts_the_matches_that_were_left_out(ring, folded):
    """A model mapped without the true links is as folded as before."""
    stubborn = try_unfolding(
        folded, ring.verified, lambda removed: ring.model(folded=True), rules=(UnfoldRule.SHARES,)
    )
    assert len(stubborn) == 1
    assert stubborn[0].evidence == folded.evidence
    assert best_unfolding(folded, stubborn) is folded


def test_equal_sets_of_pairs_are_mapped_once(ring, folded):
    num_mapped = 0

    def map_without(removed):
        nonlocal num_mapped
        num_mapped += 1
        return ring.model(folded=True)

    try_unfolding(folded, ring.verified, map_without, rules=(UnfoldRule.SHARES, UnfoldRule.SHARES))
    assert num_mapped == 1


def test_scene_that_no_longer_maps_gives_no_attempt(ring, folded):
    assert try_unfolding(folded, ring.verified, lambda removed: None) == []


def test_model_that_lost_photos_is_not_taken():
    first = attempt(conflicts=8, num_photos=20)
    assert best_unfolding(first, [attempt(num_photos=17)]) is first
    kept = attempt(num_photos=18)
    assert best_unfolding(first, [kept]) is kept


def test_first_model_stays_unless_another_has_less_against_it():
    first = attempt(conflicts=3)
    assert best_unfolding(first, [attempt(conflicts=3), attempt(conflicts=4)]) is first


def test_equal_evidence_is_decided_by_what_the_models_explain():
    first = attempt(conflicts=3)
    other, better = attempt(explained_share=0.7), attempt(explained_share=0.8)
    assert best_unfolding(first, [other, better]) is better
