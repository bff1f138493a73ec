"""A look at photos before a run: what is wrong with them is found, what is not is left alone."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from exif import write_jpeg_with_exif
from numpy.typing import NDArray
from photos import texture

from corrsfm import check_photos
from corrsfm.cli import main
from corrsfm.errors import InputError
from corrsfm.images.quality import brightness_stops, hash_distances, perceptual_hash, sharp_detail


def photo(number: int, seed: int = 0) -> NDArray[np.uint8]:
    """A window of a texture of its own, with detail down to single pixels."""
    grain = np.random.default_rng(seed + number).normal(0, 20, (240, 320))
    return np.clip(texture(seed + number)[:240, :320] + grain, 0, 255).astype(np.uint8)


def write(path: Path, image: NDArray[np.uint8]) -> None:
    assert cv2.imwrite(str(path), image)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "photos").mkdir()
    for number in range(6):
        write(tmp_path / "photos" / f"{number}.png", photo(number))
    return tmp_path / "photos"


def kinds(folder: Path) -> dict[str, tuple[str, ...]]:
    return {finding.kind: finding.photos for finding in check_photos(folder).findings}


def test_good_photos_only_lack_a_focal_length(folder: Path) -> None:
    result = check_photos(folder)
    assert kinds(folder).keys() == {"focal"}
    assert result.num_cameras == 1 and not result.stops_a_run
    assert result.kept == [f"{number}.png" for number in range(6)]


@pytest.mark.parametrize("sigma", [2.0, 4.0])
def test_a_blurred_photo_is_found(folder: Path, sigma: float) -> None:
    write(folder / "3.png", cv2.GaussianBlur(photo(3), (0, 0), sigma))
    assert kinds(folder)["blurred"] == ("3.png",)
    assert "3.png" not in check_photos(folder).kept


def test_a_background_out_of_focus_is_no_blur(folder: Path) -> None:
    image = photo(3)
    image[:160] = cv2.GaussianBlur(image, (0, 0), 4.0)[:160]
    write(folder / "3.png", image)
    assert "blurred" not in kinds(folder)


def test_of_photos_that_show_the_same_the_sharpest_stays(folder: Path) -> None:
    write(folder / "copy.jpg", photo(2))
    (folder / "same.png").write_bytes((folder / "4.png").read_bytes())
    finding = next(f for f in check_photos(folder).findings if f.kind == "duplicate")
    assert len(finding.photos) == 2 and "(1 are the same file)" in finding.text
    assert {"copy.jpg", "2.png"} & set(finding.photos) and {"same.png", "4.png"} & set(finding.photos)
    assert len(check_photos(folder).kept) == 6


def test_a_photo_in_the_dark_is_found(folder: Path) -> None:
    write(folder / "5.png", (photo(5) // 4).astype(np.uint8))
    assert kinds(folder)["exposure"] == ("5.png",)


def test_unreadable_photos_stop_a_run(folder: Path) -> None:
    (folder / "7.png").write_bytes(b"no photo")
    assert kinds(folder)["unreadable"] == ("7.png",)
    assert check_photos(folder).stops_a_run
    result = CliRunner().invoke(main, ["check", str(folder)])
    assert result.exit_code == 1
    assert f"next: corrsfm run {folder} scene/ --skip-unreadable" in result.stdout


def test_photos_without_texture_are_no_duplicates(folder: Path) -> None:
    for name in ("black.png", "white.png"):
        write(folder / name, np.full((240, 320), 255 * (name == "white.png"), np.uint8))
    found = kinds(folder)
    assert "duplicate" not in found and set(found["blurred"]) == {"black.png", "white.png"}


def test_two_folders_of_nothing_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        check_photos(tmp_path / "nowhere")


def test_the_list_of_what_to_keep_is_one_for_image_list(folder: Path, tmp_path: Path) -> None:
    write(folder / "3.png", cv2.GaussianBlur(photo(3), (0, 0), 3.0))
    result = CliRunner().invoke(main, ["check", str(folder), "--keep", str(tmp_path / "keep.txt"), "--json"])
    assert result.exit_code == 0
    assert (tmp_path / "keep.txt").read_text().split() == json.loads(result.stdout)["kept"]
    assert "3.png" not in json.loads(result.stdout)["kept"]


def test_half_the_light_is_a_stop_and_hashes_count_bits() -> None:
    grey = np.full((20, 20), 255, np.uint8)
    assert brightness_stops(grey) == 0
    half = np.full((20, 20), round(255 * 0.5 ** (1 / 2.2)), np.uint8)
    assert brightness_stops(half) == pytest.approx(-1, abs=0.02)
    bits = np.array([perceptual_hash(photo(0)), perceptual_hash(photo(1)), ~perceptual_hash(photo(0))])
    distances = hash_distances(bits)
    assert distances[0, 0] == 0 and distances[0, 2] == 256
    assert distances[0, 1] == (bits[0] != bits[1]).sum() == distances[1, 0]
    assert sharp_detail(grey) == 0


def test_masks_that_cannot_be_used_stop_a_run(folder: Path, tmp_path: Path) -> None:
    for name, mask in (
        ("0.png", np.full((240, 320), 255, np.uint8)),
        ("1.png", np.full((320, 240), 255, np.uint8)),
        ("2.png", np.zeros((240, 320), np.uint8)),
    ):
        (tmp_path / "masks").mkdir(exist_ok=True)
        write(tmp_path / "masks" / f"{name}.png", mask)
    result = check_photos(folder, mask_dir=tmp_path / "masks")
    finding = next(f for f in result.findings if f.kind == "masks")
    assert finding.photos == ("1.png", "2.png") and result.stops_a_run
    assert "1.png.png: the mask has 240×320 pixels, its photo 320×240 as stored" in finding.text
    (tmp_path / "none").mkdir()
    lacking = check_photos(folder, mask_dir=tmp_path / "none")
    assert "no mask for any photo" in next(f for f in lacking.findings if f.kind == "masks").text


def test_photos_turned_by_exif_are_named(folder: Path) -> None:
    write_jpeg_with_exif(folder / "turned.jpg", photo(9), orientation=6)
    finding = next(f for f in check_photos(folder).findings if f.kind == "rotation")
    assert finding.photos == ("turned.jpg",) and "used as stored, as COLMAP does" in finding.text
    assert not check_photos(folder).stops_a_run


def test_a_check_of_several_folders_says_what_to_paste(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "more").mkdir()
    write(tmp_path / "more" / "0.png", cv2.GaussianBlur(photo(13), (0, 0), 4.0))
    words = ["check", str(folder), str(tmp_path / "more"), "--no-forecast"]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, result.output
    given = f"{folder} {tmp_path / 'more'}"
    assert f"corrsfm run {given} scene/ --image-list keep.txt" in result.output
    assert "forecast" not in result.output.replace("--no-forecast", "")
