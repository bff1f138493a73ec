"""Lets the disk run full under every command that writes, and runs it again once there is space."""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from case import EITHER, Trial, find_faults
from kills import COMMANDS, result_of
from place import Place
from sandbox import contents, leftovers, run_command

__all__ = ["FullDisk", "WRITERS", "all_full_disks", "mounted", "try_full_disk", "why_no_mounts"]

DISK_BYTES = 96 << 20
SPARE_KB = (0, 4, 12, 40, 100, 200, 400, 800, 1600)
_FILLER = "filler"
_QUICK = ["--threads", "1", "--device", "cpu"]
# Of what SQLite keeps beside a store: items that are finished, and found again by the next run.
_KEPT_ITEMS = re.compile(r"(features|matches|ratio|loransac)\.db-wal$")


@dataclass(frozen=True, kw_only=True)
class Writer:
    """A command that writes.

    Attributes
    ----------
    prepare : callable
        Lays out the working directory and returns the words of the command.
    makes : str
        What it writes.
    in_place : bool
        It changes finished files item by item, so that one that fails may leave some of each.
    """

    prepare: Callable[[Place], list[str]]
    makes: str
    in_place: bool = False


def _of_scene(words: list[str], more: list[str]) -> Callable[[Place], list[str]]:
    return lambda place: [*words, str(place.scene()), *more]


def _localize(place: Place) -> list[str]:
    place.file("new.jpg", (place.base / "photos" / "2.jpg").read_bytes())
    return ["localize", str(place.scene()), "new.jpg", "--csv", "out.csv", *_QUICK]


WRITERS: dict[str, Writer] = {
    **{
        name: Writer(prepare=COMMANDS[name].prepare, makes=COMMANDS[name].makes, in_place=True)
        for name in ("run", "add", "import")
    },
    "prune": Writer(prepare=_of_scene(["prune"], ["--method", "loransac", *_QUICK]), makes="scene"),
    "prune again": Writer(
        prepare=_of_scene(["prune"], ["--method", "ratio", "--max-ratio", "0.7", *_QUICK]),
        makes="scene",
        in_place=True,
    ),
    "reconstruct": Writer(prepare=_of_scene(["reconstruct"], ["--overwrite", *_QUICK]), makes="scene"),
    "reconstruct otherwise": Writer(
        prepare=_of_scene(["reconstruct"], ["--max-models-tried", "1", *_QUICK]), makes="scene"
    ),
    "report": Writer(prepare=_of_scene(["report"], []), makes="scene"),
    "check": Writer(prepare=_of_scene(["check"], []), makes="scene"),
    "localize": Writer(prepare=_localize, makes="out.csv"),
    **{
        f"export {target}": Writer(prepare=_of_scene(["export"], ["out", "--for", target]), makes="out")
        for target in ("splat", "nerfstudio", "colmap", "colmap3", "hloc", "openmvs", "bundler", "nvm", "ply")
    },
}
"""What is tried."""


@dataclass(frozen=True)
class FullDisk:
    """A command on a disk with so much space."""

    command: str
    spare_kb: int

    @property
    def name(self) -> str:
        """What to call it."""
        return f"{self.command} with {self.spare_kb} kB"


def all_full_disks() -> list[FullDisk]:
    """Every command with every amount of space, in a fixed order."""
    return [FullDisk(command, spare) for command in WRITERS for spare in SPARE_KB]


def why_no_mounts() -> str:
    """Why no disk can be mounted here; empty if one can."""
    if os.geteuid() != 0:
        return "only root may mount disks"
    with tempfile.TemporaryDirectory() as folder:
        try:
            with mounted(Path(folder)):
                return ""
        except (OSError, subprocess.CalledProcessError) as error:
            return f"no disk can be mounted here ({error})"


@contextlib.contextmanager
def mounted(folder: Path) -> Iterator[None]:
    """A small disk of its own in the place of an empty folder."""
    command = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "none", str(folder)]
    subprocess.run(command, check=True, capture_output=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True, capture_output=True)


def try_full_disk(disk: FullDisk, base: Path, folder: Path, expected: dict[str, Any]) -> dict[str, Any]:
    """Run a command on a disk that is too small for it or just not, and again when there is space."""
    writer, work = WRITERS[disk.command], folder / "work"
    work.mkdir(parents=True)
    os.chmod(folder, 0o777)
    with mounted(work):
        words = ["-q", *writer.prepare(Place(base, work))]
        finished, before = _finished(work), contents(work)
        _fill(work, disk.spare_kb)
        outcome = run_command(words, folder)
        (work / _FILLER).unlink()
        after = {name: what for name, what in contents(work).items() if not _KEPT_ITEMS.search(name)}
        writes = [writer.makes, *(["photos"] if disk.command == "add" else [])]
        trial = Trial(arguments=words, named=[*writes, "scene"], writes=writes, expected=EITHER, begins=True)
        faults = find_faults(trial, outcome, before, after, contents(folder / "tmp"))
        said = outcome.err + outcome.out
        if outcome.code:
            if not re.search(r"disk|space", said):
                faults.append("does not speak of the disk")
            lines = [line for line in outcome.err.splitlines() if not line.startswith("warning")]
            if len(lines) > 1:
                faults.append("more than one line")
            if not writer.in_place:
                now = _finished(work)
                if disk.command == "prune":
                    # Its first step may be through: the models are older than the matches then.
                    now["stages"] = finished["stages"]
                lost = sorted(name for name, what in finished.items() if now.get(name) != what)
                faults += [f"lost or changed: {', '.join(lost[:5])}"] if lost else []
            outcome = run_command(words, folder)
            if outcome.code and disk.command == "import" and "--overwrite" in outcome.err:
                outcome = run_command([*words, "--overwrite"], folder)
            if outcome.code:
                faults.append(f"with space: exit status {outcome.code}")
        said += outcome.err + outcome.out
        if outcome.code == 0:
            faults += differences_of(work, expected)
    return {"case": disk.name, "faults": faults, "arguments": words, "said": said[-3000:]}


def differences_of(work: Path, expected: dict[str, Any]) -> list[str]:
    """What differs from the result of a command that nothing hindered."""
    result = result_of(work)
    if left := leftovers(contents(work)):
        return [f"left at the end: {', '.join(left[:5])}"]
    if other := sorted(
        name for name in result.keys() | expected.keys() if result.get(name) != expected.get(name)
    ):
        return [f"other result: {', '.join(other[:5])}"]
    return []


def _finished(work: Path) -> dict[str, Any]:
    """What lies there and what the workspace says of its stages."""
    found = {name: what for name, what in result_of(work).items() if name != "scene/warnings.json"}
    with contextlib.suppress(FileNotFoundError):
        found["stages"] = json.loads((work / "scene" / "workspace.json").read_text())["stages"]
    return found


def _fill(folder: Path, spare_kb: int) -> None:
    """Fill the disk of a folder but for so much."""
    status = os.statvfs(folder)
    handle = os.open(folder / _FILLER, os.O_WRONLY | os.O_CREAT, 0o600)
    try:
        os.posix_fallocate(handle, 0, status.f_bavail * status.f_frsize - (spare_kb << 10))
    finally:
        os.close(handle)
