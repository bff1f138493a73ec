"""COLMAP's database as a file: whether it is whole, and what its error messages mean."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import marshal
import os
import shutil
import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path

from corrsfm.disk import explain, opening
from corrsfm.errors import DatabaseError

__all__ = [
    "LOG_BYTES",
    "PAIR_BASE",
    "copy_database",
    "copy_errors",
    "database_errors",
    "find_damage",
    "find_strange_table",
    "is_sqlite",
    "is_truncated",
    "open_for_reading",
    "id_of_pair",
    "require_colmap_tables",
    "require_tables",
    "rows_digest",
    "uri_for_reading",
]


PAIR_BASE = 2**31 - 1
"""COLMAP's id of a pair is this times the smaller image id plus the larger."""


LOG_BYTES = 1 << 17
"""Room for what SQLite puts beside a database that pycolmap opens; on a full disk half of it stays there."""


def id_of_pair(image_id0: int, image_id1: int) -> int:
    """COLMAP's id of a pair of images, in either order."""
    return PAIR_BASE * min(image_id0, image_id1) + max(image_id0, image_id1)


_SMALLEST_DISK_BYTES = 1 << 20


_MAGIC = b"SQLite format 3\0"


_HEADER_BYTES = 100


_PATIENCE_S = 5.0
_LARGEST_DIGESTED = 1 << 29


@contextlib.contextmanager
def database_errors(path: Path, shown: Path | None = None) -> Iterator[None]:
    """Translate what pycolmap or SQLite says about a database into a `DatabaseError` with what to try.

    Parameters
    ----------
    path : Path
        The database that the block works on.
    shown : Path, optional
        What to call it in the message, if it has another name while it is made.
    """
    try:
        yield
    except UnicodeDecodeError as error:
        raise DatabaseError(
            f"{shown or path}: damaged, a name there is not UTF-8; delete the file and make it again"
        ) from error
    except (RuntimeError, sqlite3.Error) as error:
        message = f"SQLite error: {error}" if isinstance(error, sqlite3.Error) else str(error)
        explanation = _explain(path, message)
        if explanation is None:
            raise
        raise DatabaseError(f"{shown or path}: {explanation}") from error


def _explain(path: Path, message: str) -> str | None:
    """Cause and remedy of a message of pycolmap's database; None if it is about something else."""
    if "disk is full" in message or "disk I/O error" in message:
        return _FULL
    if "database is locked" in message:
        return _HELD
    if "readonly database" in message:
        if not _is_writable(path):
            return _closed(path)
        return "cannot be written; check the permissions of the file and its folder"
    if "No registered database factory" in message:
        return _explain_unopened(path)
    if "SQLite error" in message:
        return f"{message.rpartition('SQLite error: ')[2]}; delete the file and make it again"
    return None


_FULL = "the disk is full or failing; free some space and run the same command again"


_HELD = "is in use by another program; close it there (COLMAP, another corrsfm) and try again"


def _explain_unopened(path: Path) -> str:
    if not path.parent.is_dir():
        return "its folder does not exist"
    if path.is_dir():
        return "is a folder, expected a COLMAP database"
    if path.exists() and path.stat().st_size:
        try:
            is_database = is_sqlite(path)
        except OSError as error:
            return f"cannot be read ({error.strerror})"
        if not is_database:
            return "is not a COLMAP database; move it away and make it again"
    if shutil.disk_usage(path.parent).free < _SMALLEST_DISK_BYTES:
        return _FULL
    try:
        if _is_locked(path):
            return _HELD
    except sqlite3.DatabaseError as error:
        return f"damaged ({error}); delete the file and make it again"
    if not _is_writable(path):
        return _closed(path)
    return "cannot be opened; check the free space of the disk and the permissions of the file and its folder"


def _is_writable(path: Path) -> bool:
    return os.access(path.parent, os.W_OK) and (not path.exists() or os.access(path, os.W_OK))


def _closed(path: Path) -> str:
    return opening(path).removeprefix(f"{path}: ")


def is_sqlite(path: Path) -> bool:
    """Whether a file begins like an SQLite database."""
    with open(path, "rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def is_truncated(path: Path) -> bool:
    """Whether an SQLite database lacks bytes that its header promises; true of an empty file too.

    Only the header is read, so it is quick for any size, but damage inside the file is not
    found. False for a file that is not an SQLite database.
    """
    size = path.stat().st_size
    with open(path, "rb") as file:
        header = file.read(_HEADER_BYTES)
    if len(header) < _HEADER_BYTES:
        return _MAGIC.startswith(header[: len(_MAGIC)])
    page_size, num_pages = (int.from_bytes(header[start:end]) for start, end in ((16, 18), (28, 32)))
    # The page count is valid only if the last writer updated it.
    counted = header[24:28] == header[92:96]
    return (
        header.startswith(_MAGIC) and counted and size < num_pages * (65536 if page_size == 1 else page_size)
    )


def _is_locked(path: Path) -> bool:
    """Whether another process holds a lock; only asked once pycolmap has given up on the file.

    Raises
    ------
    sqlite3.DatabaseError
        If the file is damaged.
    """
    try:
        uri = f"{path.absolute().as_uri()}?mode=rw"
        with contextlib.closing(sqlite3.connect(uri, uri=True, timeout=0)) as connection:
            connection.execute("BEGIN IMMEDIATE")
            connection.rollback()
    except sqlite3.OperationalError as error:
        return "locked" in str(error)
    return False


@contextlib.contextmanager
def open_for_reading(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a database without changing a byte of it; pycolmap writes into what it only reads.

    Parameters
    ----------
    path : Path

    Raises
    ------
    DatabaseError
        If there is no such database, or it cannot be read.
    """
    if not path.exists():
        raise DatabaseError(f"{path}: no such database; try: corrsfm prune WORKSPACE")
    with (
        database_errors(path),
        contextlib.closing(
            sqlite3.connect(uri_for_reading(path), uri=True, timeout=_PATIENCE_S)
        ) as connection,
    ):
        require_colmap_tables(connection)
        yield connection


# COLMAP's, and ours beside them.
_COLMAP_TABLES = frozenset({
    "cameras", "corrsfm_about", "corrsfm_pairs", "descriptors", "frame_data", "frames", "images", "keypoints",
    "matches", "pose_priors", "rig_sensors", "rigs", "two_view_geometries",
})  # fmt: skip


def require_colmap_tables(connection: sqlite3.Connection) -> None:
    """See `require_tables`, for a database that corrsfm or COLMAP wrote and may write."""
    require_tables(connection, _COLMAP_TABLES, may_have_triggers=False)


def require_tables(
    connection: sqlite3.Connection, names: Collection[str], *, may_have_triggers: bool = True
) -> None:
    """Refuse a file in which a name that is read or written stands for something else than a table.

    A view may never end, and a trigger does more than what is asked. A name that is not there is left to
    whoever asks for it.

    Parameters
    ----------
    connection : sqlite3.Connection
    names : collection of str
        In lower case; SQLite's do not depend on it.
    may_have_triggers : bool
        Whether the tables are only read.

    Raises
    ------
    sqlite3.DatabaseError
    """
    if strange := _strange_table(connection, names, may_have_triggers):
        raise sqlite3.DatabaseError(strange)


def _strange_table(connection: sqlite3.Connection, names: Collection[str], may_have_triggers: bool) -> str:
    """What is no table, or has a trigger; empty if nothing."""
    query = "SELECT type, name, tbl_name, coalesce(rootpage, 0) FROM sqlite_master WHERE type <> 'index'"
    for kind, name, table, page in connection.execute(query):
        if table.lower() not in names:
            continue
        if kind == "trigger" and not may_have_triggers:
            return f"{table} has a trigger"
        # A virtual table has no page of its own.
        if kind == "view" or (kind == "table" and page == 0):
            return f"{name} is a {'virtual table' if kind == 'table' else kind}, expected a table"
    return ""


def uri_for_reading(path: Path) -> str:
    """Under which SQLite reads a database and leaves nothing beside it, unless a log is there already.

    The log holds what another program, or one that was killed, has written last. As URI, because a name may
    hold a question mark or a hash.
    """
    in_use = any(path.with_name(path.name + suffix).exists() for suffix in ("-wal", "-journal"))
    return f"{path.absolute().as_uri()}?{'mode=ro' if in_use else 'immutable=1'}"


def find_damage(path: Path) -> str:
    """What SQLite finds wrong inside a database, empty if nothing; reads all of it and changes nothing."""
    try:
        with open_for_reading(path) as connection:
            (result,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
    except DatabaseError as error:
        return str(error.__cause__ or error)
    return "" if result == "ok" else str(result)


def find_strange_table(path: Path) -> str:
    """What in a database is no table and must be one, empty if nothing; a file that cannot be read has none.

    It costs a look at the schema, where `find_damage` reads everything.
    """
    with (
        contextlib.suppress(sqlite3.Error),
        contextlib.closing(sqlite3.connect(uri_for_reading(path), uri=True)) as connection,
    ):
        return _strange_table(connection, _COLMAP_TABLES, may_have_triggers=False)
    return ""


def rows_digest(path: Path) -> str | None:
    """Hash of the rows of a database, whatever order they lie in; None of a large one.

    It takes about a second for half a GB. Of a damaged one it is no hash, and so equals none.
    """
    if path.stat().st_size > _LARGEST_DIGESTED:
        return None
    digest = hashlib.sha256()
    try:
        with open_for_reading(path) as connection:
            query = "SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name"
            for (table,) in connection.execute(query).fetchall():
                digest.update(str(table).encode())
                columns = len(connection.execute(f'PRAGMA table_info("{table}")').fetchall())
                order = ", ".join(str(number) for number in range(1, min(columns, 2) + 1))
                cursor = connection.execute(f'SELECT * FROM "{table}" ORDER BY {order}')
                # Of this version of marshal's format equal rows are equal bytes.
                while rows := cursor.fetchmany(64):
                    digest.update(marshal.dumps(rows, 2))
    except (DatabaseError, sqlite3.Error):
        return "damaged"
    return digest.hexdigest()


def copy_database(source: Path, target: Path) -> None:
    """Copy a database by SQLite itself, including its write-ahead log.

    Parameters
    ----------
    source : Path
        Not changed; others may read it meanwhile.
    target : Path
        Must not exist.

    Raises
    ------
    DatabaseError
        If the source cannot be read or the target not written.
    """
    # Not a byte of it is changed: it may lie on a read-only disk.
    with (
        open_for_reading(source) as old,
        copy_errors(source, target),
        contextlib.closing(sqlite3.connect(target)) as new,
    ):
        old.backup(new)


@contextlib.contextmanager
def copy_errors(source: Path, target: Path) -> Iterator[None]:
    """Say what SQLite's errors mean while one database is written from another.

    Raises
    ------
    DatabaseError
        Naming the target if its disk is full, else the source.
    """
    try:
        yield
    except sqlite3.Error as error:
        if getattr(error, "sqlite_errorname", "").startswith(("SQLITE_FULL", "SQLITE_IOERR")):
            raise DatabaseError(explain(OSError(errno.ENOSPC, str(error)), target)) from error
        raise DatabaseError(
            f"{source}: cannot be copied to {target.parent} ({error}); close other programs that use it, or "
            "make it again with corrsfm prune --overwrite"
        ) from error
