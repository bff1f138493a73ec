"""Power cuts, simulated: what a disk would hold that kept only what was flushed, at every flush of a command.

A disk holds the content that a file had at its last flush, and the names that a folder had at its last one;
of everything else it holds what it likes. Three likings are tried: none of it; all names, but no contents
(the file of length zero that careless programs find after a crash); and a random part.
"""

from __future__ import annotations

import os
import random
import shutil
import stat
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sandbox import Outcome, run_command

__all__ = ["LIKINGS", "record_cuts"]

LIKINGS = ("nothing", "names", "random")

# SQLite flushes by itself. These files are tested in tests/workspace/test_store.py; here they are whole.
_STORES = ("features.db", "matches.db", "pruned")
_MANIFEST = "workspace.json"


class _Disk:
    """Follows what is flushed below a folder."""

    def __init__(self, root: Path, cuts: Path, is_careless: bool) -> None:
        self._root, self._cuts, self._is_careless = root, cuts, is_careless
        self._fsync = os.fsync
        self._contents: dict[int, bytes] = {}
        self._names: dict[int, dict[str, int]] = {}
        self._num = 0
        # What was there before has been on the disk for long.
        for folder, _, names in os.walk(root):
            self._keep(Path(folder))
            for name in names:
                self._keep(Path(folder) / name)
        os.fsync = self._flush  # type: ignore[assignment]

    def _flush(self, handle: Any) -> None:
        self._fsync(handle)
        number = handle if isinstance(handle, int) else handle.fileno()
        path = Path(os.readlink(f"/proc/self/fd/{number}"))
        if path != self._root.parent and self._root not in (path, *path.parents):
            return
        # The power fails just before this flush, and once more after the last.
        self._cut()
        if stat.S_ISDIR(os.fstat(number).st_mode) or not self._is_careless or _MANIFEST in path.name:
            self._keep(path)

    def _keep(self, path: Path) -> None:
        """Note what the disk holds of a file or folder now."""
        status = path.lstat()
        if stat.S_ISDIR(status.st_mode):
            self._names[status.st_ino] = {entry.name: entry.inode() for entry in os.scandir(path)}
        elif stat.S_ISREG(status.st_mode):
            self._contents[status.st_ino] = path.read_bytes()

    def _cut(self) -> None:
        for liking in LIKINGS:
            if self._root.exists():
                target = self._cuts / f"{self._num:03d} {liking}"
                self._write(self._root, target, liking, random.Random(f"{self._num} {liking}"))
        self._num += 1

    def _write(self, folder: Path, target: Path, liking: str, rng: random.Random) -> None:
        """What would be left of a folder."""
        target.mkdir(parents=True)
        kept = self._names.get(folder.stat().st_ino, {})
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
        by_number = {entry.inode(): entry for entry in entries}
        for entry in entries:
            place = target / entry.name
            flushed = kept.get(entry.name) == entry.inode() or entry.name.startswith(_STORES)
            if not (flushed or liking == "names" or (liking == "random" and rng.random() < 0.5)):
                # What had the name before has it still, under whatever name it is now.
                number = kept.get(entry.name, -1)
                if (before := self._contents.get(number)) is not None:
                    place.write_bytes(before)
                elif (moved := by_number.get(number)) is not None and moved.is_dir():
                    self._write(Path(moved.path), place, liking, rng)
                continue
            if entry.is_symlink():
                place.symlink_to(os.readlink(entry.path))
            elif entry.is_dir():
                trusted = entry.name.startswith(_STORES)
                shutil.copytree(entry.path, place) if trusted else self._write(
                    Path(entry.path), place, liking, rng
                )
            elif entry.name.startswith(_STORES):
                shutil.copyfile(entry.path, place)
            else:
                self._write_file(Path(entry.path), place, liking, rng)

    def _write_file(self, path: Path, place: Path, liking: str, rng: random.Random) -> None:
        content = self._contents.get(path.stat().st_ino, b"")
        now = path.read_bytes()
        if content != now and liking == "random":
            likings = [now, content]
            # A file that grew or was never flushed may be there up to any point, or full of zeros; but SQLite
            # flushes what it changes in a file that was.
            if not content.startswith(b"SQLite"):
                likings += [now[: rng.randrange(len(now) + 1)], bytes(len(now))]
            content = rng.choice(likings)
        place.write_bytes(content)


def record_cuts(
    words: Sequence[str], folder: Path, made: str, *, is_careless: bool = False
) -> tuple[Outcome, list[Path]]:
    """Run a command; copies of what it makes, as power cuts at each of its flushes would leave it.

    Parameters
    ----------
    words : sequence of str
    folder : Path
    made : str
    is_careless : bool
        As if the command had flushed folders and its manifest, but no other file: such cuts must do harm, or
        nothing is shown by those that do none.
    """
    cuts = folder / "cuts"
    cuts.mkdir()

    def follow() -> None:
        _Disk(folder / "work" / made, cuts, is_careless)

    outcome = run_command(words, folder, first=follow)
    return outcome, sorted(cuts.iterdir())
