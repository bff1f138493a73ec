"""Closed and full streams, scarce memory, a lost folder and signals end in a line or do not matter."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import click
import pytest
from photos import write_photos

from corrsfm.cli.surroundings import drop_bad_settings, told
from corrsfm.errors import CorrsfmError

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}


def shell(text: str, *words: object, where: Path) -> subprocess.CompletedProcess[str]:
    """Run a text in bash in which "$@" is corrsfm with these words."""
    command = ["bash", "-c", text, "bash", sys.executable, "-m", "corrsfm", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, cwd=where, env=ENVIRONMENT)


@pytest.mark.parametrize("streams", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-", "2>/dev/full", ">&- 2>/dev/full"])
def test_work_is_done_whatever_becomes_of_the_log(tmp_path: Path, streams: str) -> None:
    write_photos(tmp_path / "photos", 2)
    words = ["extract", "photos", "scene", "--max-features", "60", "--threads", "1", "--device", "cpu"]
    result = shell(f'"$@" {streams}', *words, where=tmp_path)
    assert result.returncode == 0
    assert "Traceback" not in result.stderr
    assert (tmp_path / "scene" / "matches.db").exists()


def test_too_few_files_are_a_line(tmp_path: Path) -> None:
    result = shell('ulimit -n 9; exec "$@"', "--version", where=tmp_path)
    assert result.returncode == 1
    assert result.stderr == (
        "Error: only 9 files may be open at once; raise the limit with: ulimit -n 1024\n"
    )


def test_a_result_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    result = shell('"$@" >/dev/full', "--help", where=tmp_path)
    assert result.returncode == 1
    assert result.stderr.startswith("Error: standard output: cannot be written (No space left on device)")
    assert result.stderr.count("\n") == 1


def test_a_reader_that_has_seen_enough_ends_a_command_silently(tmp_path: Path) -> None:
    text = '"$@" | true; exit ${PIPESTATUS[0]}'
    result = shell(text, "--help", where=tmp_path)
    assert result.returncode == 128 + signal.SIGPIPE
    assert result.stderr == ""


def test_a_folder_that_is_gone_is_named(tmp_path: Path) -> None:
    result = shell('mkdir gone; cd gone; rmdir ../gone; "$@"', "check", tmp_path, where=tmp_path)
    assert result.returncode == 1
    assert result.stderr.startswith("Error: the current folder is gone")


@pytest.mark.parametrize("kilobytes", [100_000, 500_000])
def test_a_limit_of_memory_is_named(tmp_path: Path, kilobytes: int) -> None:
    write_photos(tmp_path / "photos", 2)
    result = shell(f'ulimit -v {kilobytes}; "$@"', "extract", "photos", "scene", where=tmp_path)
    assert result.returncode == 1
    assert result.stderr.startswith("Error: not enough memory")
    assert result.stderr.count("\n") == 1


def test_settings_that_tqdm_would_stumble_over_are_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {"TQDM_MININTERVAL": "x", "TQDM_MAXINTERVAL": "5", "TQDM_FILE": "x", "TQDM_DISABLE": "1"}
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    drop_bad_settings()
    assert [name for name in settings if name in os.environ] == ["TQDM_MAXINTERVAL", "TQDM_DISABLE"]


@pytest.mark.parametrize(
    "error",
    [MemoryError(), OSError(12, "Cannot allocate memory"), RuntimeError("can't allocate memory: 8 bytes")],
)
def test_memory_that_runs_out_is_told_in_a_line(error: Exception) -> None:
    with pytest.raises(click.ClickException, match="not enough memory"), told(lambda: "go on"):
        raise error


def test_other_errors_of_ours_are_not_taken_for_a_lack_of_memory() -> None:
    with pytest.raises(click.ClickException, match="^no such file$"), told(lambda: "go on"):
        try:
            raise MemoryError
        except MemoryError:
            raise CorrsfmError("no such file") from None


@pytest.mark.parametrize(
    ("number", "word"),
    [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "terminated"), (signal.SIGHUP, "terminated")],
)
def test_a_signal_ends_a_command_in_one_line_and_with_the_status_of_shells(
    tmp_path: Path, number: signal.Signals, word: str
) -> None:
    code = (
        "import signal, time, corrsfm.cli.check\n"
        # Whoever runs the tests in the background may ignore them.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"
        "from corrsfm.cli import main\n"
        "def check(*_):\n"
        "    import pycolmap\n"
        "    print('there', flush=True)\n"
        "    time.sleep(60)\n"
        "main.commands['check'].callback = lambda **_: check()\n"
        "main(['check', 'photos'], prog_name='corrsfm')\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=ENVIRONMENT, cwd=tmp_path,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "there\n"
    process.send_signal(number)
    _, said = process.communicate(timeout=30)
    assert said == f"Error: {word}; run the same command again to go on\n"
    assert process.returncode == 128 + number


def run_code(code: str, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=ENVIRONMENT, cwd=folder
    )


def test_an_interrupted_import_is_not_taken_for_a_missing_package(tmp_path: Path) -> None:
    code = (
        "import os, signal\n"
        "from corrsfm.cli import main\n"
        "from corrsfm.errors import DependencyError\n"
        "def check(**_):\n"
        "    try:\n"
        "        os.kill(os.getpid(), signal.SIGINT)\n"
        "    except KeyboardInterrupt:\n"
        "        raise DependencyError('pycolmap', 'this')\n"
        "main.commands['check'].callback = check\n"
        "main(['check', 'photos'], prog_name='corrsfm')\n"
    )
    result = run_code(code)
    assert (result.returncode, result.stderr.splitlines()) == (
        130, ["Error: interrupted; run the same command again to go on"],
    )  # fmt: skip


def test_a_background_job_that_is_terminated_while_it_imports_says_so(tmp_path: Path) -> None:
    code = (
        "import signal, sys, time\n"
        "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "from corrsfm.cli import main\n"
        "class Finder:\n"
        "    def find_spec(name, path, target=None):\n"
        "        if name == 'decimal':\n"
        "            signal.raise_signal(signal.SIGTERM)\n"
        "def check(**_):\n"
        "    sys.modules.pop('decimal', None)\n"
        "    import decimal\n"
        "    time.sleep(60)\n"
        "sys.meta_path.insert(0, Finder)\n"
        "main.commands['check'].callback = check\n"
        "main(['check', 'photos'], prog_name='corrsfm')\n"
    )
    result = run_code(code)
    assert (result.returncode, result.stderr.splitlines()) == (
        143, ["Error: terminated; run the same command again to go on"],
    )  # fmt: skip


def test_a_terminated_batch_says_so_whatever_its_scenes_do(tmp_path: Path) -> None:
    (tmp_path / "photos" / "a").mkdir(parents=True)
    (tmp_path / "photos" / "a" / "1.png").touch()
    scene = tmp_path / "scene"
    scene.write_text("#!/bin/sh\ntrap '' TERM\ntouch begun\nsleep 60\n")
    scene.chmod(0o755)
    code = (
        "import os, signal, sys, threading, time, corrsfm.batch\n"
        "from corrsfm.cli import main\n"
        "corrsfm.batch.GRACE_SECONDS = 0.5\n"
        "sys.executable = './scene'\n"
        "def terminate():\n"
        "    while not os.path.exists('begun'):\n"
        "        time.sleep(0.02)\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
        "threading.Thread(target=terminate, daemon=True).start()\n"
        "main(['--quiet', 'batch', 'photos', 'out'], prog_name='corrsfm')\n"
    )
    result = run_code(code, tmp_path)
    assert result.returncode == 143
    assert result.stderr.splitlines()[-1].startswith("Error: terminated; ")


def test_a_command_that_is_still_being_loaded_ends_without_a_word(tmp_path: Path) -> None:
    code = (
        "import sys, signal, corrsfm.__main__\n"
        "class Finder:\n"
        "    def find_spec(name, path, target=None):\n"
        "        if name == 'corrsfm.cli':\n"
        "            signal.raise_signal(signal.SIGINT)\n"
        "sys.meta_path.insert(0, Finder)\n"
        "corrsfm.__main__.main()\n"
    )
    result = run_code(code)
    assert (result.returncode, result.stderr) == (130, "")
