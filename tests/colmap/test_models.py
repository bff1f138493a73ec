"""Reading models that somebody else wrote."""

from pathlib import Path

import cv2  # noqa: F401  (before pycolmap)
import pycolmap
import pytest

from corrsfm.colmap.models import read_model
from corrsfm.errors import InputError


@pytest.fixture
def model(tmp_path: Path) -> Path:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=4, num_points3D=30
    )
    pycolmap.synthesize_dataset(options).write_binary(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", ["images.bin", "points3D.bin"])
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
        with pytest.raises(InputError, match="cannot be read"):
            read_model(model)
