"""Photos of all kinds are listed and read, or refused by name."""

import errno
import os
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from exif import write_jpeg_with_exif
from numpy.typing import NDArray

from corrsfm.config import ImagesConfig
from corrsfm.errors import ImageError, InputError
from corrsfm.files import sha256_of
from corrsfm.images.index import duplicate_images, index_images, name_remarks
from corrsfm.images.listing import holds_pictures, list_images
from corrsfm.images.photos import read_colour, read_image, read_mask, read_photo_info, read_small


def picture(seed: int = 0, shape: tuple[int, ...] = (48, 64), depth: type = np.uint8) -> NDArray:
    high = np.iinfo(depth).max
    noise = np.random.default_rng(seed).uniform(0, high, shape)
    return cv2.GaussianBlur(noise, (0, 0), 2.0).astype(depth)


def write(path: Path, image: NDArray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    ok, encoded = cv2.imencode(path.suffix.lower(), image)
    assert ok
    encoded.tofile(path)
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Photos in sub-folders, beside what is no photo."""
    photos = tmp_path / "photos"
    for seed, name in enumerate(
        ("b.jpg", "a.PNG", "sub/a.jpg", "sub/deep/Übung 1.TIFF", ".hidden.jpg", ".trash/x.jpg")
    ):
        write(photos / name, picture(seed))
    (photos / "notes.txt").write_text("no photo")
    return photos


def test_photos_are_listed_in_order_without_hidden_and_other_files(folder: Path) -> None:
    assert list_images(folder) == ["a.PNG", "b.jpg", "sub/a.jpg", "sub/deep/Übung 1.TIFF"]


def test_linked_folders_are_followed_and_loops_end(folder: Path, tmp_path: Path) -> None:
    write(tmp_path / "elsewhere" / "z.jpg", picture())
    (folder / "link").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    (folder / "sub" / "loop").symlink_to(folder, target_is_directory=True)
    assert list_images(folder) == ["a.PNG", "b.jpg", "link/z.jpg", "sub/a.jpg", "sub/deep/Übung 1.TIFF"]


def test_a_folder_that_may_not_be_read_is_not_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "closed").mkdir()
    (tmp_path / "a.jpg").touch()
    (tmp_path / "b.jpg").touch()
    scan = os.scandir

    # Tests may run as root, who may read anything.
    def refuse(path: str) -> object:
        if str(path).endswith("closed"):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), path)
        return scan(path)

    monkeypatch.setattr(os, "scandir", refuse)
    with pytest.raises(InputError, match="closed"):
        list_images(tmp_path)
    assert holds_pictures(tmp_path / "closed")


def test_an_image_list_chooses_photos(folder: Path, tmp_path: Path) -> None:
    chosen = tmp_path / "list.txt"
    chosen.write_text("\ufeff# mine\n\n./sub/deep/Übung 1.TIFF\nb.jpg  \nb.jpg\n", encoding="utf-8")
    assert list_images(folder, image_list=chosen) == ["b.jpg", "sub/deep/Übung 1.TIFF"]


def test_an_image_list_with_unknown_names_is_refused_naming_them(folder: Path, tmp_path: Path) -> None:
    chosen = tmp_path / "list.txt"
    chosen.write_text("b.jpg\na.PNG\nnone.jpg\nsub/none.jpg\n")
    with pytest.raises(InputError, match=r"2 photos are not in .*: none\.jpg, sub/none\.jpg"):
        list_images(folder, image_list=chosen)


def test_an_image_list_cannot_leave_the_folder(folder: Path, tmp_path: Path) -> None:
    chosen = tmp_path / "list.txt"
    chosen.write_text("b.jpg\n../list.txt\n")
    with pytest.raises(InputError, match="must be relative"):
        list_images(folder, image_list=chosen)


def test_a_missing_image_list_or_folder_is_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.txt: no such file"):
        list_images(folder, image_list=tmp_path / "none.txt")
    with pytest.raises(InputError, match="nowhere: no such folder"):
        list_images(tmp_path / "nowhere")


def test_fewer_than_two_photos_are_refused_saying_what_is_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no visible files"):
        list_images(tmp_path)
    (tmp_path / "film.mp4").write_bytes(b"")
    with pytest.raises(InputError, match=r"only 1 × \.mp4"):
        list_images(tmp_path)
    write(tmp_path / "one.png", picture())
    with pytest.raises(InputError, match=r"the only photo is 'one\.png'"):
        list_images(tmp_path)


def test_photos_in_formats_that_cannot_be_read_are_counted(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    list_images(folder)
    assert not caplog.messages
    for name in ("c.CR3", "sub/d.cr3", "e.cr2", "b.cr2"):  # b.jpg is there as well
        (folder / name).write_bytes(b"")
    assert len(list_images(folder)) == 4
    expected = "ignored 2 × .cr3, 1 × .cr2: not readable here; convert them to JPEG or TIFF first"
    assert caplog.messages == [expected]


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such names themselves")
def test_names_that_are_not_utf8_are_refused(folder: Path) -> None:
    Path(os.fsdecode(os.fsencode(folder) + b"/caf\xe9.jpg")).write_bytes((folder / "b.jpg").read_bytes())
    with pytest.raises(InputError, match="not valid UTF-8.*rename"):
        list_images(folder)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse some of these names themselves")
@pytest.mark.parametrize("separator", ["\t", "\n", "\r", "\x0b", "\x85", "\u2028"], ids=ascii)
def test_names_that_lists_cannot_hold_are_refused(folder: Path, separator: str) -> None:
    write(folder / f"one{separator}two.png", picture())
    with pytest.raises(InputError, match=r"a tab or a line break.*'one\\.+two\.png'; rename"):
        list_images(folder)


def test_masks_inside_the_folder_are_no_photos(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos = list_images(folder)
    for name in photos:
        write(folder / "sub" / "masks" / f"{name}.png", np.zeros((48, 64), np.uint8))
    assert len(list_images(folder)) == 2 * len(photos)
    assert list_images(folder, mask_dir=folder / "sub" / "masks") == photos
    monkeypatch.chdir(folder / "sub")
    assert list_images(folder, mask_dir=Path("masks")) == photos
    records, _ = index_images(folder, ImagesConfig(mask_dir=Path("masks")))
    assert [(record.name, record.mask) for record in records] == [(name, f"{name}.png") for name in photos]


def test_masks_beside_the_photos_are_no_photos(folder: Path) -> None:
    photos = list_images(folder)
    write(folder / "b.jpg.png", np.zeros((48, 64), np.uint8))
    assert list_images(folder, mask_dir=folder) == photos


def test_remarks_name_what_other_programs_stumble_over() -> None:
    assert name_remarks(["a.jpg", "b/c.jpg"]) == []
    remarks = name_remarks(["my photo.jpg", "a/b.jpg", "a-b.jpg", "A/B.jpg"])
    assert [remark.split(":")[0] for remark in remarks] == [
        "1 name contains spaces, which text files of COLMAP and hloc cannot hold",
        "file systems that ignore case or accents' encoding would mix up",
    ]
    assert remarks[0].endswith(": my photo.jpg; rename them, or keep to corrsfm and pycolmap, which cope")
    assert remarks[1].endswith(": a/b.jpg, A/B.jpg")
    assert name_remarks(["a b.jpg", "c d.jpg"])[0].startswith("2 names contain spaces")


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".bmp", ".tif", ".webp"])
def test_colour_is_read_as_grey(tmp_path: Path, suffix: str) -> None:
    grey = picture()
    image = read_image(write(tmp_path / f"Ünï cödé{suffix}", np.repeat(grey[:, :, None], 3, axis=2)))
    assert image.dtype == np.uint8
    assert image.shape == (48, 64)
    assert np.abs(image.astype(int) - grey).mean() < 4


def test_alpha_and_one_channel_are_read(tmp_path: Path) -> None:
    grey = picture()
    alpha = np.dstack([grey, grey, grey, np.full_like(grey, 7)])
    for name, stored in (("alpha.png", alpha), ("grey.png", grey)):
        assert np.abs(read_image(write(tmp_path / name, stored)).astype(int) - grey).max() <= 1


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_deep_photos_use_the_whole_range(tmp_path: Path, bits: int) -> None:
    stored = picture(depth=np.uint16) >> (16 - bits)
    stored[0, 0] = 2**bits - 1
    image = read_image(write(tmp_path / "deep.png", stored))
    np.testing.assert_array_equal(image, (stored >> (bits - 8)).astype(np.uint8))


def test_floating_point_photos_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r"float\.tif: pixels of type float32; convert"):
        read_image(write(tmp_path / "float.tif", picture().astype(np.float32)))


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".bmp", ".tif", ".webp"])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_cut_off_photos_are_refused_by_name(tmp_path: Path, suffix: str, share: float) -> None:
    path = write(tmp_path / f"cut{suffix}", picture(shape=(200, 300)))
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ImageError, match=rf"cut\{suffix}: .*re-export or remove"):
        read_image(path)


def test_missing_and_fake_photos_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r"none\.jpg: no such file"):
        read_image(tmp_path / "none.jpg")
    (tmp_path / "text.jpg").write_text("no photo at all")
    with pytest.raises(ImageError, match=r"text\.jpg: is damaged, cut off or no photo"):
        read_image(tmp_path / "text.jpg")


def test_exif_orientation_is_not_applied(tmp_path: Path) -> None:
    path = tmp_path / "turned.jpg"
    write_jpeg_with_exif(path, picture(), model="One", focal_35mm=28, orientation=6)
    info = read_photo_info(path)
    assert (info.width, info.height) == (64, 48)
    assert read_image(path).shape == (48, 64)


def test_exif_gives_camera_focal_length_and_position(tmp_path: Path) -> None:
    path = tmp_path / "photo.jpg"
    write_jpeg_with_exif(path, picture(), make="Acme", model="One", focal_35mm=28, gps=(33, 70, 520))
    info = read_photo_info(path)
    assert info.camera_name is not None
    assert info.camera_name.startswith("Acme-One")
    assert info.gps == (-33.0, -70.0, 520.0)
    assert info.focal_px == pytest.approx(pycolmap.infer_camera_from_image(path).mean_focal_length())


def test_zero_coordinates_are_no_position(tmp_path: Path) -> None:
    path = tmp_path / "photo.jpg"
    write_jpeg_with_exif(path, picture(), gps=(0, 0, 0))
    assert read_photo_info(path).gps is None


@pytest.mark.parametrize(
    ("gps", "denominators"),
    [((0, 0, 5), (0, 1)), ((7, 8, 5), (0, 1)), ((4000, 70, 5), (1, 1)), ((33, 181, 5), (1, 1))],
)
def test_coordinates_that_are_not_on_earth_are_no_position(
    tmp_path: Path, gps: tuple[int, int, int], denominators: tuple[int, int]
) -> None:
    path = tmp_path / "photo.jpg"
    write_jpeg_with_exif(path, picture(), gps=gps, gps_denominators=denominators)
    assert read_photo_info(path).gps is None


@pytest.mark.parametrize("metres", [0, 5])
def test_an_altitude_that_is_no_number_is_zero(tmp_path: Path, metres: int) -> None:
    path = tmp_path / "photo.jpg"
    write_jpeg_with_exif(path, picture(), gps=(33, 70, metres), gps_denominators=(1, 0))
    assert read_photo_info(path).gps == (-33.0, -70.0, 0.0)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
def test_photos_without_exif_still_tell_their_size(tmp_path: Path, suffix: str) -> None:
    info = read_photo_info(write(tmp_path / f"plain{suffix}", picture()))
    assert (info.width, info.height, info.camera_name, info.focal_px, info.gps) == (64, 48, None, None, None)


def test_the_index_holds_every_photo_with_its_hash_camera_and_position(tmp_path: Path) -> None:
    for seed, name in enumerate(("a.jpg", "b.jpg")):
        write_jpeg_with_exif(
            tmp_path / name, picture(seed), make="Acme", focal_35mm=28, gps=(10 + seed, 20, 0)
        )
    write(tmp_path / "c.png", picture(2))
    records, cameras = index_images(tmp_path, ImagesConfig(), threads=2)
    assert [(r.name, r.camera_id, r.gps) for r in records] == [
        ("a.jpg", 0, (-10.0, -20.0, 0.0)),
        ("b.jpg", 0, (-11.0, -20.0, 0.0)),
        ("c.png", 1, None),
    ]
    assert [record.sha256 for record in records] == [sha256_of(tmp_path / r.name) for r in records]
    assert [camera.has_prior_focal_length for camera in cameras] == [True, False]


def test_the_index_names_every_unreadable_photo(folder: Path) -> None:
    (folder / "b.jpg").write_bytes(b"")
    (folder / "sub" / "a.jpg").write_bytes(b"nothing")
    with pytest.raises(ImageError, match=r"b\.jpg: the file is empty(.|\n)*a\.jpg: is damaged"):
        index_images(folder, ImagesConfig())


def test_masks_belong_to_photos_by_name(folder: Path, tmp_path: Path) -> None:
    mask = np.zeros((48, 64), np.uint8)
    mask[:, :10] = 255
    write(tmp_path / "masks" / "sub" / "a.jpg.png", mask)
    records, _ = index_images(folder, ImagesConfig(mask_dir=tmp_path / "masks"))
    found = {record.name: record.mask for record in records}
    assert found == {
        "a.PNG": None,
        "b.jpg": None,
        "sub/a.jpg": "sub/a.jpg.png",
        "sub/deep/Übung 1.TIFF": None,
    }
    assert records[2].mask_sha256 == sha256_of(tmp_path / "masks" / "sub" / "a.jpg.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "masks" / "sub" / "a.jpg.png", (48, 64)), mask > 0)


def test_masks_for_no_photo_are_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    with pytest.raises(
        InputError, match=r"no mask for any photo; the mask of 'a\.PNG' must be 'a\.PNG\.png'"
    ):
        index_images(folder, ImagesConfig(mask_dir=tmp_path / "masks"))
    with pytest.raises(InputError, match="no such folder"):
        index_images(folder, ImagesConfig(mask_dir=tmp_path / "none"))


@pytest.mark.parametrize("place", ["masks", "photos/masks"])
def test_masks_are_counted_and_those_of_no_photo_named(
    folder: Path, tmp_path: Path, place: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    masks, mask = tmp_path / place, np.zeros((48, 64), np.uint8)
    for name in ("b.jpg", "sub/a.jpg"):
        write(masks / f"{name}.png", mask)
    index_images(folder, ImagesConfig(mask_dir=masks))
    assert "masks: 2 of 4 photos" in caplog.messages
    assert "to no photo" not in caplog.text
    write(masks / "b.png", mask)
    index_images(folder, ImagesConfig(mask_dir=masks))
    expected = f"{masks}: 1 mask belongs to no photo: b.png; the mask of 'a.PNG' must be 'a.PNG.png'"
    assert caplog.messages[-1] == expected


def test_photos_among_the_masks_are_not_taken_for_masks(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(folder / "b.jpg.png", np.zeros((48, 64), np.uint8))
    index_images(folder, ImagesConfig(mask_dir=folder))
    assert "to no photo" not in caplog.text


def test_a_mask_of_another_size_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.jpg.png", np.zeros((64, 48), np.uint8))
    with pytest.raises(ImageError, match=r"a\.jpg\.png: the mask has 48×64 pixels, its photo 64×48"):
        read_mask(path, (48, 64))


def test_photos_with_the_same_bytes_are_found(folder: Path) -> None:
    (folder / "copy.jpg").write_bytes((folder / "b.jpg").read_bytes())
    (folder / "sub" / "copy.jpg").write_bytes((folder / "b.jpg").read_bytes())
    records, _ = index_images(folder, ImagesConfig())
    assert duplicate_images(records) == [("b.jpg", "copy.jpg", "sub/copy.jpg")]


def test_unreadable_photos_are_left_out_on_request(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((20, 30), np.uint8))
    (tmp_path / "broken.jpg").write_bytes(b"")
    with pytest.raises(ImageError, match=r"broken\.jpg[\s\S]*--skip-unreadable"):
        index_images(tmp_path, ImagesConfig())
    records, _ = index_images(tmp_path, ImagesConfig(skip_unreadable=True))
    assert [record.name for record in records] == ["a.png", "b.png"]
    assert "broken.jpg" in caplog.text


def test_a_pipe_named_like_a_photo_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    for name in ("a.jpg", "b.jpg"):
        (tmp_path / name).touch()
    os.mkfifo(tmp_path / "c.jpg")
    with pytest.raises(InputError, match=r"pipes, devices or folders are named like photos: c\.jpg; remove"):
        list_images(tmp_path)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("size", [(480, 640), (481, 643), (47, 1280), (100, 120)])
def test_a_small_photo_is_the_large_one_scaled_down(
    tmp_path: Path, size: tuple[int, int], suffix: str
) -> None:
    path = write(tmp_path / f"photo{suffix}", cv2.GaussianBlur(picture(1, (*size, 3)), (0, 0), 4.0))
    small, scale = read_small(path, 150)
    large = read_colour(path)
    assert max(small.shape[:2]) == min(150, max(size))
    assert scale == pytest.approx(min(1.0, 150 / max(size)), rel=0.01)
    expected = cv2.resize(large, small.shape[1::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(small.astype(int) - expected).mean() < 2
