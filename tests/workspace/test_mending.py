"""What can be read of a damaged store is read, however it is damaged."""

import random
from pathlib import Path

import numpy as np

from corrsfm.workspace.mending import readable_rows, rebuild
from corrsfm.workspace.rows import insert_row, make_row, new_file, transaction

NUM = 20_000
LEAF = 13  # kind of page of SQLite that holds rows of a table


def test_good_rows_between_broken_pages_are_all_found(tmp_path: Path) -> None:
    path = tmp_path / "items.db"
    with new_file(path, "features") as connection, transaction(connection):
        for number in range(NUM):
            insert_row(connection, make_row(f"{number + 1}", "f", {"a": np.zeros(1, np.uint8)}, {}, 1.0))
    rows = {row[0] for row in readable_rows(path)}
    assert len(rows) == NUM
    content = bytearray(path.read_bytes())
    size = int.from_bytes(content[16:18])
    leaves = [page for page in range(1, len(content) // size) if content[page * size] == LEAF]
    # A long run of broken pages, so that the steps grow, and good ones between broken ones behind it.
    broken = {*leaves[10:-60], *random.Random(1).sample(leaves[-60:], 20)}
    lost = {number for page in broken for number in _row_numbers(content[page * size : (page + 1) * size])}
    for page in broken:
        content[page * size : (page + 1) * size] = b"\xff" * size
    path.write_bytes(content)
    assert NUM // 2 < len(lost) < NUM
    assert {int(row[0]) for row in readable_rows(path)} == set(range(1, NUM + 1)) - lost


def _row_numbers(page: bytes) -> list[int]:
    """Numbers of the rows of a leaf, as SQLite's file format lays them out."""
    num = int.from_bytes(page[3:5])
    starts = [int.from_bytes(page[place : place + 2]) for place in range(8, 8 + 2 * num, 2)]
    return [_varint(page, _varint(page, start)[1])[0] for start in starts]


def _varint(page: bytes, place: int) -> tuple[int, int]:
    """A number of seven bits a byte, and where the next begins."""
    value = 0
    while True:
        value = value << 7 | page[place] & 0x7F
        place += 1
        if not page[place - 1] & 0x80:
            return value, place


def test_a_rebuilt_store_holds_whole_rows_alone(tmp_path: Path) -> None:
    path = tmp_path / "items.db"
    with new_file(path, "features") as connection, transaction(connection):
        for key in "abc":
            insert_row(connection, make_row(key, "f", {"a": np.zeros(1, np.uint8)}, {}, 1.0))
        connection.execute("UPDATE items SET checksum = checksum + 1 WHERE key = 'b'")
    assert rebuild(path, "features", tmp_path / "aside") == 2
    assert [row[0] for row in readable_rows(path)] == ["a", "c"]
    assert [row[0] for row in readable_rows(tmp_path / "aside")] == ["a", "b", "c"]
