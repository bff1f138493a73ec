"""Reading models that somebody else wrote, and writing them whole."""

import contextlib
import errno
import resource
from collections.abc import Iterator
from pathlib import Path

import cv2  # noqa: F401  (before pycolmap)
import pycolmap
import pytest

from corrsfm.colmap import models
from corrsfm.colmap.models import read_model, write_model
from corrsfm.errors import InputError


@pytest.fixture
def model(tmp_path: Path) -> Path:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=4, num_points3D=30
    )
    pycolmap.synthesize_dataset(options).write_binary(tmp_path)
    return tmp_path


def test_rigs_of_several_cameras_and_of_cameras_without_a_pose_are_read(tmp_path: Path) -> None:
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=2, num_cameras_per_rig=3, num_frames_per_rig=2, num_points3D=20
    )
    made = pycolmap.synthesize_dataset(options)
    rig = pycolmap.Rig()
    rig.rig_id = 77
    for camera_id in (98, 99):
        camera = pycolmap.Camera.create_from_model_name(camera_id, "PINHOLE", 500, 640, 480)
        made.add_camera(camera)
        if camera_id == 98:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, None)
    made.add_rig(rig)
    made.write_binary(tmp_path)
    read = read_model(tmp_path)
    assert (read.num_rigs(), read.num_frames(), read.num_images()) == (3, 4, 12)


@pytest.mark.parametrize("name", ["frames.bin", "images.bin", "points3D.bin", "rigs.bin"])
def test_files_that_end_elsewhere_than_their_entries_are_refused(model: Path, name: str) -> None:
    assert read_model(model).num_points3D() == 30
    whole = (model / name).read_bytes()
    for content in (
        b"",
        whole[:7],
        whole[: len(whole) // 2],
        whole[:-1],
        whole + b"\0",
        b"\xff" * len(whole),
    ):
        (model / name).write_bytes(content)
        with pytest.raises(InputError, match=r"cannot be read \((?!\[)"):
            read_model(model)


@pytest.mark.parametrize("as_text", [False, True])
def test_a_model_is_written_as_pycolmap_does(model: Path, tmp_path: Path, as_text: bool) -> None:
    given, plain = read_model(model), tmp_path / "plain"
    plain.mkdir()
    (given.write_text if as_text else given.write_binary)(plain)
    write_model(given, tmp_path / "a" / "b", as_text=as_text)
    assert {path.name: path.read_bytes() for path in (tmp_path / "a" / "b").iterdir()} == {
        path.name: path.read_bytes() for path in plain.iterdir()
    }


def test_photos_without_a_pose_are_not_missed(model: Path, tmp_path: Path) -> None:
    given = read_model(model)
    given.deregister_frame(next(iter(given.frames)))
    write_model(given, tmp_path / "out")
    assert read_model(tmp_path / "out").num_reg_images() == 3


@contextlib.contextmanager
def files_of_at_most(num_bytes: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("as_text", [False, True])
def test_a_model_that_finds_no_room_is_refused_and_one_cut_short_is_noticed(
    model: Path, tmp_path: Path, as_text: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = read_model(model)
    with files_of_at_most(1 << 11), pytest.raises(OSError) as refused:
        write_model(given, tmp_path / "out", as_text=as_text)
    assert refused.value.errno == errno.EFBIG and not list((tmp_path / "out").iterdir())
    # Another program takes the room in between.
    monkeypatch.setattr(models, "room_for", lambda *_: contextlib.nullcontext())
    with files_of_at_most(1 << 11), pytest.raises(OSError, match="not whole") as cut:
        write_model(given, tmp_path / "out", as_text=as_text)
    assert cut.value.errno == errno.ENOSPC


def test_names_that_are_not_text_are_refused(model: Path) -> None:
    name = read_model(model).images[1].name.encode()
    content = (model / "images.bin").read_bytes()
    (model / "images.bin").write_bytes(content.replace(name, b"\xff\xfe" + name[2:]))
    with pytest.raises(InputError, match=r"cannot be read \(the name of photo 1 is not UTF-8: b'\\xff\\xfe"):
        read_model(model)
