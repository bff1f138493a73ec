"""What can be saved of a damaged item store."""

from __future__ import annotations

import contextlib
import os
import shlex
import sqlite3
from collections.abc import Iterator
from pathlib import Path

from corrsfm.colmap.sqlite import require_tables
from corrsfm.errors import WorkspaceError
from corrsfm.files import atomic_path, share_file
from corrsfm.workspace.rows import WHOLE_ROWS, Row, insert_row, is_intact, new_file, transaction

__all__ = ["readable_rows", "rebuild"]

LARGEST_GAP = 1 << 20
LARGEST_NUMBER = 2**63 - 1
MOST_ROWS_OF_A_PAGE = 4096
STEPS_A_DOUBLING = 64


def rebuild(path: Path, kind: str, aside: Path) -> int:
    """Put a file with the whole items of a damaged one in its place, and the damaged one aside.

    Parameters
    ----------
    path : Path
    kind : str
        Label of the items.
    aside : Path
        Name for the damaged file.

    Returns
    -------
    int
        Number of items that were saved.

    Raises
    ------
    WorkspaceError
        If the damaged file may not be written, or something is in the way.
    sqlite3.Error
        If the new file cannot be written.
    """
    num = 0
    # The damaged file keeps its name until the new one is whole: an interruption must not cost its items.
    with atomic_path(path) as new:
        with new_file(new, kind) as connection, transaction(connection):
            for row in _rows_left(path):
                if is_intact(row):
                    insert_row(connection, row)
                    num += 1
        _put_aside(path, aside)
    return num


def _put_aside(path: Path, aside: Path) -> None:
    """Give the damaged file and its logs another name; a file keeps its own too, until it is replaced."""
    try:
        if path.is_file() and not aside.is_dir():
            share_file(path, aside)
        else:
            os.replace(path, aside)
        for suffix in ("-wal", "-shm", "-journal"):
            with contextlib.suppress(FileNotFoundError):
                os.replace(path.with_name(path.name + suffix), aside.with_name(aside.name + suffix))
    except (IsADirectoryError, NotADirectoryError) as problem:
        raise WorkspaceError(f"{aside}: is in the way; move it away and run again") from problem


def _rows_left(path: Path) -> Iterator[Row]:
    if not path.is_file():
        return
    try:
        yield from readable_rows(path)
    except PermissionError as error:
        raise WorkspaceError(
            f"{path}: damaged, and cannot be mended ({error.strerror}); make it writable, with: "
            f"chmod u+w {shlex.quote(str(path))}"
        ) from error


def readable_rows(path: Path) -> Iterator[Row]:
    """Rows of a damaged file that can be read, one look-up each, so that a broken page costs its own only.

    A file that was cut short is filled up with zeros first: SQLite refuses all of it otherwise.
    """
    _fill_up(path)
    with (
        contextlib.suppress(sqlite3.DatabaseError),
        contextlib.closing(sqlite3.connect(path, isolation_level=None)) as connection,
    ):
        # Of one whose rows are made by a view none are what was written.
        require_tables(connection, ("items", "arrays"))
        connection.text_factory = lambda raw: raw.decode("utf-8", "replace")
        number = 0
        while (found := _next_number(connection, number)) is not None:
            number = found
            with contextlib.suppress(sqlite3.DatabaseError):
                yield from connection.execute(f"{WHOLE_ROWS} WHERE items.number = ?", (number,)).fetchall()


def _fill_up(path: Path) -> None:
    with open(path, "r+b") as file:
        header = file.read(100).ljust(100, b"\0")
        page_size, num_pages = int.from_bytes(header[16:18]), int.from_bytes(header[28:32])
        num_bytes = num_pages * (page_size if page_size > 1 else 65536)
        # A damaged header may promise anything.
        if path.stat().st_size < num_bytes < 2 * path.stat().st_size + LARGEST_GAP:
            file.truncate(num_bytes)


def _next_number(connection: sqlite3.Connection, last: int) -> int | None:
    """The next row number that can be found beyond one; None at the end of the file.

    On a broken page all its rows are missed one by one. Where more are missed, the steps grow with the way,
    since a damaged number may be as large as 2^63; after a step that found a row the way back is searched.
    """
    missed, number = last, last + 1
    while number < LARGEST_NUMBER:
        found = _look_from(connection, number)
        if found is None:
            return None
        if found >= number:
            return _first_between(connection, missed, number, found)
        way = number - last
        missed, number = number, number + (1 if way < MOST_ROWS_OF_A_PAGE else way // STEPS_A_DOUBLING)
    return None


def _first_between(connection: sqlite3.Connection, missed: int, number: int, found: int) -> int:
    """The first row beyond ``missed``, where a look from ``number`` on has found one."""
    while number - missed > 1:
        middle = (missed + number) // 2
        nearer = _look_from(connection, middle)
        if nearer is not None and nearer >= middle:
            number, found = middle, nearer
        else:
            missed = middle
    return found


def _look_from(connection: sqlite3.Connection, number: int) -> int | None:
    """The first row number from one on; None if there is none, a lower one if the page is broken."""
    query = "SELECT min(number) FROM items WHERE number >= ?"
    try:
        (found,) = connection.execute(query, (number,)).fetchone()
    except sqlite3.DatabaseError:
        return number - 1
    # A broken tree may also answer with a row that was not asked for, and again and again.
    return found if found is None else int(found)
