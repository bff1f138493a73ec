"""SIFT in COLMAP's conventions, by both extractors."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from corrsfm.config import Extractor, FeaturesConfig
from corrsfm.features.sift import create_extractor, extract_features, quantise_descriptors, scaled_size
from corrsfm.types import Features

SIFT = (Extractor.OPENCV, Extractor.PYCOLMAP)
BOTH = pytest.mark.parametrize("extractor", SIFT)


def texture(height: int, width: int, seed: int = 0) -> NDArray[np.uint8]:
    """Smooth noise with structure at several scales."""
    generator = np.random.default_rng(seed)
    total = np.zeros((height, width))
    for sigma in (1.5, 3.0, 6.0, 12.0):
        noise = cv2.GaussianBlur(generator.standard_normal((height, width)), (0, 0), sigma)
        total += noise / noise.std()
    return np.clip(128 + 30 * total, 0, 255).astype(np.uint8)


def blobs() -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Bright blobs at known places (COLMAP pixels), fractions included."""
    places = np.array(
        [
            [40.0 * x + dx, 40.0 * y + dy]
            for x, dx in ((1, 0.5), (2, 0.0), (3, 0.25))
            for y, dy in ((1, 0.5), (2, 0.75))
        ]
    )
    rows, columns = np.mgrid[:140, :180] + 0.5
    image = np.full((140, 180), 40.0)
    for x, y in places:
        image += 160 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 4.0**2))
    return np.rint(image).astype(np.uint8), places


@pytest.fixture(scope="module")
def photo() -> NDArray[np.uint8]:
    return texture(240, 320)


@BOTH
def test_keypoints_are_where_the_blobs_are(extractor: Extractor) -> None:
    image, places = blobs()
    keypoints = extract_features(image, extractor=extractor).keypoints
    distances = np.linalg.norm(keypoints[:, None] - places[None], axis=2)
    offsets = keypoints[distances.argmin(axis=0)] - places
    assert np.abs(offsets).max() < 0.2
    assert np.abs(offsets.mean(axis=0)).max() < 0.05


@BOTH
def test_the_scale_of_a_blob_is_its_standard_deviation(extractor: Extractor) -> None:
    image, places = blobs()
    features = extract_features(image, extractor=extractor)
    distances = np.linalg.norm(features.keypoints[:, None] - places[None], axis=2)
    scales = features.scales[distances.argmin(axis=0)]
    # A difference of Gaussians answers most at a σ somewhat below that of the blob.
    assert np.all((scales > 2.8) & (scales < 4.4))


def test_both_extractors_agree_on_scale_and_orientation(photo: NDArray[np.uint8]) -> None:
    one, other = (extract_features(photo, extractor=e) for e in SIFT)
    distances = np.linalg.norm(one.keypoints[:, None] - other.keypoints[None], axis=2)
    turned = one.orientations[:, None] - other.orientations[None]
    turned = np.abs((turned + np.pi) % (2 * np.pi) - np.pi)
    close = distances < 0.3
    assert close.any(axis=1).mean() > 0.3
    i, j = np.nonzero(close & (turned < 0.5))
    assert np.median(turned[i, j]) < 0.05
    assert np.median(one.scales[i] / other.scales[j]) == pytest.approx(1.0, abs=0.02)


@BOTH
def test_a_quarter_turn_of_the_photo_turns_the_orientations(
    extractor: Extractor, photo: NDArray[np.uint8]
) -> None:
    before = extract_features(photo, extractor=extractor)
    after = extract_features(np.ascontiguousarray(np.rot90(photo, -1)), extractor=extractor)
    # Clockwise: x' = height − y, y' = x; the x axis turns into the y axis, a rotation by +90°.
    expected = np.stack([photo.shape[0] - before.keypoints[:, 1], before.keypoints[:, 0]], axis=1)
    distances = np.linalg.norm(expected[:, None] - after.keypoints[None], axis=2)
    turns = after.orientations[None] - before.orientations[:, None] - np.pi / 2
    turns = np.abs((turns + np.pi) % (2 * np.pi) - np.pi)
    assert np.mean(((distances < 0.2) & (turns < 0.05)).any(axis=1)) > 0.9


@BOTH
def test_keypoints_of_a_reduced_photo_are_in_pixels_of_the_original(
    extractor: Extractor, photo: NDArray[np.uint8]
) -> None:
    small = extract_features(photo, extractor=extractor)
    # Every pixel four times: reduced to half its size it is the small photo again.
    large = extract_features(
        np.kron(photo, np.ones((2, 2), np.uint8)), extractor=extractor, max_image_size=320
    )
    assert large.image_size == (640, 480)
    np.testing.assert_array_equal(large.keypoints, 2 * small.keypoints)
    np.testing.assert_array_equal(large.scales, 2 * small.scales)
    np.testing.assert_array_equal(large.orientations, small.orientations)
    np.testing.assert_array_equal(large.descriptors, small.descriptors)


@BOTH
def test_features_come_strongest_first_and_repeat_exactly(
    extractor: Extractor, photo: NDArray[np.uint8]
) -> None:
    features = extract_features(photo, extractor=extractor, max_features=200)
    assert len(features) == 200
    assert np.all(np.diff(features.scores) <= 0)
    again = extract_features(photo, extractor=extractor, max_features=200)
    assert all(a.tobytes() == b.tobytes() for a, b in zip(arrays(features), arrays(again), strict=True))


def test_fewer_features_are_the_first_of_more(photo: NDArray[np.uint8]) -> None:
    few, many = (extract_features(photo, max_features=num) for num in (50, 400))
    np.testing.assert_array_equal(few.keypoints, many.keypoints[:50])
    np.testing.assert_array_equal(few.descriptors, many.descriptors[:50])


@BOTH
def test_a_mask_keeps_as_many_features_as_fit_inside(extractor: Extractor, photo: NDArray[np.uint8]) -> None:
    mask = np.zeros(photo.shape, bool)
    mask[:, :160] = True
    everything = extract_features(photo, extractor=extractor)
    num_inside = int(np.sum(everything.keypoints[:, 0] < 160))
    assert num_inside > 100
    masked = extract_features(photo, mask, extractor=extractor, max_features=100)
    assert len(masked) == 100
    assert masked.keypoints[:, 0].max() < 160
    assert len(extract_features(photo, mask, extractor=extractor)) == num_inside


@BOTH
@pytest.mark.parametrize("shape", [(1, 1), (3, 40), (64, 64)])
def test_a_photo_without_texture_has_no_features(extractor: Extractor, shape: tuple[int, int]) -> None:
    features = extract_features(np.full(shape, 77, np.uint8), extractor=extractor)
    assert len(features) == 0
    assert features.descriptors.shape == (0, 128)


@BOTH
def test_an_empty_mask_leaves_no_features(extractor: Extractor, photo: NDArray[np.uint8]) -> None:
    assert len(extract_features(photo, np.zeros(photo.shape, bool), extractor=extractor)) == 0


@BOTH
@pytest.mark.parametrize("root_sift", [True, False])
def test_descriptors_have_the_length_that_colmap_gives_them(
    extractor: Extractor, root_sift: bool, photo: NDArray[np.uint8]
) -> None:
    features = extract_features(photo, extractor=extractor, root_sift=root_sift, max_features=300)
    lengths = np.linalg.norm(features.descriptors.astype(float), axis=1)
    assert np.abs(lengths - 512).max() < 16


def test_root_sift_is_the_root_of_shares() -> None:
    # 64 entries of 1, 16 of 4: shares 1/128 and 1/32.
    values = np.zeros((1, 128))
    values[0, :64], values[0, 64:80] = 1.0, 4.0
    root = quantise_descriptors(values, root_sift=True)[0]
    assert (root[0], root[64], root[127]) == (round(512 * (1 / 128) ** 0.5), round(512 * (1 / 32) ** 0.5), 0)
    plain = quantise_descriptors(values, root_sift=False)[0]
    assert (plain[0], plain[64]) == (round(512 / 320**0.5), round(4 * 512 / 320**0.5))


def test_quantised_descriptors_are_clipped_and_zero_stays_zero() -> None:
    values = np.zeros((2, 128))
    values[0, 0] = 3.0
    for root_sift in (True, False):
        quantised = quantise_descriptors(values, root_sift=root_sift)
        assert quantised[0, 0] == 255
        assert not quantised[1].any()


@pytest.mark.parametrize(
    "size, largest, expected",
    [
        ((4000, 3000), 1600, (1600, 1200)),
        ((3000, 4000), 1600, (1200, 1600)),
        ((640, 480), 1600, (640, 480)),
        ((5000, 1), 100, (100, 1)),
    ],
)
def test_photos_are_only_scaled_down(size: tuple[int, int], largest: int, expected: tuple[int, int]) -> None:
    assert scaled_size(*size, largest) == expected


@BOTH
def test_one_extractor_serves_several_threads(extractor: Extractor) -> None:
    extract = create_extractor(FeaturesConfig(extractor=extractor, max_features=100))
    photos = [texture(120, 160, seed) for seed in range(4)]
    alone = [extract(image, None) for image in photos]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda image: extract(image, None), photos))
    for one, other in zip(alone, together, strict=True):
        assert all(a.tobytes() == b.tobytes() for a, b in zip(arrays(one), arrays(other), strict=True))


def test_opencv_threads_do_not_change_the_features(photo: NDArray[np.uint8]) -> None:
    before = cv2.getNumThreads()
    try:
        results = []
        for num_threads in (1, 4):
            cv2.setNumThreads(num_threads)
            results.append(extract_features(photo))
    finally:
        cv2.setNumThreads(before)
    assert all(a.tobytes() == b.tobytes() for a, b in zip(*map(arrays, results), strict=True))


def arrays(features: Features) -> Iterator[NDArray]:
    yield from (
        features.keypoints,
        features.scales,
        features.orientations,
        features.scores,
        features.descriptors,
    )
