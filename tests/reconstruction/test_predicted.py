"""Matches that a model predicts and was not made from."""

import numpy as np
import pytest
from scene_of_points import bend, make_scene

from corrsfm.reconstruction.epipolar import TwoViews
from corrsfm.reconstruction.predicted import (
    Neighbours,
    NeighbourTables,
    nearest_descriptors,
    predict,
    predict_pair,
    sample_pairs,
)
from corrsfm.reconstruction.views import rays_of


def count(scene, views, pairs=None) -> int:
    tables = NeighbourTables(scene.descriptors.__getitem__)
    predicted = predict(views, scene.keypoints, tables, pairs or scene.all_pairs())
    return sum(len(matches) for matches in predicted.values())


def plain_neighbours(descriptors0, descriptors1, num) -> Neighbours:
    """By sorting everything, in integers."""
    difference = descriptors0[:, None].astype(np.int64) - descriptors1[None].astype(np.int64)
    distances_sq = np.sum(difference**2, axis=2)
    indices = np.argsort(distances_sq, axis=1, kind="stable")[:, :num]
    nearest = np.take_along_axis(distances_sq, indices, axis=1)
    rows = [
        i for i in range(len(nearest)) if nearest.shape[1] > 1 and nearest[i, 0] < 0.7225 * nearest[i, -1]
    ]
    return Neighbours(
        keypoints=np.array(rows, np.int32),
        indices=indices[rows].astype(np.int32),
        distances_sq=nearest[rows].astype(np.float32),
    )


def plain_prediction(neighbours: Neighbours, two: TwoViews) -> list[list[int]]:
    """One keypoint at a time."""
    best: dict[int, tuple[float, int]] = {}
    num = neighbours.indices.shape[1]
    for row, i in enumerate(neighbours.keypoints.tolist()):
        candidates = []
        for rank in range(num):
            match = np.array([[i, neighbours.indices[row, rank]]])
            if two.line_distance_px(match)[0] < 3.0 and two.in_front(match)[0]:
                candidates.append(rank)
        if not candidates:
            continue
        second = candidates[1] if len(candidates) > 1 else num - 1
        nearest, next_one = neighbours.distances_sq[row, [candidates[0], second]]
        j = int(neighbours.indices[row, candidates[0]])
        if nearest < 0.85**2 * next_one and (j not in best or nearest < best[j][0]):
            best[j] = (nearest, i)
    return sorted([i, j] for j, (_, i) in best.items())


@pytest.mark.parametrize("num_values", [2, 6, 256])
@pytest.mark.parametrize(
    ("num0", "num1"),
    [(300, 40), (7, 300), (40, 1000), (5, 128), (5, 127), (5, 12), (5, 3), (5, 1), (5, 0), (0, 5)],
)
def test_neighbours_are_those_of_sorting_everything(num0: int, num1: int, num_values: int) -> None:
    generator = np.random.default_rng(0)
    # With few values many distances are equal.
    step = 255 // (num_values - 1)
    descriptors0, descriptors1 = (
        generator.integers(0, num_values, (n, 4), np.uint8) * np.uint8(step) for n in (num0, num1)
    )
    found = nearest_descriptors(descriptors0, descriptors1)
    expected = plain_neighbours(descriptors0, descriptors1, 12)
    np.testing.assert_array_equal(found.keypoints, expected.keypoints)
    np.testing.assert_array_equal(found.indices, expected.indices)
    np.testing.assert_array_equal(found.distances_sq, expected.distances_sq)


def test_the_largest_distance_is_exact() -> None:
    others = np.array([[255] * 128, [0] * 127 + [1]], np.uint8)
    found = nearest_descriptors(np.zeros((1, 128), np.uint8), others)
    assert found.distances_sq.tolist() == [[1, 128 * 255**2]]


def test_the_true_model_predicts_every_point_in_every_pair() -> None:
    scene = make_scene()
    tables = NeighbourTables(scene.descriptors.__getitem__)
    predicted = predict(scene.views, scene.keypoints, tables, scene.all_pairs())
    for pair, matches in predicted.items():
        truth = scene.matches(pair)
        np.testing.assert_array_equal(matches, truth[np.argsort(truth[:, 0])])
    assert len(predicted) == 10


def test_a_bent_model_predicts_less_than_two_right_ones() -> None:
    scene = make_scene()
    slightly = {**scene.views, "4.jpg": bend(scene.views["4.jpg"], 0.05)}
    bent = {**scene.views, "4.jpg": bend(scene.views["4.jpg"], 7.0)}
    assert count(scene, scene.views) == count(scene, slightly) == 600
    assert count(scene, bent) < 400


def test_a_model_with_fewer_photos_predicts_the_pairs_it_has() -> None:
    scene = make_scene(4)
    views = {name: scene.views[name] for name in ("0.jpg", "2.jpg", "3.jpg")}
    assert count(scene, views) == 3 * 60
    assert count(scene, {}) == count(scene, {"0.jpg": scene.views["0.jpg"]}) == 0


def test_the_model_tells_look_alikes_apart_that_descriptors_do_not() -> None:
    scene = make_scene(2)
    for name in scene.descriptors:
        # Points 0 and 1, 2 and 3 … look the same.
        twin = np.argsort(scene.order[name])[scene.order[name] // 2 * 2]
        scene.descriptors[name][:] = scene.descriptors[name][twin]
    assert count(scene, scene.views) >= 50


@pytest.mark.parametrize("degrees", [0.0, 0.5, 5.0])
def test_predictions_are_those_of_one_keypoint_at_a_time(degrees: float) -> None:
    scene = make_scene(2, 80)
    views = {**scene.views, "1.jpg": bend(scene.views["1.jpg"], degrees)}
    # Descriptors of few values: equal distances, and several keypoints that accept the same.
    descriptors = {name: values[:, :3] // 52 for name, values in scene.descriptors.items()}
    rays = rays_of(views, scene.keypoints)
    two = TwoViews(views["0.jpg"], views["1.jpg"], rays["0.jpg"], rays["1.jpg"])
    neighbours = nearest_descriptors(descriptors["0.jpg"], descriptors["1.jpg"])
    expected = plain_prediction(neighbours, two)
    assert predict_pair(neighbours, two).tolist() == expected
    assert len(expected) >= 5


@pytest.mark.parametrize("num1", [0, 1])
def test_a_photo_of_one_keypoint_predicts_nothing(num1: int) -> None:
    scene = make_scene(2)
    scene.keypoints["1.jpg"] = scene.keypoints["1.jpg"][:num1]
    scene.descriptors["1.jpg"] = scene.descriptors["1.jpg"][:num1]
    assert count(scene, scene.views) == 0


def test_tables_are_computed_once_a_pair() -> None:
    scene = make_scene(3)
    loaded: list[str] = []

    def load(name: str) -> np.ndarray:
        loaded.append(name)
        return scene.descriptors[name]

    tables = NeighbourTables(load)
    for _ in range(3):
        predict(scene.views, scene.keypoints, tables, scene.all_pairs())
    assert len(loaded) == 6


def test_all_pairs_of_a_small_scene_are_sampled() -> None:
    assert sample_pairs("cab", [], max_pairs=3) == [("a", "b"), ("a", "c"), ("b", "c")]
    assert sample_pairs([], []) == sample_pairs(["a"], []) == []


def test_the_sample_of_a_large_scene_is_fair_and_near() -> None:
    names = [f"{i:03d}" for i in range(100)]
    chain = list(zip(names, names[1:], strict=False))
    sample = sample_pairs(names, chain, max_pairs=100)
    assert sample == sample_pairs(reversed(names), reversed(chain), max_pairs=100)
    assert len(set(sample)) == 100 and sample == sorted(sample)
    assert all(1 <= int(b) - int(a) <= 2 for a, b in sample)
    uses = [sum(name in pair for pair in sample) for name in names]
    assert min(uses) >= 1 and max(uses) <= 4


def test_another_seed_draws_another_sample() -> None:
    names = [f"{i:03d}" for i in range(50)]
    chain = list(zip(names, names[1:], strict=False))
    one, other = (sample_pairs(names, chain, max_pairs=40, seed=seed) for seed in (0, 1))
    assert one != other


def test_neighbours_of_unit_vectors_are_those_of_their_angles() -> None:
    rng = np.random.default_rng(0)
    descriptors1 = rng.normal(size=(60, 256)).astype(np.float32)
    descriptors1 /= np.linalg.norm(descriptors1, axis=1, keepdims=True)
    descriptors0 = descriptors1[:40] + 0.02 * rng.normal(size=(40, 256)).astype(np.float32)
    descriptors0 /= np.linalg.norm(descriptors0, axis=1, keepdims=True)
    found = nearest_descriptors(descriptors0, descriptors1)
    np.testing.assert_array_equal(found.keypoints, np.arange(40))
    np.testing.assert_array_equal(found.indices[:, 0], np.arange(40))
    distances = ((descriptors0[:, None] - descriptors1[found.indices[:, 0]][:, None]) ** 2).sum(2)[:, 0]
    np.testing.assert_allclose(found.distances_sq[:, 0] / 2048**2, distances, atol=2e-3)
