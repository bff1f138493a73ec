"""Fixtures shared by all tests."""

import os
import signal
from pathlib import Path

# Threads of one small operation wait for each other in a loop: beside other work on the machine, tests of
# networks would take ten times as long. Read by torch when it is first imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# A shell's background jobs ignore Ctrl-C, and so would the processes that tests start and interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

# cv2 must be loaded before pycolmap, see test_architecture.py.
import cv2  # noqa: E402, F401
import pytest  # noqa: E402

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
