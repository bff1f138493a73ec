"""Damages every file of a finished scene in every way, and follows the advice that corrsfm gives."""

from __future__ import annotations

import json
import math
import os
import random
import re
import shlex
import shutil
import sqlite3
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from kills import result_of
from place import IMPORTED_OPTIONS, SCENE_OPTIONS, Place
from sandbox import Outcome, contents, leftovers, run_command

__all__ = ["Damage", "all_damages", "try_damage"]

RUN = {
    "plain": ["run", "photos", "scene", *SCENE_OPTIONS],
    "imported": ["run", "photos", "scene", *IMPORTED_OPTIONS],
    "grown": ["run", "photos", "scene", *SCENE_OPTIONS],
}
"""Scenes that are damaged: reconstructed, imported from another tool, with a photo added later."""
ONLY_OF = {
    "imported": ("features.db", "matches.db", "pairs.txt", "pair_origins.tsv", "workspace.json", "images.json"),
    "grown": (
        "added.json", "database.db", "pairs.txt", "pair_origins.tsv", "workspace.json", "images.json",
        "cameras.json", "evidence.json", "sparse", "sparse/0", "sparse/0/images.bin",
    ),
}  # fmt: skip
"""What of them is not as in the first."""
OTHERS: dict[str, list[str]] = {
    "pairs": ["pairs", "scene", "--threads", "1"],
    "match": ["match", "scene", "--threads", "1"],
    "prune": ["prune", "scene", "--threads", "1"],
    "reconstruct": ["reconstruct", "scene", "--threads", "1"],
    "report": ["report", "scene"],
    "export": ["export", "scene", "out", "--for", "hloc"],
    "localize": ["localize", "scene", "photos/2.jpg", "--threads", "1"],
    "evaluate": ["evaluate", "scene", "scene", "--ground-truth", "truth", "--seeds", "1", "--threads", "1"],
    "add": ["add", "scene", "new.jpg", "--threads", "1"],
}
"""Commands that read a scene."""

_WAYS_OF_LOCKS = ("a folder", "a pipe", "noise")
"""A lock is only there while somebody works."""

MOST_ROUNDS = 4
# Numbers that may be right, with the checksum of them, and what a later version would write: must not be
# stumbled over, but cannot be noticed or mended.
_UNKNOWABLE = ("row high", "format_version is number")
_RAW = re.compile(r"Traceback \(most recent|Segmentation|terminate called")
_COMMAND = re.compile(r"(?:run|with|try|next):? ((?:corrsfm|rm) [^;\n]*(?:; corrsfm [^;\n]*)*)")


@dataclass(frozen=True, kw_only=True)
class Damage:
    """A way to spoil a file or folder of a scene.

    Attributes
    ----------
    name : str
    scene : str
    path : str
        Relative to the scene.
    spoil : callable
        Of the path, and of the same file of another scene.
    """

    name: str
    scene: str
    path: str
    spoil: Callable[[Path, Path], object]


def all_damages(base: Path) -> list[Damage]:
    """Every file of every scene × every way, in a fixed order."""
    found = _damages_of("plain", base / "scene")
    for scene, names in ONLY_OF.items():
        found += [one for one in _damages_of(scene, base / f"{scene}_scene") if one.path in names]
    return found


def _damages_of(scene: str, folder: Path) -> list[Damage]:
    found = []
    for name in sorted(contents(folder)):
        path = folder / name
        if path.is_dir():
            ways = _ways_of_folders()
        elif name == ".lock":
            ways = {way: spoil for way, spoil in _ways_of_files(name).items() if way in _WAYS_OF_LOCKS}
        else:
            ways = {**_ways_of_files(name), **_ways_of_json(path), **_ways_of_stores(name)}
        label = name if scene == "plain" else f"{scene} {name}"
        found += [
            Damage(name=f"{label} {way}", scene=scene, path=name, spoil=spoil) for way, spoil in ways.items()
        ]
    return found


def _on_bytes(change: Callable[[bytearray, random.Random], bytes | bytearray], seed: str) -> Callable:
    def spoil(path: Path, _: Path) -> None:
        path.write_bytes(change(bytearray(path.read_bytes()), random.Random(seed)))

    return spoil


def _flip(content: bytearray, rng: random.Random, first: int = 0, last: int | None = None) -> bytearray:
    place = rng.randrange(first, max(first + 1, min(last or len(content), len(content))))
    if content:
        content[min(place, len(content) - 1)] ^= 1 << rng.randrange(8)
    return content


def _zero(content: bytearray, rng: random.Random) -> bytearray:
    start = rng.randrange(max(1, len(content)))
    size = min(512, len(content) - start)
    content[start : start + size] = bytes(size)
    return content


def _double(content: bytearray, rng: random.Random) -> bytearray:
    start = rng.randrange(max(1, len(content)))
    return content[:start] + content[max(0, start - 512) : start] + content[start:]


def _exchange(content: bytearray, rng: random.Random) -> bytearray:
    size = min(256, len(content) // 2)
    first = rng.randrange(max(1, len(content) - 2 * size))
    content[first : first + 2 * size] = (
        content[first + size : first + 2 * size] + content[first : first + size]
    )
    return content


def _spoil_text(content: bytearray, rng: random.Random) -> bytearray:
    """Make a photo's name, wherever it is, something else than UTF-8."""
    places = [found.start() for found in re.finditer(rb"\.jpg", content)]
    if places:
        content[rng.choice(places) + 1] ^= 0x80
    return content


# Where COLMAP's files hold the focal length of the first camera, and where its first point is.
_FIRST_NUMBERS = {"cameras.bin": 32, "points3D.bin": 16}


def _ways_of_files(name: str) -> dict[str, Callable]:
    def way(change: Callable, label: str) -> Callable:
        return _on_bytes(change, f"{name} {label}")

    ways: dict[str, Callable] = {
        "emptied": way(lambda content, _: b"", ""),
        "one byte": way(lambda content, _: content[:1], ""),
        "cut half": way(lambda content, _: content[: len(content) // 2], ""),
        "cut a byte": way(lambda content, _: content[:-1], ""),
        "cut 7/8": way(lambda content, _: content[: 7 * len(content) // 8], ""),
        "zeros": way(lambda content, _: bytes(len(content)), ""),
        "zeros begin": way(lambda content, _: bytes(min(100, len(content))) + content[100:], ""),
        "zeros end": way(lambda content, _: content[:-200] + bytes(min(200, len(content))), ""),
        "noise": way(lambda content, rng: rng.randbytes(len(content)), ""),
        "tail": way(lambda content, rng: content + rng.randbytes(1000), ""),
        "gone": lambda path, _: path.unlink(),
        "of another scene": lambda path, other: shutil.copyfile(other, path) if other.exists() else None,
        "a folder": lambda path, _: (path.unlink(), path.mkdir()),
        "a pipe": lambda path, _: (path.unlink(), os.mkfifo(path)),
    }
    for number in range(6):
        ways[f"flip {number}"] = way(_flip, f"flip {number}")
    for number in range(2):
        ways[f"flip head {number}"] = way(lambda c, rng: _flip(c, rng, 0, 100), f"head {number}")
        ways[f"zero block {number}"] = way(_zero, f"zero {number}")
        ways[f"double block {number}"] = way(_double, f"double {number}")
        ways[f"exchange blocks {number}"] = way(_exchange, f"exchange {number}")
    if name.endswith(".db"):
        for number in range(3):
            ways[f"no text {number}"] = way(_spoil_text, f"no text {number}")
        ways["log a folder"] = lambda path, _: path.with_name(f"{path.name}-wal").mkdir()
        ways["journal a folder"] = lambda path, _: path.with_name(f"{path.name}-journal").mkdir()
    if (place := _FIRST_NUMBERS.get(Path(name).name)) is not None:
        for label, value in (("nan", math.nan), ("negative", -1e300), ("infinite", math.inf)):
            number = struct.pack("<d", value)
            ways[f"number {label}"] = way(lambda c, _, n=number: c[:place] + n + c[place + 8 :], label)
    return ways


def _ways_of_folders() -> dict[str, Callable]:
    return {
        "gone": lambda path, _: shutil.rmtree(path),
        "emptied": lambda path, _: (shutil.rmtree(path), path.mkdir()),
        "a file": lambda path, _: (shutil.rmtree(path), path.write_bytes(b"x")),
        "of another scene": lambda path, other: (shutil.rmtree(path), shutil.copytree(other, path)),
    }


def _ways_of_json(path: Path) -> dict[str, Callable]:
    """Wrong types at every key of a JSON file, and values that are no JSON."""
    if path.suffix != ".json":
        return {}

    def at(key: str, value: Any) -> Callable:
        def spoil(where: Path, _: Path) -> None:
            values = json.loads(where.read_text("utf-8"))
            values[key] = value
            where.write_text(json.dumps(values), "utf-8")

        return spoil

    def whole(text: str) -> Callable:
        return lambda where, _: where.write_text(text, "utf-8")

    ways: dict[str, Callable] = {
        "a list": whole("[]"), "null": whole("null"), "a number": whole("3"), "empty": whole("{}"),
        "deep": whole("[" * 100_000), "digits": whole("9" * 10_000),
    }  # fmt: skip
    values = json.loads(path.read_text("utf-8"))
    if isinstance(values, dict):
        for key in list(values)[:8]:
            for label, value in (
                ("null", None),
                ("text", "x"),
                ("number", 3),
                ("list", [1]),
                ("table", {"a": 1}),
            ):
                ways[f"{key[-30:].replace('/', '_')} is {label}"] = at(key, value)
    return ways


_ENDLESS = (
    "CREATE VIEW {} AS WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n FROM c)"
    " SELECT n AS pair_id, n AS rows, n AS number, n AS key, n AS name, n AS value FROM c"
)


def _ways_of_stores(name: str) -> dict[str, Callable]:
    """Rows that were changed by SQL, and whole rows of wrong arrays with right checksums."""
    if not name.endswith(".db"):
        return {}
    if name == "database.db":
        statements = {
            "a pair less": "DELETE FROM two_view_geometries WHERE pair_id = (SELECT min(pair_id) FROM two_view_geometries)",
            "no pairs": "DELETE FROM two_view_geometries",
            "a photo less": "DELETE FROM images WHERE image_id = 2",
            "no keypoints": "DELETE FROM keypoints WHERE image_id = 2",
            "rows": "UPDATE keypoints SET rows = rows + 1",
            "negative rows": "UPDATE two_view_geometries SET rows = -1",
            "short data": "UPDATE two_view_geometries SET data = zeroblob(8)",
            "high matches": "UPDATE two_view_geometries SET data = replace(hex(zeroblob(4)), '0', 'ff')",
            "camera": "UPDATE cameras SET model = 99",
            "camera params": "UPDATE cameras SET params = zeroblob(8)",
            "names": "UPDATE images SET name = 'x' || name",
            "moved keypoints": "UPDATE keypoints SET data = zeroblob(length(data)) WHERE image_id = 3",
            "no table": "DROP TABLE matches",
            "view": f"ALTER TABLE matches RENAME TO old; {_ENDLESS.format('Matches')}",
            "view of geometries": f"ALTER TABLE two_view_geometries RENAME TO old; {_ENDLESS.format('two_view_geometries')}",
            "trigger": "CREATE TRIGGER t AFTER INSERT ON two_view_geometries BEGIN DELETE FROM two_view_geometries; END",
            "name bytes": "UPDATE images SET name = CAST(x'ff2e6a7067' AS TEXT) WHERE image_id = 2",
            "no tables": "DROP TABLE cameras",
        }
    else:
        statements = {
            "no items": "DELETE FROM items",
            "an item less": "DELETE FROM items WHERE number = 2",
            "no arrays": "DELETE FROM arrays",
            "other key": "UPDATE items SET key = 'x' || key WHERE number = 2",
            "other fingerprint": "UPDATE items SET fingerprint = 'x' WHERE number = 2",
            "attributes": "UPDATE items SET attributes = '[]' WHERE number = 2",
            "attributes no JSON": "UPDATE items SET attributes = '{' WHERE number = 2",
            "seconds": "UPDATE items SET seconds = 'x' WHERE number = 2",
            "checksum": "UPDATE items SET checksum = checksum + 1 WHERE number = 2",
            "layout": "UPDATE arrays SET layout = '[]' WHERE number = 2",
            "data null": "UPDATE arrays SET data = x'' WHERE number = 2",
            "data of another": "UPDATE arrays SET data = (SELECT data FROM arrays WHERE number = 1) WHERE number = 2",
            "rows exchanged": "UPDATE arrays SET number = -number WHERE number IN (1, 2); UPDATE arrays SET number = 3 + number WHERE number < 0",
            "about": "DELETE FROM about",
            "kind": "UPDATE about SET value = 'x' WHERE name = 'kind'",
            "no table": "DROP TABLE arrays",
            "view": f"ALTER TABLE items RENAME TO old; {_ENDLESS.format('items')}",
            "view about": f"ALTER TABLE about RENAME TO old; {_ENDLESS.format('about')}",
            "trigger": "CREATE TRIGGER t AFTER INSERT ON items BEGIN DELETE FROM items; END",
            "version": "PRAGMA user_version = 99",
            "application": "PRAGMA application_id = 1",
            "high number": "UPDATE items SET number = 9223372036854775807 WHERE number = 2",
        }  # fmt: skip

    def run(statement: str) -> Callable:
        def spoil(path: Path, _: Path) -> None:
            connection = sqlite3.connect(path, isolation_level=None)
            connection.executescript(statement)
            connection.close()

        return spoil

    ways: dict[str, Callable] = {f"sql {label}": run(statement) for label, statement in statements.items()}
    if name != "database.db":
        for label in ("flat", "turned", "double", "text", "nan", "high", "none", "short", "huge layout"):
            ways[f"row {label}"] = lambda path, _, way=label: _write_wrong_row(path, way)
    return ways


def _write_wrong_row(path: Path, way: str) -> None:
    """An item whose arrays are wrong, as if it had been written so."""
    import numpy as np

    from corrsfm.workspace.rows import WHOLE_ROWS, insert_row, make_row, unpack

    connection = sqlite3.connect(path, isolation_level=None)
    row = connection.execute(f"{WHOLE_ROWS} WHERE items.number = 2").fetchone()
    arrays = unpack(row[5], row[6])
    name = next(key for key in ("keypoints", "indices", "matches0", *arrays) if key in arrays)
    values = arrays[name]
    changed = {
        "flat": values.reshape(-1), "turned": values.T, "double": values.astype(np.float64),
        "text": np.full(values.shape, b"a"), "nan": np.full(values.shape, np.nan, np.float32),
        "high": np.full_like(values, 60000 if values.dtype == np.uint16 else 100), "short": values[:3], "none": values[:0], "huge layout": values,
    }[way]  # fmt: skip
    arrays = {**arrays, name: changed}
    wrong = make_row(row[0], row[1], arrays, json.loads(row[2]), row[3])
    if way == "huge layout":
        layout = json.loads(wrong[5])
        layout[0][2] = [2**40, *layout[0][2][1:]]
        wrong = (*wrong[:5], json.dumps(layout), *wrong[6:])
    insert_row(connection, wrong)
    connection.close()


def lay_out(base: Path, folder: Path, scene: str = "plain") -> Place:
    """A scene, its photos, and what the commands need besides."""
    (folder / "work").mkdir(parents=True)
    place = Place(base, folder / "work")
    {"plain": place.scene, "imported": place.imported_scene, "grown": place.grown_scene}[scene]()
    place.model("truth")
    place.file("new.jpg", (base / "photos" / "2.jpg").read_bytes() + b"\0")
    return place


def try_damage(
    damage: Damage, base: Path, folder: Path, expected: dict[str, Any], rng: random.Random
) -> dict[str, Any]:
    """Damage a scene, look whether it is noticed, try commands on it, and mend it as is advised."""
    place = lay_out(base, folder, damage.scene)
    command = RUN[damage.scene]
    scene, work = place.work / "scene", place.work
    damage.spoil(scene / damage.path, base / "other_scene" / damage.path)
    pristine = folder / "damaged"
    shutil.copytree(scene, pristine, symlinks=True, copy_function=_copy, ignore=_pipes)
    faults: list[str] = []
    said: list[str] = []

    def run(words: list[str]) -> Outcome:
        outcome = run_command(words, folder)
        said.append(f"$ corrsfm {shlex.join(words)}\n{outcome.err[-1200:]}{outcome.out[-300:]}")
        if outcome.hung:
            faults.append(f"{words[0]}: hung")
        elif outcome.code not in (0, 1, 2):
            faults.append(f"{words[0]}: exit status {outcome.code}")
        elif raw := _RAW.search(outcome.err + outcome.out):
            faults.append(f"{words[0]}: raw: {raw[0]}")
        elif outcome.code and "Error: " not in outcome.err and words[0] != "check":
            faults.append(f"{words[0]}: no message")
        return outcome

    def reset() -> None:
        shutil.rmtree(scene)
        shutil.copytree(pristine, scene, symlinks=True)
        if damage.name.endswith("a pipe"):
            (scene / damage.path).unlink(missing_ok=True)
            os.mkfifo(scene / damage.path)

    checked = run(["check", "scene", "--json"])
    steps = _damage_steps(checked)
    # 1. One command that reads the scene: an error or what it gives on a whole scene, but nothing raw.
    other = rng.choice(sorted(OTHERS))
    run(OTHERS[other])
    shutil.rmtree(work / "out", ignore_errors=True)
    (work / "photos" / "new.jpg").unlink(missing_ok=True)
    # 2. The whole run, as a user would repeat it.
    reset()
    outcome = run(command)
    # What is not as it was written is fine where the run says so.
    knowable = not damage.name.endswith(_UNKNOWABLE)
    if knowable and outcome.code == 0 and damage.path not in outcome.err and not _was_told(said[-1:]):
        # A store that check names need not be read by a run that has nothing to do.
        but = damage.path if steps else ""
        faults += _differences(scene, expected, f"run after {damage.path}", but)
        # But nothing may keep it from being named afterwards.
        if but and not _damage_steps(run(["check", "scene", "--json"])):
            faults += _differences(scene, expected, f"hidden by a run: {damage.path}")
    # 3. The advice: what check names, or else what the run said.
    reset()
    rounds = 0
    while knowable and not faults and rounds < MOST_ROUNDS:
        step = _damage_steps(run(["check", "scene", "--json"]))
        if not step:
            break
        rounds += 1
        _follow(step[0], work, run)
    if knowable and not faults:
        last = run(command)
        if last.code and (advised := _COMMAND.findall(last.err)):
            _follow(advised[0], work, run)
            last = run(command)
        if last.code:
            faults.append("not mended")
        else:
            if not _was_told(said):
                faults += _differences(scene, _without_lost(expected, said), "mended")
            if _damage_steps(run(["check", "scene", "--json"])):
                faults.append("still damaged")
    if left := [name for name in leftovers(contents(scene)) if name != "sparse.old"]:
        faults.append(f"left: {', '.join(left)}")
    return {
        "case": damage.name,
        "faults": faults,
        "arguments": [f"named: {bool(steps)}", other, f"rounds: {rounds}"],
        "said": "\n".join(said)[-6000:],
    }


def _without_lost(expected: dict[str, Any], said: list[str]) -> dict[str, Any]:
    """What must be there again when a scene is mended: all but what was said to be lost."""
    lost = {
        name
        for name, text in (
            ("added.json", "what it says of added photos is lost"),
            ("evidence.json", "the verdict is lost"),
        )
        if any(text in one for one in said)
    }
    return {name: what for name, what in expected.items() if name not in lost}


def _was_told(said: list[str]) -> bool:
    """Whether a command said that a model which photos were added to, or their pairs, could not be kept."""
    return any(
        "every pose moves" in one or "those that corrsfm add chose are not kept" in one for one in said
    )


def _copy(source: str, target: str) -> None:
    shutil.copyfile(source, target)


def _pipes(folder: str, names: list[str]) -> list[str]:
    return [
        name for name in names if not (os.path.isfile(p := os.path.join(folder, name)) or os.path.isdir(p))
    ]


def _damage_steps(outcome: Outcome) -> list[str]:
    """The commands that `corrsfm check --json` advises for damages; those of an error in its place."""
    try:
        findings = json.loads(outcome.out)["findings"]
    except (ValueError, KeyError):
        return _COMMAND.findall(outcome.err) or _deletions(outcome.err)
    return [finding["next_step"] for finding in findings if finding["kind"] == "damage"]


def _deletions(text: str) -> list[str]:
    """The advice to delete one file."""
    found = re.search(r"Error: (\S+): .*delete (?:it|this file)", text)
    return [f"rm {found[1]}"] if found else []


def _follow(advice: str, work: Path, run: Callable[[list[str]], Outcome]) -> None:
    for command in advice.split("; "):
        program, *words = shlex.split(command)
        if program == "rm":
            for word in words:
                path = work / word
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path)
                else:
                    path.unlink(missing_ok=True)
        elif program == "corrsfm":
            more = ["--threads", "1"] if words[0] not in ("report", "check", "export", "import") else []
            run([*words, *([] if "--threads" in words else more)])


def _differences(scene: Path, expected: dict[str, Any], when: str, but: str = "") -> Iterator[str]:
    result = {name: what for name, what in result_of(scene).items() if not name.endswith(".damaged")}
    if missing := sorted(expected.keys() - result.keys()):
        yield f"{when}: not there: {', '.join(missing[:5])}"
    if other := sorted(
        name for name in result.keys() & expected.keys() if result[name] != expected[name] and name != but
    ):
        yield f"{when}: silently different: {', '.join(other[:5])}"
