"""Phones' and cameras' formats: HEIC, AVIF, 16-bit TIFF and turned photos, from the file to an export."""

import dataclasses
import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner
from exif import write_jpeg_with_exif
from finished_scene import make_finished_scene
from numpy.typing import NDArray
from photos import texture

from corrsfm import check_photos, export_scene, pipeline
from corrsfm import config as cfg
from corrsfm.cli import main
from corrsfm.errors import DependencyError, ImageError, InputError, WorkspaceError
from corrsfm.files import OWN_RECORD
from corrsfm.images.convert import possible_originals, readable_copies, readable_name
from corrsfm.images.photos import convert_photo, read_colour, read_image, read_photo_info
from corrsfm.workspace import Workspace
from corrsfm.workspace.lists import Index, read_index, write_index
from corrsfm.workspace.stores import features_of

RUN = cfg.RunConfig(threads=1, device="cpu")
FEW = cfg.FeaturesConfig(max_features=200)


def picture(seed: int = 0) -> NDArray[np.uint8]:
    return texture(seed)[:240, :320]


def write_modern(path: Path, image: NDArray[np.uint8], *, orientation: int = 1) -> None:
    """A HEIC or AVIF photo of a camera with a focal length and a position."""
    image_module = pytest.importorskip("PIL.Image")
    if path.suffix.lower() == ".avif":
        pytest.importorskip("PIL.AvifImagePlugin")
    else:
        pytest.importorskip("pillow_heif", reason="the extra heif is not installed").register_heif_opener()
    path.parent.mkdir(parents=True, exist_ok=True)
    jpeg = path.with_suffix(".for_exif")
    write_jpeg_with_exif(
        jpeg, image, make="Acme", model="One", focal_35mm=28, gps=(33, 70, 520), orientation=orientation
    )
    with image_module.open(jpeg, formats=["JPEG"]) as opened:
        exif = opened.info["exif"]
    jpeg.unlink()
    image_module.fromarray(image).convert("RGB").save(path, quality=95, exif=exif)


@pytest.fixture(params=[".heic", ".HEIF", ".avif"])
def modern(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / "photos" / f"a{request.param}"
    write_modern(path, picture())
    return path


def test_pixels_and_exif_are_read(modern: Path) -> None:
    assert np.abs(read_image(modern).astype(int) - picture()).mean() < 3
    assert read_colour(modern).shape == (240, 320, 3)
    info = read_photo_info(modern)
    assert (info.width, info.height, info.gps) == (320, 240, (-33.0, -70.0, 520.0))
    assert info.camera_name is not None and info.camera_name.startswith("Acme-One")
    assert info.focal_px == pytest.approx(28 * np.hypot(320, 240) / np.hypot(36, 24), rel=1e-3)


def test_a_copy_is_a_jpeg_with_the_same_exif_that_colmap_reads(modern: Path, tmp_path: Path) -> None:
    convert_photo(modern, tmp_path / "copy.jpg")
    assert np.abs(read_colour(tmp_path / "copy.jpg").astype(int) - read_colour(modern)).mean() < 2
    assert read_photo_info(tmp_path / "copy.jpg") == read_photo_info(modern)
    assert pycolmap.Bitmap.read(modern, True) is None
    assert pycolmap.Bitmap.read(tmp_path / "copy.jpg", True) is not None


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_cut_off_photos_are_refused(modern: Path, share: float) -> None:
    modern.write_bytes(modern.read_bytes()[: int(share * modern.stat().st_size)])
    for read in (read_image, read_photo_info):
        with pytest.raises(ImageError, match=rf"{modern.name}: (is damaged|the file is empty).*re-export"):
            read(modern)


def test_without_the_extra_the_photo_and_the_extra_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("PIL", "PIL.Image", "PIL.AvifImagePlugin", "pillow_heif"):
        monkeypatch.setitem(sys.modules, module, None)
    photos = tmp_path / "photos"
    photos.mkdir()
    for number in range(2):
        cv2.imwrite(str(photos / f"{number}.png"), picture(number))
    for name in ("IMG_1.HEIC", "IMG_2.HEIC"):
        (photos / name).write_bytes(b"heic")
    with pytest.raises(DependencyError, match=r"reading .*IMG_1\.HEIC .*pip install 'corrsfm\[heif\]'"):
        read_image(photos / "IMG_1.HEIC")
    result = CliRunner().invoke(main, ["extract", str(photos), str(tmp_path / "scene")])
    assert result.exit_code == 1
    assert "IMG_1.HEIC and is not installed; try: pip install 'corrsfm[heif]'; so 1 more" in result.output
    assert "--skip-unreadable" in result.output
    outcome = pipeline.index_photos(
        Workspace(tmp_path / "other", create=True), photos, cfg.ImagesConfig(skip_unreadable=True), RUN
    )
    assert outcome.num_items == 2
    found = {finding.kind: finding for finding in check_photos(photos).findings}["unreadable"]
    assert found.photos == ("IMG_1.HEIC", "IMG_2.HEIC") and "pip install 'corrsfm[heif]'" in found.text


def test_a_heic_photo_is_turned_as_its_container_says(tmp_path: Path) -> None:
    # Saving with a flag turns it into the container's rotation, which decoding applies.
    write_modern(tmp_path / "a.heic", picture(), orientation=6)
    image = read_image(tmp_path / "a.heic")
    assert np.abs(image.astype(int) - np.rot90(picture(), -1)).mean() < 3
    info = read_photo_info(tmp_path / "a.heic")
    assert (info.width, info.height, info.orientation) == (240, 320, 1)


@pytest.fixture
def mixed(tmp_path: Path) -> Path:
    """Two AVIF photos, one of them in a folder, and a JPEG, that overlap."""
    photos = tmp_path / "photos"
    for number, name in enumerate(("a.avif", "sub/b.AVIF", "c.jpg")):
        window = np.ascontiguousarray(texture()[:240, 60 * number : 60 * number + 320])
        if name.lower().endswith(".avif"):
            write_modern(photos / name, window)
        else:
            cv2.imwrite(str(photos / name), window)
    return photos


def test_the_workspace_holds_what_every_program_reads(mixed: Path, tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "scene", create=True)
    pipeline.index_photos(workspace, mixed, cfg.ImagesConfig(), RUN)
    assert read_index(workspace).names == ["a.jpg", "c.jpg", "sub/b.jpg"]
    assert workspace.images_dir == workspace.converted
    assert all(pycolmap.Bitmap.read(workspace.images_dir / n, True) for n in read_index(workspace).names)
    assert (workspace.converted / "c.jpg").readlink() == (mixed / "c.jpg")
    assert workspace.command_for("images") == f"corrsfm extract {mixed} {workspace.root}"
    assert read_index(workspace).records[0].gps == (-33.0, -70.0, 520.0)


def test_copies_in_a_workspace_among_the_photos_are_no_photos(mixed: Path) -> None:
    workspace = Workspace(mixed / "corrsfm", create=True)
    for _ in range(2):
        pipeline.index_photos(workspace, mixed, cfg.ImagesConfig(), RUN)
        assert read_index(workspace).names == ["a.jpg", "c.jpg", "sub/b.jpg"]


def test_photos_are_converted_once_and_again_when_they_change(mixed: Path, tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "scene", create=True)
    pipeline.index_photos(workspace, mixed, cfg.ImagesConfig(), RUN)
    before = {n: (workspace.converted / n).stat().st_mtime_ns for n in ("a.jpg", "sub/b.jpg")}
    pipeline.index_photos(workspace, mixed, cfg.ImagesConfig(), RUN)
    assert before == {n: (workspace.converted / n).stat().st_mtime_ns for n in before}
    write_modern(mixed / "a.avif", 255 - picture())
    pipeline.index_photos(workspace, mixed, cfg.ImagesConfig(), RUN)
    after = {n: (workspace.converted / n).stat().st_mtime_ns for n in before}
    assert after["a.jpg"] != before["a.jpg"] and after["sub/b.jpg"] == before["sub/b.jpg"]
    (mixed / "a.avif").unlink()
    pipeline.index_photos(workspace, mixed, cfg.ImagesConfig(), RUN)
    assert not (workspace.converted / "a.jpg").exists() and (mixed / "c.jpg").is_file()


def test_an_interrupted_conversion_keeps_what_is_whole(
    mixed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    workspace = Workspace(tmp_path / "scene", create=True)

    def stop(path: Path, target: Path) -> None:
        if path.name == "b.AVIF":
            target.write_bytes(b"half")
            raise KeyboardInterrupt
        convert_photo(path, target)

    monkeypatch.setattr("corrsfm.images.convert.convert_photo", stop)
    with pytest.raises(KeyboardInterrupt):
        pipeline.index_photos(workspace, mixed, cfg.ImagesConfig(), RUN)
    assert sorted(p.name for p in workspace.converted.rglob("*.jpg")) == ["a.jpg", "c.jpg"]
    assert not list(workspace.converted.rglob("*.partial"))
    stamp = (workspace.converted / "a.jpg").stat().st_mtime_ns
    monkeypatch.undo()
    pipeline.index_photos(workspace, mixed, cfg.ImagesConfig(), RUN)
    assert (workspace.converted / "a.jpg").stat().st_mtime_ns == stamp
    assert len(read_index(workspace).names) == 3


def test_masks_are_named_like_the_photos_and_not_like_their_copies(mixed: Path, tmp_path: Path) -> None:
    mask = np.zeros((240, 320), np.uint8)
    mask[:, 160:] = 255
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "masks" / "a.avif.png"), mask)
    workspace = Workspace(tmp_path / "scene", create=True)
    pipeline.index_photos(workspace, mixed, cfg.ImagesConfig(mask_dir=tmp_path / "masks"), RUN)
    pipeline.extract_features(workspace, FEW, RUN)
    assert read_index(workspace).records[0].mask == "a.avif.png"
    with features_of(workspace).reader() as read:
        assert read("a.jpg").keypoints[:, 0].min() > 155
        assert read("c.jpg").keypoints[:, 0].min() < 100


def test_a_list_from_a_check_chooses_photos_by_their_own_names(mixed: Path, tmp_path: Path) -> None:
    (tmp_path / "keep.txt").write_text("sub/b.AVIF\nc.jpg\n")
    workspace = Workspace(tmp_path / "scene", create=True)
    pipeline.index_photos(workspace, mixed, cfg.ImagesConfig(image_list=tmp_path / "keep.txt"), RUN)
    assert read_index(workspace).names == ["c.jpg", "sub/b.jpg"]


def test_a_photo_that_is_there_as_jpeg_too_is_taken_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    for name in ("a.jpg", "b.jpg"):
        cv2.imwrite(str(tmp_path / name), picture())
    (tmp_path / "a.HEIC").write_bytes(b"not even read")
    workspace = Workspace(tmp_path / "scene", create=True)
    pipeline.index_photos(workspace, tmp_path, cfg.ImagesConfig(), RUN)
    assert read_index(workspace).names == ["a.jpg", "b.jpg"]
    assert "ignored 1 × .heic: the same photos are there in another format" in caplog.text


def test_two_photos_that_would_have_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"one name: a\.heic, a\.avif; rename one"):
        readable_copies(tmp_path, ["a.heic", "a.avif"], tmp_path / "copies", str)


def test_files_of_others_are_not_replaced_by_copies(tmp_path: Path) -> None:
    (tmp_path / "converted").mkdir()
    (tmp_path / "converted" / "a.jpg").write_bytes(b"mine")
    with pytest.raises(WorkspaceError, match="holds files of others"):
        readable_copies(tmp_path, ["a.heic"], tmp_path / "converted", str)
    assert (tmp_path / "converted" / "a.jpg").read_bytes() == b"mine"


def test_a_record_of_copies_that_leads_out_of_the_folder_removes_nothing(tmp_path: Path) -> None:
    precious = tmp_path / "precious.jpg"
    precious.write_bytes(b"mine")
    folder = tmp_path / "scene" / "converted"
    folder.mkdir(parents=True)
    gone = folder / "gone.jpg"
    gone.write_bytes(b"a copy")
    record = {"../../precious.jpg": "", str(precious): "", "gone.jpg": ""}
    (folder / OWN_RECORD).write_text(json.dumps(record), encoding="utf-8")
    readable_copies(tmp_path, ["precious.jpg"], folder, str)
    assert precious.read_bytes() == b"mine" and not gone.exists()


@pytest.mark.parametrize("name", ["a.avif", "a.heic"])
def test_what_is_no_photo_is_not_decoded_whatever_its_suffix(tmp_path: Path, name: str) -> None:
    image_module = pytest.importorskip("PIL.Image")
    pytest.importorskip("PIL.AvifImagePlugin" if name == "a.avif" else "pillow_heif")
    # Pillow would hand PostScript to another program.
    image_module.fromarray(picture()).save(tmp_path / name, format="EPS")
    with pytest.raises(ImageError, match="no photo"):
        read_image(tmp_path / name)
    image_module.fromarray(picture()).save(tmp_path / name, format="JPEG")
    assert read_image(tmp_path / name).shape == picture().shape


def test_names_of_copies() -> None:
    assert readable_name("sub/IMG.1.HEIC") == "sub/IMG.1.jpg"
    assert readable_name("a.png") == "a.png"
    assert Path("sub/IMG.1.HEIC") in possible_originals(Path("sub/IMG.1.jpg"))


@pytest.mark.parametrize("bits", [12, 16])
@pytest.mark.parametrize("suffix", [".tif", ".png"])
def test_deep_colours_use_the_whole_range(tmp_path: Path, suffix: str, bits: int) -> None:
    deep = (np.dstack([picture(0), picture(1), picture(2)]).astype(np.uint16)) << (bits - 8)
    deep[0, 0] = 2**bits - 1
    cv2.imwrite(str(tmp_path / f"deep{suffix}"), deep)
    np.testing.assert_array_equal(
        read_colour(tmp_path / f"deep{suffix}"), (deep >> (bits - 8)).astype(np.uint8)
    )
    assert read_photo_info(tmp_path / f"deep{suffix}").width == 320


def test_photos_with_floating_point_pixels_are_refused_by_an_extraction(tmp_path: Path) -> None:
    for number in range(2):
        cv2.imwrite(str(tmp_path / f"{number}.tif"), picture().astype(np.float32) / 255)
    result = CliRunner().invoke(main, ["extract", str(tmp_path), str(tmp_path / "scene")])
    assert result.exit_code == 1
    assert "0.tif: pixels of type float32; convert the photo to 8 or 16 bits" in result.output


def test_a_turned_photo_has_one_frame_from_detection_to_export(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for number, flag in enumerate((1, 6)):
        write_jpeg_with_exif(photos / f"{number}.jpg", picture(number), focal_35mm=28, orientation=flag)
    mask = np.zeros((240, 320), np.uint8)
    mask[:, 200:] = 255
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "masks" / "1.jpg.png"), mask)
    workspace = Workspace(tmp_path / "scene", create=True)
    pipeline.index_photos(workspace, photos, cfg.ImagesConfig(mask_dir=tmp_path / "masks"), RUN)
    pipeline.extract_features(workspace, FEW, RUN)
    index = read_index(workspace)
    assert [(camera.width, camera.height) for camera in index.cameras] == [(320, 240)]
    with features_of(workspace).reader() as read:
        keypoints = read("1.jpg").keypoints
    assert keypoints[:, 0].min() > 195 and keypoints[:, 0].max() > 300 and keypoints[:, 1].max() < 240
    # COLMAP's own reader gives the photo the same pixels, whatever the flag.
    seen = pycolmap.Bitmap.read(photos / "1.jpg", False).to_array()
    assert np.abs(seen.squeeze().astype(int) - picture(1)).mean() < 3


def test_a_turned_photo_is_undistorted_as_stored(tmp_path: Path) -> None:
    scene = make_finished_scene(tmp_path / "made", camera="SIMPLE_RADIAL", folder="")
    export_scene(scene.workspace, tmp_path / "as_png", "splat")
    workspace = Workspace(scene.workspace)
    index = read_index(workspace)
    renamed = {name: f"{name[:-4]}.jpg" for name in index.names}
    for name, new in renamed.items():
        write_jpeg_with_exif(scene.photos / new, read_image(scene.photos / name), orientation=6)
    for image in scene.model.images.values():
        image.name = renamed[image.name]
    scene.model.write_binary(scene.workspace / "sparse" / "0")
    records = [dataclasses.replace(record, name=renamed[record.name]) for record in index.records]
    write_index(workspace, Index(records=tuple(records), cameras=index.cameras))
    export_scene(scene.workspace, tmp_path / "as_jpg", "splat")
    for name in scene.names:
        images = [tmp_path / folder / "images" / name for folder in ("as_png", "as_jpg")]
        before, after = read_image(images[0].with_suffix(".png")), read_image(images[1])
        assert np.abs(before.astype(int) - after).mean() < 3
