"""Fixtures shared by all tests."""

# cv2 must be loaded before pycolmap, see test_architecture.py.
import os
from pathlib import Path

import cv2  # noqa: F401
import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the repository."""
    return REPOSITORY


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Folder with real photo scenes and reference numbers; tests that need it skip where it is absent."""
    folder = Path(os.environ.get("CORRSFM_SHARED", REPOSITORY.parent / "shared"))
    if not (folder / "photos" / "splits.json").exists():
        pytest.skip(f"no shared data at {folder}; set CORRSFM_SHARED to a folder with photos/ and parity/")
    return folder
