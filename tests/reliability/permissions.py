"""Closes files and folders to commands of an ordinary user, follows the advice, and compares the results."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from case import EITHER, FINE, Trial, find_faults
from full_disks import WRITERS, differences_of
from place import Place
from sandbox import contents, run_command

__all__ = ["DOINGS", "Closed", "all_closed", "try_closed", "why_no_users"]

DOINGS = {
    name: WRITERS[name]
    for name in (
        "run", "add", "prune", "reconstruct", "report", "check", "localize", "export splat", "export colmap",
        "export colmap3", "export hloc", "export ply",
    )
}  # fmt: skip
"""What is tried."""

MOST_ROUNDS = 4
FILE_MODES, FOLDER_MODES = (0o000, 0o444, 0o200), (0o000, 0o555, 0o444)
ALL = "everything"
# These change nothing in the workspace.
_READERS = (
    "check",
    "localize",
    "export splat",
    "export colmap",
    "export colmap3",
    "export hloc",
    "export ply",
)
_CHMOD = re.compile(r"(?:with: )(chmod [^;,\n]+)")


@dataclass(frozen=True)
class Closed:
    """A command of a user who has only some rights to a place in the working directory."""

    command: str
    place: str
    mode: int

    @property
    def name(self) -> str:
        """What to call it."""
        return f"{self.command} {self.place} {self.mode:03o}"


def all_closed(scene: Path) -> list[Closed]:
    """Every command with every file and folder of a scene closed, in a fixed order."""
    found = []
    for command in DOINGS:
        places = [*_places(scene), ("photos", True), ("photos/1.jpg", False), (".", True)]
        if command == "run":
            places = places[-3:]
        for place, is_folder in places:
            modes = FOLDER_MODES if is_folder else FILE_MODES
            # A working directory that may not be entered is no matter of the command.
            found += [Closed(command, place, mode) for mode in ((0o555,) if place == "." else modes)]
        found += [Closed(command, ALL, 0o444)] if command in _READERS else []
    return found


def _places(scene: Path) -> Iterator[tuple[str, bool]]:
    """Everything of a workspace, and whether it is a folder."""
    yield "scene", True
    for path in sorted(scene.rglob("*")):
        yield f"scene/{path.relative_to(scene).as_posix()}", path.is_dir()


def why_no_users() -> str:
    """Why no command can be run as an ordinary user; empty if it can."""
    return "" if os.geteuid() == 0 else "only root can give its rights up for the trials and take them back"


def try_closed(closed: Closed, base: Path, folder: Path, expected: dict[str, Any]) -> dict[str, Any]:
    """Run a command where a place is closed, then do what it says until it goes through."""
    writer, work = DOINGS[closed.command], folder / "work"
    work.mkdir(parents=True)
    os.chmod(folder, 0o777)
    words = ["-q", *writer.prepare(Place(base, work))]
    before = contents(work)
    _close(work, closed)
    outcome = run_command(words, folder, as_owner=True)
    trial = Trial(
        arguments=words,
        named=[Path(closed.place).name, "work"],
        writes=[
            writer.makes,
            "scene/log.txt",
            "scene/.lock",
            *(["photos"] if closed.command == "add" else []),
        ],
        expected=FINE if closed.place == ALL else EITHER,
        begins=True,
    )
    faults = find_faults(trial, outcome, before, contents(work), contents(folder / "tmp"))
    said, rounds = outcome.err + outcome.out, 0
    while outcome.code and not faults and rounds < MOST_ROUNDS:
        advised = _CHMOD.findall(outcome.err + outcome.out)
        if not advised:
            faults.append("no advice")
            break
        for command in dict.fromkeys(advised):
            subprocess.run(shlex.split(command), cwd=work, capture_output=True)
        rounds += 1
        outcome = run_command(words, folder, as_owner=True)
        said += f"\n--- {advised}\n{outcome.err}{outcome.out}"
    if outcome.code and not faults:
        faults.append("advice does not help")
    if outcome.code == 0 and not faults:
        faults += differences_of(work, expected)
        faults += [f"not writable: {name}" for name in _closed_of(work / "out")][:3]
    return {"case": closed.name, "faults": faults, "arguments": words, "said": said[-3000:]}


def _close(work: Path, closed: Closed) -> None:
    if closed.place == ALL:
        for path in ((work / "scene"), *(work / "scene").rglob("*")):
            path.chmod(0o555 if path.is_dir() else closed.mode)
    elif (work / closed.place).exists():
        (work / closed.place).chmod(closed.mode)


def _closed_of(folder: Path) -> list[str]:
    """Exported files that their owner may not change."""
    return [str(path) for path in folder.rglob("*") if not path.stat().st_mode & 0o200]
