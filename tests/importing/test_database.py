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
