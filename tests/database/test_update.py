"""A database of which few pairs changed is updated in place, and then equals one written anew."""

import contextlib
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from database_scene import CAMERA, all_matches, kept_pairs, write

from corrsfm.config import DatabaseConfig
from corrsfm.database import verification
from corrsfm.database import write as writing
from corrsfm.database.write import update_database

NONE = np.zeros((0, 2), np.int32)


def by_pair(kept: list[tuple[str, str, np.ndarray]]) -> dict:
    return {(name0, name1): indices for name0, name1, indices in kept}


def fingerprints_of(kept: list[tuple[str, str, np.ndarray]]) -> dict:
    return {pair: f"{len(indices)}" for pair, indices in by_pair(kept).items()}


def update(path: Path, kept: list[tuple[str, str, np.ndarray]], base: str = "base") -> int | None:
    return update_database(
        path,
        base=base,
        fingerprints=fingerprints_of(kept),
        kept=by_pair(kept).__getitem__,
        cameras=[CAMERA],
        config=DatabaseConfig(),
    )


def written(path: Path, kept: list[tuple[str, str, np.ndarray]]) -> Path:
    write(path, kept=kept, base="base", fingerprints=fingerprints_of(kept))
    return path


def contents(path: Path) -> dict[str, list]:
    with contextlib.closing(sqlite3.connect(path)) as database:
        tables = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        return {
            table: sorted(database.execute(f"SELECT * FROM {table}").fetchall(), key=repr) for table in tables
        }


@pytest.fixture
def database(tmp_path: Path) -> Path:
    return written(tmp_path / "database.db", kept_pairs())


def changed_pairs() -> list[list[tuple[str, str, np.ndarray]]]:
    first, second, third = kept_pairs()
    return [
        [first, (*second[:2], all_matches()[5:30]), third],
        [first, second, (*third[:2], all_matches())],
        [first, second],
        [(*first[:2], NONE), second, third],
    ]


@pytest.mark.parametrize("number", range(4))
def test_an_updated_database_equals_one_written_anew(database: Path, tmp_path: Path, number: int) -> None:
    kept = changed_pairs()[number]
    assert update(database, kept) == (0 if len(kept) == 2 else 1)
    assert contents(database) == contents(written(tmp_path / "anew.db", kept))


def test_only_changed_pairs_are_verified(database: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    verify = verification.verify_pairs

    def verify_and_note(path: Path, *arguments: object) -> None:
        with contextlib.closing(sqlite3.connect(path)) as opened:
            asked.extend(
                opened.execute(
                    "SELECT pair_id FROM matches WHERE rows > 0 AND pair_id NOT IN"
                    " (SELECT pair_id FROM two_view_geometries)"
                )
            )
        verify(path, *arguments)

    monkeypatch.setattr(verification, "verify_pairs", verify_and_note)
    assert update(database, kept_pairs()) == 0 and not asked
    assert update(database, changed_pairs()[0]) == 1 and len(asked) == 1


@pytest.mark.parametrize("function", ["_write_pairs", "verify_few_pairs", "remember_pairs"])
def test_an_update_that_was_cut_short_is_finished_by_the_next(
    database: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, function: str
) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    kept = changed_pairs()[0]
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(writing, function, stop)
        update(database, kept)
    # What another program wrote is not ours: without a record of the pair all is written anew.
    if update(database, kept) is None:
        written(database, kept)
    assert contents(database) == contents(written(tmp_path / "anew.db", kept))


def test_other_options_another_program_and_damage_are_no_ground_to_build_on(
    database: Path, tmp_path: Path
) -> None:
    kept = changed_pairs()[0]
    assert update(database, kept, base="another") is None
    assert update(tmp_path / "missing.db", kept) is None
    plain = tmp_path / "plain.db"
    write(plain)
    assert update(plain, kept) is None
    whole = database.read_bytes()
    database.write_bytes(whole[:4096] + bytes(len(whole) - 4096))
    assert update(database, kept) is None
    database.write_bytes(whole)
    with contextlib.closing(sqlite3.connect(database)) as other, other:
        other.execute("DELETE FROM corrsfm_pairs WHERE pair_id = (SELECT min(pair_id) FROM corrsfm_pairs)")
    assert update(database, kept) is None
