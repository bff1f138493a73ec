"""What lies at the places of a workspace's own files: no link elsewhere, no pipe, no folder for a file.

A workspace may come from anybody. What is written there must not land in a file outside, and what is read
must come to an end.
"""

from __future__ import annotations

import os
import re
import shlex
import stat
from collections.abc import Collection
from pathlib import Path

from corrsfm.disk import opening
from corrsfm.errors import WorkspaceError

__all__ = ["check_entries"]

_SIDE_FILE = re.compile(r"\.db-(wal|shm|journal)$")


def check_entries(root: Path, own: Collection[str], *, may_link: bool) -> None:
    """Refuse links, special files, what is closed, and folders and files in each other's place.

    Parameters
    ----------
    root : Path
    own : collection of str
        Names of files and folders in it; only files have a suffix. A folder is looked through. Empty for
        everything.
    may_link : bool
        Whether links are fine, because nothing is written; else folders and databases must be writable too.

    Raises
    ------
    WorkspaceError
        Naming the first one.
    """
    writing = 0 if may_link else os.W_OK
    if not os.access(root, os.R_OK | os.X_OK | writing):
        raise WorkspaceError(opening(root))
    with os.scandir(root) as entries:
        for entry in entries:
            # Beside a database, SQLite keeps its log.
            of_database = _SIDE_FILE.sub(".db", entry.name)
            if own and of_database not in own and entry.name not in own:
                continue
            mode = entry.stat(follow_symlinks=False).st_mode
            if stat.S_ISLNK(mode) and not may_link:
                raise WorkspaceError(
                    f"{entry.path}: is a link, and nothing is written through links; put what it leads to in "
                    f"its place, or run: {_removal(entry.path)}"
                )
            expected = "file" if Path(entry.name).suffix else "folder"
            is_ours = entry.name in own or of_database.endswith(".db")
            if is_ours and not stat.S_ISLNK(mode) and stat.S_ISDIR(mode) != (expected == "folder"):
                raise WorkspaceError(
                    f"{entry.path}: is in the place of a {expected} of the workspace; move it away, or run: "
                    f"{_removal(entry.path)}"
                )
            if stat.S_ISDIR(mode):
                check_entries(Path(entry.path), (), may_link=may_link)
            elif stat.S_ISREG(mode):
                # Other files are replaced, never changed.
                in_place = writing if Path(entry.name).suffix == ".db" else 0
                if not os.access(entry.path, os.R_OK | in_place):
                    raise WorkspaceError(opening(Path(entry.path)))
            elif not stat.S_ISLNK(mode):
                raise WorkspaceError(
                    f"{entry.path}: is a pipe or device, expected a file; run: {_removal(entry.path)}"
                )


def _removal(path: str) -> str:
    is_folder = os.path.isdir(path) and not os.path.islink(path)
    return shlex.join(["rm", *(["-r"] if is_folder else []), path])
