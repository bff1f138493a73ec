"""Who holds a workspace: processes here, machines that see the same files, and those that vanished."""

import errno
import fcntl
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from corrsfm.errors import WorkspaceError
from corrsfm.workspace import lease
from corrsfm.workspace.lease import hold, hold_for_reading

HOLDER = """
import sys, time
from pathlib import Path
from corrsfm.workspace import lease
lease.HOST, lease.BEAT_SECONDS = sys.argv[2], 0.1
with lease.hold(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def holder(path: Path, host: str = lease.HOST) -> subprocess.Popen:
    """A process that holds the lock, here or as if on another machine."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path), host],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def end(process: subprocess.Popen) -> None:
    process.kill()
    process.communicate()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / ".lock"


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lease, "LEASE_SECONDS", 1.0)
    monkeypatch.setattr(lease, "POLL_SECONDS", 0.05)
    monkeypatch.setattr(lease, "SETTLE_SECONDS", 0.1)


@pytest.fixture
def no_locks(monkeypatch: pytest.MonkeyPatch) -> None:
    """A file system that locks within each machine only; here not even that."""

    def refuse(*arguments: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse)


def test_another_process_is_named_and_its_death_frees_the_folder(path: Path) -> None:
    other = holder(path)
    with (
        pytest.raises(WorkspaceError, match=rf"works in this folder \(process {other.pid} on "),
        hold(path),
    ):
        pass
    end(other)
    with hold(path):
        assert path.stat().st_size
    assert path.read_bytes() == b""


@pytest.mark.skipif(sys.platform != "linux", reason="the state of a process is read from /proc")
def test_a_holder_that_is_stopped_is_said_to_be(path: Path) -> None:
    other = holder(path)
    try:
        other.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, other.pid, os.WSTOPPED)
        with pytest.raises(WorkspaceError, match=f"let it go on with: kill -CONT {other.pid}"), hold(path):
            pass
    finally:
        end(other)


def test_a_second_one_may_wait_for_the_first(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    other = holder(path)
    threading.Timer(0.5, other.kill).start()
    with hold(path, wait=True):
        assert f"waiting for another corrsfm (process {other.pid} on " in caplog.text
    end(other)


def test_one_that_waits_makes_a_folder_again_that_the_first_took_away(tmp_path: Path) -> None:
    path = tmp_path / "new" / "scene" / ".lock"
    path.parent.mkdir(parents=True)
    other = holder(path)

    def take_away() -> None:
        shutil.rmtree(tmp_path / "new")
        other.kill()

    threading.Timer(0.5, take_away).start()
    with hold(path, wait=True, make=True):
        assert path.exists()
    end(other)


def test_who_reads_is_kept_out_by_a_holder_here_and_elsewhere(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with hold_for_reading(path):
        pass
    assert not path.exists()
    other = holder(path)
    with pytest.raises(WorkspaceError, match=rf"\(process {other.pid} on "), hold_for_reading(path):
        pass
    end(other)
    other = holder(path, "elsewhere")
    # A lock that is known within each machine only.
    monkeypatch.setattr(fcntl, "flock", lambda *_: None)
    with pytest.raises(WorkspaceError, match=rf"process {other.pid} on elsewhere"), hold_for_reading(path):
        pass
    end(other)


@pytest.mark.usefixtures("short")
def test_who_reads_waits_for_a_machine_that_vanished_and_no_longer(path: Path) -> None:
    end(holder(path, "elsewhere"))
    started = time.monotonic()
    with hold_for_reading(path):
        assert 0.3 < time.monotonic() - started < 20


def test_a_file_of_an_older_corrsfm_or_of_rubbish_is_free(path: Path) -> None:
    for content in (b"", b"{", b"[]", b"[" * 4096, b'{"host": 1}', b"\xff"):
        path.write_bytes(content)
        with hold(path):
            pass


def test_a_hold_of_the_future_is_nobodys(path: Path) -> None:
    """A clock was set back, or the file copied with its time from a machine whose clock is ahead."""
    path.write_text('{"host": "elsewhere", "process": 1, "token": "x"}')
    os.utime(path, (time.time() + 7200,) * 2)
    started = time.monotonic()
    with hold(path):
        assert time.monotonic() - started < 20


@pytest.mark.usefixtures("short", "no_locks")
def test_without_locks_in_the_kernel_the_lease_alone_holds(path: Path) -> None:
    other = holder(path)
    with pytest.raises(WorkspaceError, match="another corrsfm works"), hold(path):
        pass
    end(other)
    with hold(path), pytest.raises(WorkspaceError, match="another corrsfm works"), hold(path):
        pass


@pytest.mark.usefixtures("short", "no_locks")
def test_another_machine_holds_as_long_as_it_shows_signs_of_life(path: Path) -> None:
    other = holder(path, "elsewhere")
    time.sleep(1.5)
    with pytest.raises(WorkspaceError, match="on elsewhere"), hold(path):
        pass
    end(other)
    with hold(path, wait=True):
        pass


@pytest.mark.usefixtures("short")
def test_a_machine_that_the_kernel_knows_nothing_of_gets_time_to_show_that_it_lives(path: Path) -> None:
    other = holder(path, "elsewhere")
    end(other)
    started = time.monotonic()
    with hold(path):
        assert 0.3 < time.monotonic() - started < 20
    path.write_text('{"host": "elsewhere", "process": 1, "token": "t"}')
    threading.Timer(0.5, path.touch).start()
    with pytest.raises(WorkspaceError, match="process 1 on elsewhere"), hold(path):
        pass


@pytest.mark.usefixtures("short")
def test_a_holder_that_slept_is_taken_over_and_ends_itself_when_it_wakes(
    path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other = holder(path, "elsewhere")
    other.send_signal(signal.SIGSTOP)
    # The kernel still holds the lock for it, as a file server does for a machine that lost power.
    with hold(path, wait=True):
        assert f"taken over from another corrsfm (process {other.pid} on elsewhere)" in caplog.text
        other.send_signal(signal.SIGCONT)
        assert other.wait(20) == -signal.SIGTERM
        _, errors = other.communicate()
        assert "was taken over by another corrsfm" in errors
        with pytest.raises(WorkspaceError, match=f"process {os.getpid()} on "), hold(path):
            pass


def test_a_renewed_hold_shows_it_by_the_time_of_change(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lease, "BEAT_SECONDS", 0.05)
    with hold(path):
        os.utime(path, (0, 0))
        deadline = time.monotonic() + 20
        while path.stat().st_mtime == 0 and time.monotonic() < deadline:
            time.sleep(0.02)
        assert time.time() - path.stat().st_mtime < 30
