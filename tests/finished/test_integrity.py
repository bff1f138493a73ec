"""Damaged files are named, and the command that is named makes them again."""

import contextlib
import json
import shlex
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner
from rendered_scene import CONFIG
from scene_to_grow import SceneToGrow, contents, make_scene_to_grow

from corrsfm.cli import main
from corrsfm.finished.check import check_workspace
from corrsfm.finished.integrity import Damage, find_damage
from corrsfm.workspace import Workspace
from corrsfm.workspace.manifest import read_manifest, write_manifest


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> SceneToGrow:
    return make_scene_to_grow(tmp_path_factory.mktemp("whole"))


@pytest.fixture
def workspace(made: SceneToGrow, tmp_path: Path) -> Path:
    return made.copy(tmp_path / "own").workspace


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def drop_a_line(path: Path) -> None:
    path.write_text("".join(path.read_text("utf-8").splitlines(keepends=True)[:-1]), "utf-8")


def change_a_digit(path: Path) -> None:
    text = path.read_text("utf-8")
    place = next(number for number, letter in enumerate(text) if letter.isdigit())
    path.write_text(text[:place] + str((int(text[place]) + 1) % 10) + text[place + 1 :], "utf-8")


def cut_model(path: Path) -> None:
    cut(path / "0" / "images.bin")


def change_a_value(path: Path) -> None:
    with contextlib.closing(sqlite3.connect(path)) as store, store:
        number, data = store.execute("SELECT number, data FROM arrays LIMIT 1").fetchone()
        changed = data[:40] + bytes([data[40] ^ 1]) + data[41:]
        store.execute("UPDATE arrays SET data = ? WHERE number = ?", (changed, number))


def lose_an_item(path: Path) -> None:
    with contextlib.closing(sqlite3.connect(path)) as store, store:
        store.execute("DELETE FROM items WHERE number = 1")


def plant_a_view(path: Path) -> None:
    table = "matches" if path.name == "database.db" else "items"
    with contextlib.closing(sqlite3.connect(path)) as store:
        store.execute(f"ALTER TABLE {table} RENAME TO old")
        store.execute(
            f"CREATE VIEW {table} AS WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n FROM c) "
            "SELECT n AS pair_id, n AS rows, n AS key FROM c"
        )
        store.commit()


@pytest.mark.parametrize(
    ("attribute", "damage", "stage"),
    [
        ("images_json", cut, "images"),
        ("images_json", change_a_digit, "images"),
        ("pair_origins", drop_a_line, "pairs"),
        ("features", cut, "features"),
        ("features", change_a_value, "features"),
        ("features", lose_an_item, "features"),
        ("pairs", Path.unlink, "pairs"),
        ("matches", cut, "matches"),
        ("matches", Path.unlink, "matches"),
        ("pruned", cut, "pruned matches"),
        ("pruned", change_a_value, "pruned matches"),
        ("database", cut, "verified matches"),
        ("database", plant_a_view, "verified matches"),
        ("features", plant_a_view, "features"),
        ("matches", plant_a_view, "matches"),
        ("sparse", cut_model, "models"),
        ("sparse", shutil.rmtree, "models"),
        ("report_json", cut, "report"),
        ("report_html", cut, "report"),
        ("run_json", change_a_digit, "run"),
    ],
)
def test_damage_is_named_and_its_remedy_mends_it(
    workspace: Path, attribute: str, damage: Callable[[Path], object], stage: str
) -> None:
    path = getattr(Workspace(workspace), attribute)
    damage(path)
    before = contents(workspace)
    result = check_workspace(workspace)
    assert contents(workspace) == before
    assert not result.is_usable
    first = result.findings[0]
    assert first.kind == "damage" and str(path) in first.text
    shown = CliRunner().invoke(main, ["check", str(workspace)])
    assert shown.exit_code == 1 and first.next_step in shown.output
    for command in first.next_step.split("; "):
        program, *words = shlex.split(command)
        if program == "rm":
            for word in words[1:]:
                shutil.rmtree(word, ignore_errors=True)
                Path(word).unlink(missing_ok=True)
            continue
        threads = [] if words[0] == "report" else ["--threads", str(CONFIG.run.threads)]
        outcome = CliRunner().invoke(main, ["-q", *words, *threads])
        assert outcome.exit_code == 0, (command, outcome.output)
    assert find_damage(Workspace(workspace)) == []
    assert check_workspace(workspace).is_usable


def test_a_whole_scene_has_no_damage(workspace: Path) -> None:
    assert find_damage(Workspace(workspace)) == []
    result = json.loads(CliRunner().invoke(main, ["check", str(workspace), "--json"]).output)
    assert result["num_registered"] > 2 and result["is_usable"]


@pytest.mark.parametrize("name", ["features.db", "evidence.json", ".photos.json"])
def test_links_in_a_workspace_are_named_with_what_takes_their_place(
    workspace: Path, name: str, tmp_path: Path
) -> None:
    elsewhere, place = tmp_path / "elsewhere", workspace / name
    place.rename(elsewhere)
    place.symlink_to(elsewhere)
    (damage,) = find_damage(Workspace(workspace))
    assert damage.path == place and damage.problem.startswith("is a link")
    assert damage.remedy == f"cp -r --remove-destination {elsewhere} {place}"
    elsewhere.unlink()
    first = find_damage(Workspace(workspace))[0]
    assert first.path == place and first.remedy == f"rm -r {place}"


def test_what_lies_in_the_place_of_the_lock_is_named(workspace: Path) -> None:
    lock = workspace / ".lock"
    lock.unlink()
    lock.mkdir()
    (damage,) = find_damage(Workspace(workspace))
    assert damage.path == lock and damage.remedy == f"rm -r {lock}"


def test_a_report_that_was_removed_is_no_damage(workspace: Path) -> None:
    Workspace(workspace).report_html.unlink()
    assert find_damage(Workspace(workspace)) == []


def test_a_workspace_of_before_reports_were_remembered_has_no_damage(workspace: Path) -> None:
    values = read_manifest(workspace / "workspace.json")
    del values["written"]
    write_manifest(workspace / "workspace.json", values)
    cut(workspace / "report.html")
    assert find_damage(Workspace(workspace)) == []


def test_a_workspace_that_lost_its_manifest_is_not_taken_for_photos(workspace: Path) -> None:
    (workspace / "workspace.json").unlink()
    result = CliRunner().invoke(main, ["check", str(workspace)])
    assert result.exit_code == 1
    assert "is a workspace that lost workspace.json" in result.output
    assert f"corrsfm run PHOTOS {workspace}" in result.output


def test_a_log_that_lies_beside_a_store_is_read_but_not_merged(workspace: Path, tmp_path: Path) -> None:
    path = Workspace(workspace).features
    other = tmp_path / "other.db"
    shutil.copy(path, other)
    with contextlib.closing(sqlite3.connect(other, isolation_level=None)) as store:
        store.execute("PRAGMA journal_mode = WAL")
        store.execute("UPDATE items SET fingerprint = 'x'")
        shutil.copy(f"{other}-wal", f"{path}-wal")
    before = contents(workspace)
    assert [one.path for one in find_damage_reading(workspace)] == [path]
    assert contents(workspace) == before


def find_damage_reading(workspace: Path) -> list[Damage]:
    scene = Workspace(workspace)
    with scene.reading():
        return find_damage(scene)
