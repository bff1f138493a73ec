"""A COLMAP database comes in as it is and is not changed."""

import contextlib
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from foreign_files import NUM, write_old_database
from photos import write_photos

import corrsfm
from corrsfm import config as cfg
from corrsfm.errors import InputError
from corrsfm.importing.scene import import_features
from corrsfm.workspace import Workspace


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    write_photos(tmp_path / "photos", 3)
    return tmp_path / "photos"


@pytest.fixture
def names(photos: Path) -> list[str]:
    return sorted(path.name for path in photos.iterdir())


def test_sift_of_an_old_database_comes_in_with_its_matches(
    photos: Path, names: list[str], tmp_path: Path
) -> None:
    path = tmp_path / "database.db"
    # The first photo there is the last here: the pair is turned round.
    write_old_database(path, names[::-1])
    before = path.read_bytes()
    result = import_features(photos, tmp_path / "scene", database=path)
    assert path.read_bytes() == before
    assert (result.kind, result.has_shapes) == (cfg.FeatureKind.SIFT, True)
    assert (result.num_pairs, result.num_matches) == (1, NUM // 2)
    scene = corrsfm.open_workspace(tmp_path / "scene")
    features = scene.features(names[0])
    assert features.descriptors.dtype == np.uint8
    np.testing.assert_array_equal(features.keypoints[2], [2.5, 1.5])
    assert features.scales is not None and (features.scales == 2).all()
    assert scene.pairs == ((names[1], names[2]),)
    np.testing.assert_array_equal(scene.matches(scene.pairs[0]).indices[:, 0], np.arange(1, NUM, 2))
    command = Workspace(tmp_path / "scene").command_for("features")
    assert command.endswith(f"--database {path} --kind sift --overwrite")


def test_a_database_in_a_folder_with_an_odd_name_is_read(
    photos: Path, names: list[str], tmp_path: Path
) -> None:
    folder = tmp_path / "50% of #2?"
    folder.mkdir()
    write_old_database(folder / "database.db", names)
    assert import_features(photos, tmp_path / "scene", database=folder / "database.db").num_pairs == 1


def test_nothing_is_left_beside_a_database(photos: Path, names: list[str], tmp_path: Path) -> None:
    (tmp_path / "own").mkdir()
    path = tmp_path / "own" / "database.db"
    write_old_database(path, names)
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA journal_mode = WAL")
    before = path.read_bytes()
    import_features(photos, tmp_path / "scene", database=path)
    assert list(path.parent.iterdir()) == [path] and path.read_bytes() == before


def test_the_database_that_the_workspace_would_write_is_refused(
    photos: Path, names: list[str], tmp_path: Path
) -> None:
    (tmp_path / "scene").mkdir()
    path = tmp_path / "scene" / "database.db"
    write_old_database(path, names)
    before = path.read_bytes()
    with pytest.raises(InputError, match=r"scene/database\.db: the workspace .* copy this one"):
        import_features(
            photos, tmp_path / "scene", database=tmp_path / "scene" / ".." / "scene" / "database.db"
        )
    assert path.read_bytes() == before and len(list((tmp_path / "scene").iterdir())) == 1


def test_matches_may_be_left(photos: Path, names: list[str], tmp_path: Path) -> None:
    write_old_database(tmp_path / "database.db", names)
    result = import_features(
        photos, tmp_path / "scene", database=tmp_path / "database.db", with_matches=False
    )
    assert result.num_pairs == 0
    assert Workspace(tmp_path / "scene").command_for("features").endswith("--rematch --overwrite")


def test_affine_shapes_become_scale_and_orientation(photos: Path, names: list[str], tmp_path: Path) -> None:
    write_old_database(tmp_path / "database.db", names, columns=6)
    import_features(photos, tmp_path / "scene", database=tmp_path / "database.db")
    features = corrsfm.open_workspace(tmp_path / "scene").features(names[0])
    np.testing.assert_allclose(features.scales, 2)
    np.testing.assert_allclose(features.orientations, np.pi / 2)


def test_positions_alone_have_no_shape(photos: Path, names: list[str], tmp_path: Path) -> None:
    write_old_database(tmp_path / "database.db", names, columns=2)
    result = import_features(photos, tmp_path / "scene", database=tmp_path / "database.db")
    assert not result.has_shapes


def test_bad_databases_are_named(photos: Path, names: list[str], tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    with pytest.raises(InputError, match=r"database\.db: no such file"):
        import_features(photos, tmp_path / "scene", database=path)
    path.write_text("no database")
    with pytest.raises(InputError, match="is not a COLMAP database"):
        import_features(photos, tmp_path / "scene", database=path)
    path.unlink()
    write_old_database(path, names)
    shutil.copy(path, tmp_path / "other.db")
    with sqlite3.connect(path) as database:
        database.execute("UPDATE matches SET data = zeroblob(8)")
    database.close()
    with pytest.raises(InputError, match=f"{names[0]} – {names[1]}: matches of 20 × 2 numbers are 8 bytes"):
        import_features(photos, tmp_path / "scene", database=path)
    with sqlite3.connect(tmp_path / "other.db") as database:
        database.execute("DROP TABLE keypoints")
    database.close()
    with pytest.raises(InputError, match="cannot be read as a COLMAP database"):
        import_features(photos, tmp_path / "scene", database=tmp_path / "other.db")
    assert not (tmp_path / "scene").exists()


def without_keys(table: str, column: str, value: str) -> list[str]:
    """SQL that gives the rows of a table a key which its schema would not let in."""
    return [
        f"CREATE TABLE made AS SELECT * FROM {table}",
        f"DROP TABLE {table}",
        f"ALTER TABLE made RENAME TO {table}",
        f"UPDATE {table} SET {column} = {value}",
    ]


@pytest.mark.parametrize(
    ("statements", "text"),
    [
        (["UPDATE keypoints SET rows = 10, cols = 0, data = x''"], "keypoints of 10 × 0 numbers are 0 bytes"),
        (["UPDATE matches SET rows = 10, cols = 0, data = x''"], "matches of 10 × 0 numbers are 0 bytes"),
        (
            ["UPDATE keypoints SET rows = zeroblob(5000)"],
            r"keypoints of b'.{5,50} × 4 numbers are bytes",
        ),
        (["UPDATE keypoints SET rows = 1e300"], r"keypoints of 1e\+300 × 4 numbers"),
        (["UPDATE keypoints SET data = 'abc'"], "numbers are str, expected whole numbers and bytes"),
        (without_keys("matches", "pair_id", "'abc'"), "matches of pair 'abc', expected a whole number"),
        (without_keys("matches", "pair_id", "NULL"), "matches of pair None, expected a whole number"),
        (without_keys("matches", "pair_id", "1e300"), r"matches of pair 1e\+300, expected a whole number"),
        (
            [*without_keys("images", "image_id", "'abc'"), *without_keys("keypoints", "image_id", "'abc'")],
            "image 'abc' is called",
        ),
        (["UPDATE images SET name = zeroblob(9000)"], "image 1 is called b'.{5,50}, expected"),
        (["UPDATE images SET name = 'same'"], "same: is there twice"),
        (
            ["ALTER TABLE descriptors ADD COLUMN type", "UPDATE descriptors SET type = 'x'"],
            "descriptors of type 'x', expected a number",
        ),
        (
            ["UPDATE matches SET pair_id = 2147483648"],
            "matched with itself; .* pair_id 2147483648, or",
        ),
        (
            ["INSERT INTO matches SELECT 2147483647 * 2 + 1, rows, cols, data FROM matches"],
            "the pair is there twice",
        ),
        (
            ["ALTER TABLE matches RENAME TO mm", "CREATE VIEW MATCHES AS SELECT * FROM mm"],
            "MATCHES is a view, expected a table",
        ),
    ],
)
def test_odd_rows_are_named_in_a_short_message(
    photos: Path, names: list[str], tmp_path: Path, statements: list[str], text: str
) -> None:
    path = tmp_path / "database.db"
    write_old_database(path, names)
    edit(path, *statements)
    with pytest.raises(InputError, match=text) as error:
        import_features(photos, tmp_path / "scene", database=path)
    assert str(path) in str(error.value) and len(str(error.value)) < 300 + len(str(path))
    assert not (tmp_path / "scene").exists()


@pytest.mark.parametrize("value", [np.nan, -1.0, 0.0, np.inf])
def test_scales_that_are_none_are_refused(
    photos: Path, names: list[str], tmp_path: Path, value: float
) -> None:
    path = tmp_path / "database.db"
    write_old_database(path, names)
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        (data,) = database.execute("SELECT data FROM keypoints WHERE image_id = 2").fetchone()
        keypoints = np.frombuffer(data, np.float32).reshape(NUM, 4).copy()
        keypoints[7, 2] = value
        database.execute("UPDATE keypoints SET data = ? WHERE image_id = 2", (keypoints.tobytes(),))
    with pytest.raises(InputError, match=f"{names[1]}: the scale of keypoint 7 is .*; extract"):
        import_features(photos, tmp_path / "scene", database=path)


def test_a_view_of_another_name_does_no_harm(photos: Path, names: list[str], tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    write_old_database(path, names)
    edit(path, "CREATE VIEW mine AS SELECT * FROM matches")
    assert import_features(photos, tmp_path / "scene", database=path).num_pairs == 1


def edit(path: Path, *statements: str) -> None:
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        for statement in statements:
            database.execute(statement)
