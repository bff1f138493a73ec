"""Photos that show the same things are found by their descriptors."""

import numpy as np
import pytest
from numpy.typing import NDArray

from corrsfm.pairs import retrieval
from corrsfm.pairs.retrieval import aggregate, global_vectors, most_similar, train_vocabulary


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


def test_the_order_of_descriptors_does_not_matter() -> None:
    photos = scene(2, 2)
    vocabulary = train_vocabulary(np.concatenate(list(photos.values())), seed=0)
    descriptors = photos["0/0"]
    np.testing.assert_allclose(
        aggregate(descriptors, vocabulary), aggregate(descriptors[::-1], vocabulary), atol=1e-5
    )


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
    vectors = np.random.default_rng(0).standard_normal((40, 6))
    similarity = vectors @ vectors.T
    np.fill_diagonal(similarity, -np.inf)
    found = most_similar(vectors, num_neighbours, block_size=block_size)
    for row, neighbours in enumerate(found):
        expected = np.argsort(-similarity[row])[: min(num_neighbours, 39)]
        np.testing.assert_array_equal(neighbours, expected)


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
