"""Starts commands where streams are closed or full, memory is scarce, folders vanish, and signals come.

Unlike the other trials these are whole processes: what is tried is also how the interpreter and the packages
are loaded.
"""

from __future__ import annotations

import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from kills import result_of
from place import NUM_PHOTOS, SCENE_OPTIONS, Place
from sandbox import contents, end_session, leftovers, run_command

__all__ = ["Surrounding", "all_surroundings", "try_surrounding"]

REPOSITORY = Path(__file__).resolve().parents[2]
LIMIT_S = 120.0
NUM_SIGNALS = 20
# A run of the five photos ends before, most often.
LAST_SIGNAL_S = 3.5
# Before, the interpreter itself is being started, and answers for itself.
FIRST_SIGNAL_S = 0.3

RUN = ["run", "photos", "out", *SCENE_OPTIONS]
OTHERS = {
    "help": ["--help"],
    "check": ["check", "scene"],
    "export": ["export", "scene", "exported", "--for", "nerfstudio"],
    "report": ["report", "scene"],
    "prune": ["prune", "scene", "--threads", "1", "--device", "cpu"],
    "add": ["add", "scene", "photos/1.jpg", "--threads", "1"],
}
_RAW = re.compile(
    r"Traceback|Exception ignored|Segmentation|terminate called|Aborted|stack trace|resource_tracker"
    r"|pip install|FATAL"
)


@dataclass(frozen=True, kw_only=True)
class Surrounding:
    """Where and how a command is started.

    Attributes
    ----------
    name : str
    words : sequence of str
        Of the command.
    shell : str
        What starts it, in bash, with the command as its arguments.
    codes : tuple of int
        The exit statuses that are right.
    number : int
        A signal to send while it runs; 0 for none.
    is_held : bool
        Another command holds the scene and is stopped meanwhile.
    """

    name: str
    words: Sequence[str]
    shell: str = 'exec "$@"'
    codes: tuple[int, ...] = (0,)
    number: int = 0
    is_held: bool = False


def all_surroundings() -> list[Surrounding]:
    """Every one, in a fixed order; what is drawn of them is when signals come."""
    return [
        *_streams(),
        *_folders(),
        *_environments(),
        *_memory(),
        *_files(),
        *_links(),
        *_held(),
        *_signals(),
    ]


def _streams() -> list[Surrounding]:
    found = []
    for name, words in {"run": RUN, "help": OTHERS["help"], "check": OTHERS["check"]}.items():
        for closed in product(("", "<&-"), ("", ">&-", ">/dev/full"), ("", "2>&-", "2>/dev/full")):
            if text := " ".join(filter(None, closed)):
                # A result that cannot be written is an error; one that nobody wanted is not.
                code = 1 if ">/dev/full" in closed else 0
                found.append(
                    Surrounding(name=f"{name} {text}", words=words, shell=f'"$@" {text}', codes=(code,))
                )
        pipe = '"$@" | true; exit ${PIPESTATUS[0]}'
        # The reader may end before or after the first line.
        found.append(Surrounding(name=f"{name} | true", words=words, shell=pipe, codes=(0, 141)))
        found.append(Surrounding(name=f"{name} to ascii", words=words, shell='PYTHONIOENCODING=ascii "$@"'))
    return found


def _folders() -> list[Surrounding]:
    gone = 'mkdir gone; cd gone; rmdir ../gone; "$@"'
    return [
        Surrounding(name=f"{name} in a folder that is gone", words=words, shell=gone, codes=(1,))
        for name, words in {"run": RUN, "check": OTHERS["check"], "export": OTHERS["export"]}.items()
    ]


def _environments() -> list[Surrounding]:
    rubbish = [
        "TQDM_MININTERVAL=x", "TQDM_MAXINTERVAL=nan", "TQDM_FILE=x", "TQDM_TOTAL=x", "TQDM_NCOLS=x",
        "TQDM_=x", "TQDM_DISABLE=", "OMP_NUM_THREADS=x", "COLUMNS=x", "HOME=/nowhere", "LANG=x", "LC_ALL=C",
        "TERM=x", "PYTHONIOENCODING=latin1", "PYTHONUTF8=0",
    ]  # fmt: skip
    return [Surrounding(name=f"run {setting}", words=RUN, shell=f'env {setting} "$@"') for setting in rubbish]


def _memory() -> list[Surrounding]:
    limits = [60_000, 100_000, 190_000, 250_000, 400_000, 600_000, 800_000, 1_000_000, 1_200_000, 4_000_000]
    return [
        Surrounding(name=f"run in {kb} kB", words=RUN, shell=f'ulimit -v {kb}; "$@"', codes=(0, 1))
        for kb in limits
    ]


def _files() -> list[Surrounding]:
    limits = [5, 9, 20, 32, 40, 50, 64, 100, 256]
    return [
        Surrounding(name=f"run with {num} files", words=RUN, shell=f'ulimit -n {num}; "$@"', codes=(0, 1))
        for num in limits
    ] + [
        Surrounding(name=f"run with umask {mask}", words=RUN, shell=f'umask {mask}; "$@"')
        for mask in ("000", "077")
    ]


def _links() -> list[Surrounding]:
    ways = {
        "moved": "mv scene away; mv away scene",
        "copied": "cp -a scene old; rm -r scene; mv old scene",
        "hard-linked": "cp -al scene old",
        "reached by a link": "mv scene old; ln -s old scene",
    }
    return [
        Surrounding(name=f"{name} {way}", words=OTHERS[name], shell=f'{text}; "$@"')
        for way, text in ways.items()
        for name in ("check", "export", "report", "prune")
    ]


def _held() -> list[Surrounding]:
    return [
        Surrounding(name=f"{name} beside a stopped run", words=words, codes=(1,), is_held=True)
        for name, words in OTHERS.items()
        if name != "help"
    ]


def _signals() -> list[Surrounding]:
    found = []
    for number, extra in product(
        (signal.SIGINT, signal.SIGTERM), ((), ("--workers", "2"), ("--threads", "2"))
    ):
        for attempt in range(NUM_SIGNALS if not extra else NUM_SIGNALS // 4):
            name = " ".join(["run", *extra, number.name, str(attempt)])
            # After its last line Python's own end leaves the signal to the system.
            codes = 0, 128 + number, -number
            found.append(Surrounding(name=name, words=[*RUN, *extra], codes=codes, number=number))
    return found


def try_surrounding(
    one: Surrounding, base: Path, folder: Path, expected: dict[str, Any], rng: random.Random
) -> dict[str, Any]:
    """Start a command there, judge it, and run it again in peace.

    Parameters
    ----------
    base : Path
        What `make_base` made.
    folder : Path
        To work in.
    expected : dict
        `result_of` an undisturbed run.
    rng : Random
        Draws the moment of a signal.
    """
    for name in ("work", "tmp", "home"):
        (folder / name).mkdir(parents=True)
    place = Place(base, folder / "work")
    place.photos(NUM_PHOTOS)
    if one.words[0] != "run" or one.is_held:
        place.scene()
    holder = _stopped_run(folder) if one.is_held else None
    moment = rng.uniform(FIRST_SIGNAL_S, LAST_SIGNAL_S) if one.number else None
    code, said, orphans = _start(one, folder, moment)
    faults = [f"{orphans} processes left behind"] if orphans else []
    # The system's loader ends the process with words of its own, when a library or a thread finds no memory.
    is_out_of_memory = code == 127 and "cannot allocate memory for thread-local data" in said
    if code not in one.codes and not (is_out_of_memory and "ulimit -v" in one.shell):
        faults.append("hung" if code is None else f"exit status {code}")
    if raw := _RAW.search(said):
        faults.append(f"raw: {raw[0]}")
    if said.count("Error: ") > 1:
        faults.append("several errors")
    # OpenBLAS ends the process by itself when it gets no memory, with a line of its own.
    has_told = "Error: " in said or "OpenBLAS error: Memory allocation" in said
    if code == 1 and not has_told and "2>" not in one.shell:
        faults.append("no message")
    if holder is not None:
        holder.send_signal(signal.SIGCONT)
        if holder.wait(LIMIT_S):
            faults.append("the other one failed")
    if left := leftovers(contents(folder / "work")):
        faults.append(f"half written: {', '.join(left)}")
    # torch makes a cache of its own.
    if kept := [name for name in contents(folder / "tmp") if not name.startswith("torchinductor")]:
        faults.append(f"temporary files: {', '.join(kept[:5])}")
    if one.words[0] == "run":
        faults += _faults_of_result(folder, expected, is_through=code == 0)
    return {
        "case": one.name,
        "faults": faults,
        "code": code,
        "arguments": [one.shell, *one.words, *([f"signal after {moment:.3f} s"] if moment else [])],
        "said": said[-3000:],
    }


def _faults_of_result(folder: Path, expected: dict[str, Any], *, is_through: bool) -> list[str]:
    if not is_through:
        outcome = run_command(RUN, folder)
        if outcome.code:
            return [f"run again: exit status {outcome.code}: {outcome.err[-300:]}"]
    result = result_of(folder / "work")
    if other := sorted(
        name for name in result.keys() | expected.keys() if result.get(name) != expected.get(name)
    ):
        return [f"other results: {', '.join(other[:5])}"]
    return []


def _command(words: Sequence[str]) -> list[str]:
    return [sys.executable, "-m", "corrsfm", *words]


def _environment(folder: Path) -> dict[str, str]:
    return {
        **os.environ,
        "PYTHONPATH": str(REPOSITORY),
        "TMPDIR": str(folder / "tmp"),
        "HOME": str(folder / "home"),
        "COLUMNS": "200",
    }


def _hear_interruptions() -> None:
    # A shell's background jobs ignore Ctrl-C.
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _start(one: Surrounding, folder: Path, moment: float | None) -> tuple[int | None, str, int]:
    """Exit status, None if it hung; what it said; how many processes it left."""
    with open(folder / "said", "w+b") as said:
        process = subprocess.Popen(
            ["bash", "-c", one.shell, "bash", *_command(one.words)],
            cwd=folder / "work", env=_environment(folder), stdin=subprocess.DEVNULL, stdout=said, stderr=said,
            start_new_session=True, preexec_fn=_hear_interruptions,
        )  # fmt: skip
        if moment is not None:
            time.sleep(moment)
            # A terminal sends Ctrl-C to all, a scheduler SIGTERM to the one that it started.
            if one.number == signal.SIGINT and process.poll() is None:
                os.killpg(process.pid, one.number)
            else:
                process.send_signal(one.number)
        try:
            code = process.wait(LIMIT_S)
        except subprocess.TimeoutExpired:
            code = None
        orphans = end_session(process.pid) if code is not None else 0
        if code is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    return code, (folder / "said").read_text("utf-8", "replace"), orphans


def _stopped_run(folder: Path) -> subprocess.Popen[bytes]:
    """A command that works in the scene, and is stopped in the middle."""
    words = ["reconstruct", "scene", "--overwrite", "--threads", "1"]
    process = subprocess.Popen(
        _command(words), cwd=folder / "work", env=_environment(folder),
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    lock = folder / "work" / "scene" / ".lock"
    while not lock.stat().st_size and process.poll() is None:
        time.sleep(0.005)
    process.send_signal(signal.SIGSTOP)
    return process
