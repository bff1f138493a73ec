import signal
import subprocess
import sys
from pathlib import Path

import cv2  # noqa: F401  (before pycolmap)
import pycolmap
import pytest

from corrsfm.colmap.log import colmap_log
from corrsfm.colmap.pairs import read_verified_pairs
from corrsfm.colmap.sqlite import is_truncated
from corrsfm.errors import DatabaseError


def test_termination_is_quiet():
    code = (
        "import os, signal\n"
        "from corrsfm.colmap.log import colmap_log\n"
        "with colmap_log():\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert done.returncode == -signal.SIGTERM
    assert done.stderr == b""


def test_errors_go_to_the_file_alone(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with colmap_log(tmp_path / "log.txt"):
        pycolmap.logging.error("no model")
    assert capfd.readouterr() == ("", "")
    assert "no model" in (tmp_path / "log.txt").read_text()


def test_whatever_has_the_name_of_an_unfinished_log_is_removed(tmp_path: Path) -> None:
    (tmp_path / ".log.txt.corrsfm.partial").write_text("left")
    with colmap_log(tmp_path / "log.txt"):
        pycolmap.logging.error("no model")
    assert [path.name for path in tmp_path.iterdir()] == ["log.txt"]


def test_a_database_without_its_end_is_told_from_whole_ones_and_other_files(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    pycolmap.Database.open(path).close()
    whole = path.read_bytes()
    assert not is_truncated(path)
    for size in (0, 10, 99, 100, 5000, len(whole) - 1):
        path.write_bytes(whole[:size])
        assert is_truncated(path), size
    path.write_bytes(b"notes" * 1000)
    assert not is_truncated(path)


def test_a_database_that_sqlite_finds_damaged_is_said_to_be(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    pycolmap.Database.open(path).close()
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(
        DatabaseError, match=r"database\.db: .*malformed.*; delete the file and make it again"
    ):
        read_verified_pairs(path)
