"""Blocked matching equals a plain float64 search."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from corrsfm import distances
from corrsfm.descriptors import as_integers
from corrsfm.matches.nearest import Matcher, match_features


def descriptors(num: int, seed: int, *, high: int = 256, size: int = 128) -> NDArray[np.uint8]:
    """Random descriptors; a small ``high`` makes many equal distances."""
    return np.random.default_rng(seed).integers(0, high, (num, size)).astype(np.uint8)


def plain_matches(
    descriptors0: NDArray[np.uint8], descriptors1: NDArray[np.uint8]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
    """Nearest index, ratio and mutual flag by the definition, one row at a time, in float64."""
    values0, values1 = descriptors0.astype(np.float64), descriptors1.astype(np.float64)
    distances = np.array([np.sqrt(((values1 - row) ** 2).sum(axis=1)) for row in values0])
    nearest = distances.argmin(axis=1)
    two = np.sort(distances, axis=1)[:, :2]
    ratios = np.ones(len(values0))
    if two.shape[1] == 2:
        np.divide(two[:, 0], two[:, 1], out=ratios, where=two[:, 1] > 0)
    closest_back = distances.min(axis=0)
    mutual = np.zeros(len(values0), bool)
    claimed: set[int] = set()
    for i, j in enumerate(nearest):
        if distances[i, j] == closest_back[j] and j not in claimed:
            mutual[i] = True
            claimed.add(j)
    return nearest, ratios, mutual


@pytest.fixture(params=["bytes", "floats"])
def products(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both ways to multiply, whichever this processor takes."""
    exact = distances._multiplies_bytes()
    if request.param == "bytes" and not exact:
        pytest.skip("this processor does not multiply bytes exactly")
    monkeypatch.setattr(distances, "_multiplies_bytes", lambda: request.param == "bytes")


@pytest.mark.usefixtures("products")
@pytest.mark.parametrize("num0, num1", [(1, 1), (1, 2), (7, 1), (3, 300), (300, 3), (257, 130)])
@pytest.mark.parametrize("high", [2, 256])
@pytest.mark.parametrize("block_size", [32, 100, 4096])
def test_matches_equal_a_plain_search(num0: int, num1: int, high: int, block_size: int) -> None:
    descriptors0 = descriptors(num0, 0, high=high, size=8 if high == 2 else 128)
    descriptors1 = descriptors(num1, 1, high=high, size=8 if high == 2 else 128)
    nearest, ratios, mutual = plain_matches(descriptors0, descriptors1)
    matches = match_features(descriptors0, descriptors1, block_size=block_size)
    np.testing.assert_array_equal(matches.indices[:, 0], np.arange(num0))
    np.testing.assert_array_equal(matches.indices[:, 1], nearest)
    np.testing.assert_allclose(matches.ratios, ratios, rtol=1e-6)
    np.testing.assert_array_equal(matches.mutual, mutual)


@pytest.mark.usefixtures("products")
def test_distances_are_exact_at_the_largest_descriptors() -> None:
    zero = np.zeros((1, 128), np.uint8)
    far = np.full((2, 128), 255, np.uint8)
    far[1, 0] = 254  # nearer to zero by the least that is possible
    matches = match_features(zero, far)
    assert matches.indices.tolist() == [[0, 1]]
    expected = np.sqrt((127 * 255**2 + 254**2) / (128 * 255**2))
    assert matches.ratios[0] == np.float32(expected) < 1


@pytest.mark.usefixtures("products")
def test_long_descriptors_are_matched_exactly_too() -> None:
    far = np.full((2, 512), 255, np.uint8)
    far[1, 0] = 254
    assert match_features(np.zeros((1, 512), np.uint8), far).indices.tolist() == [[0, 1]]


@pytest.mark.parametrize("num0, num1", [(0, 0), (0, 5), (5, 0)])
def test_an_empty_side_gives_no_matches(num0: int, num1: int) -> None:
    assert len(match_features(descriptors(num0, 0), descriptors(num1, 1))) == 0


def test_a_single_candidate_has_ratio_one() -> None:
    assert match_features(descriptors(4, 0), descriptors(1, 1)).ratios.tolist() == [1.0] * 4


@pytest.mark.usefixtures("products")
def test_equal_distances_take_the_lowest_index_and_ratio_one() -> None:
    same = np.repeat(descriptors(1, 0), 5, axis=0)
    matches = match_features(same, same, block_size=2)
    assert matches.indices[:, 1].tolist() == [0] * 5
    assert matches.ratios.tolist() == [1.0] * 5
    assert matches.mutual.tolist() == [True] + [False] * 4


@pytest.mark.parametrize("num", [1, 5, 300])
def test_bytes_and_floats_give_the_same_bits(monkeypatch: pytest.MonkeyPatch, num: int) -> None:
    if not distances._multiplies_bytes():
        pytest.skip("this processor does not multiply bytes exactly")
    pair = descriptors(700, 0), descriptors(num, 1)
    by_bytes = match_features(*pair)
    monkeypatch.setattr(distances, "_multiplies_bytes", bool)
    by_floats = match_features(*pair)
    for name in ("indices", "ratios", "mutual"):
        assert getattr(by_bytes, name).tobytes() == getattr(by_floats, name).tobytes()


def test_a_product_that_saturates_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    def saturates(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        return (left.int() @ right.int()).clamp(-(2**15), 2**15 - 1)

    monkeypatch.setattr(torch, "_int_mm", saturates)
    monkeypatch.setattr(torch.cpu, "_is_vnni_supported", lambda: True)
    assert not distances._multiplies_bytes.__wrapped__()


@pytest.mark.usefixtures("products")
def test_mutual_matches_use_each_keypoint_once() -> None:
    matches = match_features(descriptors(200, 0, high=3, size=6), descriptors(200, 1, high=3, size=6))
    used = matches.indices[matches.mutual, 1]
    assert len(used) > 0
    assert len(set(used)) == len(used)


def test_the_number_of_threads_does_not_change_the_result() -> None:
    pair = descriptors(700, 0), descriptors(600, 1)
    before = torch.get_num_threads()
    try:
        results = []
        for num_threads in (1, 3):
            torch.set_num_threads(num_threads)
            results.append(match_features(*pair))
    finally:
        torch.set_num_threads(before)
    assert results[0].ratios.tobytes() == results[1].ratios.tobytes()
    assert results[0].indices.tobytes() == results[1].indices.tobytes()


def test_matcher_loads_each_photo_once_while_it_is_cached() -> None:
    scene = {name: descriptors(20, seed) for seed, name in enumerate("abcd")}
    loaded: list[str] = []

    def load(name: str) -> NDArray[np.uint8]:
        loaded.append(name)
        return scene[name]

    matcher = Matcher(load, max_cached_images=2)
    for pair in ("ab", "ba", "ac", "ad", "ab"):
        matches = matcher.match(*pair)
        expected = match_features(scene[pair[0]], scene[pair[1]])
        np.testing.assert_array_equal(matches.indices, expected.indices)
    # c and d each push out the photo used longest ago, never a.
    assert loaded == ["a", "b", "c", "d", "b"]


@pytest.mark.gpu
def test_matches_on_the_gpu_equal_those_on_the_cpu() -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    for num0, num1, high, size in ((3000, 2500, 256, 128), (300, 400, 2, 8)):
        pair = descriptors(num0, 0, high=high, size=size), descriptors(num1, 1, high=high, size=size)
        on_cpu, on_gpu = match_features(*pair), match_features(*pair, device="cuda", block_size=1024)
        np.testing.assert_array_equal(on_cpu.indices, on_gpu.indices)
        np.testing.assert_array_equal(on_cpu.mutual, on_gpu.mutual)
        np.testing.assert_allclose(on_cpu.ratios, on_gpu.ratios, rtol=1e-6)


def unit_vectors(num: int, seed: int, size: int = 256) -> NDArray[np.float32]:
    values = np.random.default_rng(seed).normal(size=(num, size)).astype(np.float32)
    return values / np.linalg.norm(values, axis=1, keepdims=True)


@pytest.mark.parametrize("size", [32, 128, 256])
def test_unit_vectors_have_the_neighbours_of_a_plain_search(size: int) -> None:
    descriptors0, descriptors1 = unit_vectors(200, 0, size), unit_vectors(170, 1, size)
    nearest, ratios, _ = plain_matches(descriptors0, descriptors1)
    matches = match_features(descriptors0, descriptors1)
    # Steps of 1/2048 may turn round neighbours that almost tie.
    assert (matches.indices[:, 1] == nearest).mean() > 0.97
    np.testing.assert_allclose(matches.ratios, ratios, atol=5e-3)


def test_matches_of_unit_vectors_do_not_depend_on_the_block_size() -> None:
    descriptors0, descriptors1 = unit_vectors(300, 0), unit_vectors(500, 1)
    expected = match_features(descriptors0, descriptors1)
    for block_size in (7, 64, 333):
        found = match_features(descriptors0, descriptors1, block_size=block_size)
        for name in ("indices", "ratios", "mutual"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_sums_of_unit_vectors_are_whole_numbers_in_float32() -> None:
    integers = as_integers(unit_vectors(50, 2))
    exact = integers.astype(np.int64)
    np.testing.assert_array_equal(integers, exact)
    np.testing.assert_array_equal(integers @ integers.T, exact @ exact.T)
    assert np.abs(exact @ exact.T).max() * 4 <= 2**24 * 1.01
