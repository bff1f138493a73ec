"""Photos that show the same things are found by their descriptors."""

import numpy as np
import pytest
from numpy.typing import NDArray

from corrsfm.pairs import retrieval
from corrsfm.pairs.retrieval import Vocabulary, aggregate, global_vectors, most_similar


def scene(num_places: int, num_views: int, seed: int = 0) -> dict[str, NDArray[np.uint8]]:
    """Descriptors of photos: views of a place share most of their descriptors, with noise."""
    generator = np.random.default_rng(seed)
    # Real descriptors lie in clusters; uniform noise in 128 dimensions would have nothing to quantise.
    prototypes = generator.gamma(0.4, 60, (100, 128))
    photos = {}
    for place in range(num_places):
        own = prototypes[generator.integers(0, 100, 150)] * generator.uniform(0.6, 1.4, (150, 128))
        for view in range(num_views):
            seen = own[generator.permutation(150)[:110]] + generator.normal(0, 6, (110, 128))
            photos[f"{place}/{view}"] = np.clip(seen, 0, 255).astype(np.uint8)
    return photos


def test_the_nearest_photos_show_the_same_place() -> None:
    photos = scene(8, 5)
    names = sorted(photos)
    neighbours = most_similar(global_vectors(names, photos.__getitem__, seed=0), 4)
    right = [names[j][0] == names[i][0] for i, found in enumerate(neighbours) for j in found]
    assert len(right) == 8 * 5 * 4
    assert np.mean(right) > 0.95


def test_vectors_repeat_exactly_and_have_unit_length() -> None:
    photos = scene(3, 3)
    vectors = [global_vectors(sorted(photos), photos.__getitem__, seed=1) for _ in range(2)]
    assert vectors[0].tobytes() == vectors[1].tobytes()
    np.testing.assert_allclose(np.linalg.norm(vectors[0].astype(np.float64), axis=1), 1.0, atol=1e-3)


def unit_vectors(descriptors: NDArray[np.uint8]) -> NDArray[np.float64]:
    return descriptors / np.linalg.norm(descriptors.astype(np.float64), axis=1, keepdims=True)


def test_the_order_of_descriptors_does_not_matter() -> None:
    photos = scene(2, 2)
    words = unit_vectors(photos["1/0"][:8])[:, :32]
    vocabulary = Vocabulary(
        mean=np.zeros(128, np.float32),
        directions=np.eye(128, 32, dtype=np.float32),
        words=words.astype(np.float32),
    )
    # Without those between two words, where rounding would decide.
    points = unit_vectors(photos["0/0"])[:, :32]
    distances = ((points[:, None] - words) ** 2).sum(-1)
    clear = np.diff(np.sort(distances, axis=1)[:, :2])[:, 0] > 1e-4
    assert clear.sum() > 100
    one_hot = (distances.argmin(axis=1) == np.arange(8)[:, None])[:, clear]
    counts = one_hot.sum(axis=1)
    lengths = np.linalg.norm(one_hot @ points[clear] - counts[:, None] * words, axis=1)[counts > 0]
    # Each order is off by at most u · terms of the sum of absolute values; then the length divides it.
    bound = 2 * 2.0**-24 * counts.max() * (one_hot @ np.abs(points[clear])).max() / lengths.min()
    assert bound < 1e-4
    descriptors = photos["0/0"][clear]
    one, other = aggregate(descriptors, vocabulary), aggregate(descriptors[::-1], vocabulary)
    np.testing.assert_allclose(one, other, atol=bound, rtol=0)


def test_photos_without_descriptors_are_nobodys_neighbour() -> None:
    photos = scene(2, 2) | {"empty": np.zeros((0, 128), np.uint8)}
    names = sorted(photos)
    vectors = global_vectors(names, photos.__getitem__, seed=0)
    position = names.index("empty")
    assert not vectors[position].any()
    neighbours = most_similar(vectors, 10)
    assert len(neighbours[position]) == 0
    assert all(position not in found for found in neighbours)
    assert [len(found) for found in neighbours].count(3) == 4


def test_a_scene_without_any_descriptor_gives_zero_vectors() -> None:
    vectors = global_vectors(["a", "b"], lambda name: np.zeros((0, 128), np.uint8), seed=0)
    assert not vectors.any()


@pytest.mark.parametrize("num_descriptors", [1, 3])
def test_a_handful_of_descriptors_is_enough(num_descriptors: int) -> None:
    photos = {name: scene(1, 1, seed)["0/0"][:num_descriptors] for seed, name in enumerate("abc")}
    vectors = global_vectors(sorted(photos), photos.__getitem__, seed=0)
    assert np.isfinite(vectors).all()


def test_each_photo_is_read_twice_at_most() -> None:
    photos = scene(2, 3)
    reads: list[str] = []

    def load(name: str) -> NDArray[np.uint8]:
        reads.append(name)
        return photos[name]

    global_vectors(sorted(photos), load, seed=0)
    assert max(reads.count(name) for name in photos) == 2


def test_the_vocabulary_is_learned_from_a_bounded_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retrieval, "NUM_SAMPLED_PHOTOS", 4)
    photos = scene(5, 4)
    reads: list[str] = []

    def load(name: str) -> NDArray[np.uint8]:
        reads.append(name)
        return photos[name]

    global_vectors(sorted(photos), load, seed=0)
    assert len(reads) == 4 + 20


@pytest.mark.parametrize("block_size", [1, 7, 1000])
@pytest.mark.parametrize("num_neighbours", [1, 5, 60])
def test_blocked_search_equals_a_plain_one(block_size: int, num_neighbours: int) -> None:
    # Small whole numbers: dot products are exact in any order, and equal ones come by index.
    vectors = np.random.default_rng(0).integers(-9, 10, (40, 6)).astype(np.float32)
    similarity = vectors @ vectors.T
    np.fill_diagonal(similarity, -np.inf)
    found = most_similar(vectors, num_neighbours, block_size=block_size)
    for row, neighbours in enumerate(found):
        expected = np.argsort(-similarity[row], kind="stable")[: min(num_neighbours, 39)]
        np.testing.assert_array_equal(neighbours, expected)


def test_equally_similar_photos_come_by_their_index_where_the_list_is_cut() -> None:
    vectors = np.ones((30, 4), np.float32)
    for row, neighbours in enumerate(most_similar(vectors, 3, block_size=7)):
        assert neighbours.tolist() == [other for other in range(4) if other != row][:3]


@pytest.mark.slow
def test_retrieval_finds_covisible_photos_of_real_scenes(shared_dir) -> None:  # type: ignore[no-untyped-def]
    from corrsfm.features.sift import extract_features
    from corrsfm.images.listing import list_images
    from corrsfm.images.photos import read_image

    photos, covisible = {}, set()
    for name in ("parking_3", "copr", "puma"):
        folder = shared_dir / "photos" / name
        for photo in list_images(folder / "images"):
            image = read_image(folder / "images" / photo)
            photos[f"{name}/{photo}"] = extract_features(image, max_features=2000).descriptors
        for line in (folder / "covisibility.txt").read_text().splitlines():
            if not line.startswith("#"):
                one, other, _ = line.split()
                covisible |= {(f"{name}/{one}", f"{name}/{other}"), (f"{name}/{other}", f"{name}/{one}")}
    names = sorted(photos)
    neighbours = most_similar(global_vectors(names, photos.__getitem__, seed=0), 4)
    right = [(names[i], names[j]) in covisible for i, found in enumerate(neighbours) for j in found]
    assert len(right) == 4 * 57
    assert np.mean(right) > 0.7


def test_unit_vectors_of_any_length_are_compared_and_photos_without_any_left_alone() -> None:
    rng = np.random.default_rng(0)
    places = [rng.normal(size=(30, 256)) for _ in range(3)]
    photos = {
        f"{place}{view}": (values + 0.1 * rng.normal(size=values.shape)).astype(np.float32)
        for place, values in enumerate(places)
        for view in "ab"
    }
    photos["none"] = np.zeros((0, 128), np.uint8)
    names = sorted(photos)
    nearest = most_similar(global_vectors(names, photos.__getitem__, seed=0), 1)
    for name, found in zip(names, nearest, strict=True):
        if name != "none":
            assert names[found[0]][0] == name[0]
    assert len(nearest[names.index("none")]) == 0
