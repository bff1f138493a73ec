"""The tables of an item store: how an item lies in its rows, and how rows are told from damaged ones."""

from __future__ import annotations

import contextlib
import json
import math
import sqlite3
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "APPLICATION_ID",
    "FORMAT_VERSION",
    "TABLES",
    "WHOLE_ROWS",
    "create_tables",
    "delete_item",
    "insert_row",
    "is_intact",
    "make_row",
    "new_file",
    "transaction",
    "unpack",
]

FORMAT_VERSION = 1
APPLICATION_ID = 0x6373666D
"""Says "csfm" to programs that look into the header of an SQLite file."""

# Arrays lie apart, so that looking up what is finished does not read them.
_SCHEMA = """
    CREATE TABLE about (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
    CREATE TABLE items (
        number INTEGER PRIMARY KEY, key TEXT UNIQUE NOT NULL, fingerprint TEXT NOT NULL,
        attributes TEXT NOT NULL, seconds REAL NOT NULL, checksum INTEGER NOT NULL);
    CREATE TABLE arrays (
        number INTEGER PRIMARY KEY, layout TEXT NOT NULL, data BLOB NOT NULL, checksum INTEGER NOT NULL);
"""
TABLES = frozenset({"about", "items", "arrays"})
WHOLE_ROWS = (
    "SELECT key, fingerprint, attributes, seconds, items.checksum, layout, data, arrays.checksum"
    " FROM items JOIN arrays USING (number)"
)
"""Everything about items; `make_row` makes such a row, and `insert_row` takes it."""

Row = tuple[Any, ...]


def create_tables(connection: sqlite3.Connection, kind: str) -> None:
    """Make the tables of an empty file."""
    with transaction(connection):
        for statement in _SCHEMA.split(";")[:-1]:
            connection.execute(statement)
        connection.execute("INSERT INTO about VALUES ('kind', ?)", (kind,))
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {FORMAT_VERSION}")


@contextlib.contextmanager
def new_file(path: Path, kind: str) -> Iterator[sqlite3.Connection]:
    """Make a file of no items, and no other beside it."""
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA journal_mode = MEMORY")
        create_tables(connection, kind)
        yield connection


def make_row(
    key: str, fingerprint: str, arrays: Mapping[str, NDArray], attributes: Mapping[str, Any], seconds: float
) -> Row:
    """The row of an item."""
    head = key, fingerprint, json.dumps(attributes, sort_keys=True), float(seconds)
    layout, data = _pack(arrays)
    return (*head, _checksum_of_head(*head), layout, data, _checksum_of_arrays(key, layout, data))


def is_intact(row: Row) -> bool:
    """Whether a row, or the first five columns of one, has the right checksums."""
    if row[4] != _checksum_of_head(*row[:4]):
        return False
    return len(row) == 5 or row[7] == _checksum_of_arrays(row[0], *row[5:7])


def insert_row(connection: sqlite3.Connection, row: Row) -> None:
    """Write a row in place of an older one of its key."""
    connection.execute(
        "DELETE FROM arrays WHERE number IN (SELECT number FROM items WHERE key = ?)", (row[0],)
    )
    cursor = connection.execute(
        "INSERT OR REPLACE INTO items (key, fingerprint, attributes, seconds, checksum)"
        " VALUES (?, ?, ?, ?, ?)",
        row[:5],
    )
    connection.execute("INSERT OR REPLACE INTO arrays VALUES (?, ?, ?, ?)", (cursor.lastrowid, *row[5:]))


def delete_item(connection: sqlite3.Connection, key: str) -> None:
    """Drop an item, if it is there."""
    connection.execute("DELETE FROM arrays WHERE number IN (SELECT number FROM items WHERE key = ?)", (key,))
    connection.execute("DELETE FROM items WHERE key = ?", (key,))


@contextlib.contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[None]:
    """All of what the block writes, or nothing."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
    except BaseException:
        # A full disk may have ended it already.
        with contextlib.suppress(sqlite3.Error):
            connection.execute("ROLLBACK")
        raise
    connection.execute("COMMIT")


def _pack(arrays: Mapping[str, NDArray]) -> tuple[str, bytes]:
    """What lies where, and the values one after the other, little-endian."""
    layout, parts = [], []
    for name, values in arrays.items():
        stored = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
        layout.append([name, stored.dtype.str, list(stored.shape)])
        parts.append(stored.tobytes())
    return json.dumps(layout), b"".join(parts)


def unpack(layout: str, data: bytes) -> dict[str, NDArray]:
    """Arrays of an intact row."""
    arrays, start = {}, 0
    for name, kind, shape in json.loads(layout):
        dtype = np.dtype(kind)
        num = math.prod(shape)
        end = start + num * dtype.itemsize
        arrays[name] = np.frombuffer(data, dtype, num, start).reshape(shape).copy()
        start = end
    return arrays


def _checksum_of_head(key: object, fingerprint: object, attributes: object, seconds: object) -> int:
    # A damaged value may be of another type, whose text differs.
    return zlib.crc32(f"{key}\0{fingerprint}\0{attributes}\0{seconds!r}".encode())


def _checksum_of_arrays(key: object, layout: object, data: object) -> int:
    start = zlib.crc32(f"{key}\0{layout}\0".encode())
    return zlib.crc32(data, start) if isinstance(data, bytes) else -1
