"""The journal of finished items: nothing that is wrong around it costs what it holds."""

import sqlite3
from pathlib import Path

import numpy as np
import pytest

from corrsfm.errors import WorkspaceError
from corrsfm.workspace.journal import Journal

ARRAYS = {"values": np.arange(2000)}


@pytest.fixture
def journal(tmp_path: Path) -> Journal:
    journal = Journal(tmp_path / "features.h5.journal")
    journal.add("a", "1", ARRAYS, {"count": 7})
    journal.close()
    return journal


def assert_holds_a(journal: Journal) -> None:
    assert journal.fingerprints() == {"a": "1"}
    item = journal.read("a", "1")
    assert item is not None
    np.testing.assert_array_equal(item[0]["values"], ARRAYS["values"])
    assert item[1] == {"count": 7}


def test_an_item_comes_back_as_it_went_in(journal: Journal) -> None:
    assert_holds_a(journal)
    assert journal.read("a", "2") is None and journal.read("b", "1") is None


def test_a_journal_held_by_another_program_is_kept(journal: Journal, monkeypatch: pytest.MonkeyPatch) -> None:
    connect = sqlite3.connect
    other = connect(journal.path, isolation_level=None)
    other.execute("PRAGMA journal_mode=DELETE")
    other.execute("BEGIN EXCLUSIVE")
    monkeypatch.setattr(sqlite3, "connect", lambda path, **options: connect(path, timeout=0, **options))
    for use in (
        journal.fingerprints,
        lambda: journal.read("a", "1"),
        lambda: journal.add("b", "1", ARRAYS, {}),
    ):
        with pytest.raises(
            WorkspaceError, match=r"features\.h5\.journal: is in use by another program.*close it"
        ):
            use()
    other.close()
    assert_holds_a(journal)


def test_a_full_disk_costs_no_finished_item(journal: Journal) -> None:
    assert journal.fingerprints() == {"a": "1"}
    assert journal._connection is not None
    (pages,) = journal._connection.execute("PRAGMA page_count").fetchone()
    # SQLite's own way to run out of space.
    journal._connection.execute(f"PRAGMA max_page_count={pages}")
    with pytest.raises(WorkspaceError, match="full.*free some disk space.*finished work is kept"):
        journal.add("b", "1", {"values": np.arange(100_000)}, {})
    assert_holds_a(journal)


def test_a_disk_without_room_to_open_the_journal_costs_no_finished_item(
    journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_room(*arguments: object, **options: object) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(sqlite3, "connect", no_room)
        with pytest.raises(WorkspaceError, match="free some disk space"):
            journal.fingerprints()
    assert_holds_a(journal)


def test_a_file_that_is_no_journal_is_set_aside_and_said(
    journal: Journal, caplog: pytest.LogCaptureFixture
) -> None:
    journal.path.write_bytes(b"not a database at all" * 100)
    assert journal.fingerprints() == {}
    assert "features.h5.journal: damaged (file is not a database)" in caplog.text
    journal.add("b", "1", ARRAYS, {})
    assert journal.fingerprints() == {"b": "1"}
    aside = journal.path.with_name("features.h5.journal.damaged")
    assert aside.read_bytes() == b"not a database at all" * 100


def test_damage_that_shows_only_in_reading_is_set_aside(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    journal = Journal(tmp_path / "journal")
    for number in range(200):
        journal.add(f"{number:04d}", "1", ARRAYS, {})
    journal.close()
    whole = journal.path.read_bytes()
    # The header and the schema are whole; everything behind is not.
    journal.path.write_bytes(whole[:8192] + b"\xa5" * (len(whole) - 8192))
    assert journal.fingerprints() == {}
    assert "journal: damaged (database disk image is malformed); kept as journal.damaged" in caplog.text
    assert (tmp_path / "journal.damaged").stat().st_size == len(whole)


def test_an_item_with_a_wrong_byte_is_not_used(journal: Journal, caplog: pytest.LogCaptureFixture) -> None:
    whole = bytearray(journal.path.read_bytes())
    position = whole.find(np.arange(900, 910).tobytes())
    assert position > 0
    whole[position] ^= 1
    journal.path.write_bytes(whole)
    assert journal.read("a", "1") is None
    assert "a is damaged" in caplog.text
    assert journal.fingerprints() == {}
