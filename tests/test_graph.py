"""Which pairs follow each other when a cluster takes them in blocks."""

import numpy as np

from corrsfm.graph import neighbours_together, second_strongest


def test_the_second_strongest_pair_of_a_photo_counts() -> None:
    strengths = {("a", "b"): 9, ("a", "c"): 5, ("a", "d"): 7, ("b", "c"): 1}
    assert second_strongest(strengths) == {"a": 7, "b": 1, "c": 1, "d": 0}


def test_pairs_that_follow_each_other_share_photos_whatever_the_photos_are_called() -> None:
    # Neighbours along a path whose photos have random names, as retrieval finds them.
    order = np.random.default_rng(0).permutation(300)
    names = [f"{number:03}.jpg" for number in order]
    pairs = sorted(
        (min(names[a], names[b]), max(names[a], names[b]))
        for a in range(300)
        for b in range(a + 1, min(300, a + 9))
    )

    def photos_a_block(ordered: list[tuple[str, str]]) -> float:
        blocks = [ordered[start : start + 100] for start in range(0, len(ordered), 100)]
        return float(np.mean([len({name for pair in block for name in pair}) for block in blocks]))

    ordered = neighbours_together(pairs)
    assert sorted(ordered) == pairs
    assert photos_a_block(ordered) < 45 < 60 < photos_a_block(pairs)
    assert neighbours_together(reversed(pairs)) == ordered
    assert neighbours_together([]) == []
