"""Kills commands at random moments until they are through, and compares with an undisturbed run."""

from __future__ import annotations

import contextlib
import json
import random
import re
import shutil
import sqlite3
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from place import NUM_PHOTOS, SCENE_OPTIONS, Place
from sandbox import Outcome, contents, leftovers, run_command

__all__ = [
    "COMMANDS",
    "faults_after",
    "kill_command",
    "prepared",
    "result_of",
    "result_unhindered",
    "undisturbed",
]

MOST_KILLS = 8
_QUICK = ["--threads", "1", "--device", "cpu"]
# Seconds, moments and versions, which no two runs share, and what libraries say.
_VOLATILE = ("workspace.json", "report.json", "report.html", "run.json", "log.txt", ".photos.json", ".lock")
_SECONDS = re.compile(r'"seconds": [\d.e-]+')


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command with what must be there before, and the folder that it writes.

    Attributes
    ----------
    prepare : callable
        Lays out the working directory and returns the words of the command.
    makes : str
    """

    prepare: Callable[[Place], list[str]]
    makes: str


def _run(place: Place) -> list[str]:
    return ["run", str(place.photos(NUM_PHOTOS)), "out", *SCENE_OPTIONS]


def _prune(place: Place) -> list[str]:
    return ["prune", str(place.scene()), "--method", "ratio", *_QUICK]


def _add(place: Place) -> list[str]:
    place.scene(photos=NUM_PHOTOS - 1)
    new = place.file("new/4.jpg", (place.base / "photos" / "4.jpg").read_bytes())
    return ["add", "scene", str(new), *_QUICK]


def _import(place: Place) -> list[str]:
    given = [
        "--features",
        str(place.base / "hloc_features.h5"),
        "--matches",
        str(place.base / "hloc_matches.h5"),
    ]
    return ["import", str(place.photos()), "out", *given]


def _export(target: str) -> Callable[[Place], list[str]]:
    return lambda place: ["export", str(place.scene()), "out", "--for", target]


COMMANDS: dict[str, Command] = {
    "run": Command(prepare=_run, makes="out"),
    "prune": Command(prepare=_prune, makes="scene"),
    "add": Command(prepare=_add, makes="scene"),
    "import": Command(prepare=_import, makes="out"),
    "export nerfstudio": Command(prepare=_export("nerfstudio"), makes="out"),
    "export hloc": Command(prepare=_export("hloc"), makes="out"),
}
"""What is killed."""


def undisturbed(name: str, base: Path, folder: Path) -> tuple[dict[str, Any], float]:
    """What a command makes that nothing disturbs, and the seconds that it takes."""
    words = COMMANDS[name].prepare(_place(base, folder))
    outcome = run_command(words, folder)
    assert outcome.code == 0, outcome.err
    return result_of(folder / "work"), outcome.seconds


def result_unhindered(prepare: Callable[[Place], list[str]], base: Path, folder: Path) -> dict[str, Any]:
    """What a command leaves that nothing hinders, by what lays out its working directory."""
    outcome = run_command(prepare(_place(base, folder)), folder)
    assert outcome.code == 0, outcome.err + outcome.out
    return result_of(folder / "work")


def kill_command(
    name: str, base: Path, folder: Path, expected: dict[str, Any], seconds: float, rng: random.Random
) -> dict[str, Any]:
    """Kill a command at moments drawn evenly over its run, until it is through or was killed often enough."""
    words = COMMANDS[name].prepare(_place(base, folder))
    made, moments, faults = folder / "work" / COMMANDS[name].makes, [], []
    finished, before = {}, _finished(made)
    while True:
        moment = rng.uniform(0, seconds) if len(moments) < MOST_KILLS else None
        outcome = run_command(words, folder, kill_after_s=moment)
        if outcome.code != -9:
            break
        moments.append(round(moment or 0.0, 3))
        finished |= _finished(made)
    if outcome.code and name == "import" and "--overwrite" in outcome.err:
        outcome = run_command([*words, "--overwrite"], folder)
    if outcome.code and name.startswith("export") and "is not empty" in outcome.err:
        # The kill came after an export had got its name: its content is compared all the same.
        outcome = replace(outcome, code=0)
    faults += _faults(outcome, folder / "work", expected)
    # What is imported is read again whole.
    if outcome.code == 0 and name != "import":
        now = _finished(made)
        fresh = {item: when for item, when in finished.items() if before.get(item) != when}
        if again := [item for item, when in fresh.items() if now.get(item, when) != when]:
            faults.append(f"made again: {', '.join(sorted(again)[:5])}")
    return {"case": name, "moments": moments, "faults": faults, "said": (outcome.err + outcome.out)[-1500:]}


def prepared(name: str, base: Path, folder: Path) -> list[str]:
    """The words of a command, whose folder is laid out."""
    return COMMANDS[name].prepare(_place(base, folder))


def faults_after(
    name: str, words: list[str], origin: Path, cut: Path, expected: dict[str, Any]
) -> dict[str, Any]:
    """What is wrong when a command is run again on what a power cut left of what it makes."""
    made = COMMANDS[name].makes
    # Where it was made, since a workspace knows its photos by their path.
    work = origin / "work"
    shutil.rmtree(work / made, ignore_errors=True)
    shutil.copytree(cut, work / made, symlinks=True)
    finished = _finished(work / made)
    outcome = run_command(words, origin)
    if outcome.code and name == "import" and "--overwrite" in outcome.err:
        outcome = run_command([*words, "--overwrite"], origin)
    faults = _faults(outcome, work, expected)
    if outcome.code == 0 and name == "run":
        now = _finished(work / made)
        if lost := [item for item, when in finished.items() if now.get(item) != when]:
            faults.append(f"said to be finished, and lost: {', '.join(sorted(lost)[:5])}")
    return {
        "case": f"{name} {cut.name}",
        "faults": faults,
        "arguments": words,
        "said": (outcome.err + outcome.out)[-1500:],
    }


def _place(base: Path, folder: Path) -> Place:
    (folder / "work").mkdir(parents=True)
    return Place(base, folder / "work")


def _faults(outcome: Outcome, work: Path, expected: dict[str, Any]) -> list[str]:
    if outcome.hung:
        return ["hung"]
    if outcome.code:
        return [f"exit status {outcome.code}"]
    faults = []
    result = result_of(work)
    if left := leftovers(contents(work)):
        faults.append(f"left: {', '.join(left)}")
    if strange := sorted(result.keys() ^ expected.keys()):
        faults.append(f"other files: {', '.join(strange[:5])}")
    if other := sorted(name for name in result.keys() & expected.keys() if result[name] != expected[name]):
        faults.append(f"other contents: {', '.join(other[:5])}")
    return faults


def _finished(workspace: Path) -> dict[str, Any]:
    """What is finished, each with the moment or the seconds that tell it from the same made again."""
    found: dict[str, Any] = {}
    for path in sorted(workspace.rglob("*.db")):
        # A copy: what only looks must not mend.
        copy = workspace.parent / "looked_at.db"
        for suffix in ("", "-wal", "-journal"):
            with contextlib.suppress(FileNotFoundError):
                shutil.copyfile(f"{path}{suffix}", f"{copy}{suffix}")
        with (
            contextlib.suppress(sqlite3.DatabaseError),
            contextlib.closing(sqlite3.connect(copy)) as connection,
        ):
            for key, seconds in connection.execute("SELECT key, seconds FROM items"):
                found[f"{path.name} {key}"] = seconds
        for left in workspace.parent.glob("looked_at.db*"):
            left.unlink()
    with contextlib.suppress(OSError, ValueError):
        for stage, record in json.loads((workspace / "workspace.json").read_text())["stages"].items():
            # That the photos are the same is found out by looking at them.
            if stage != "images":
                found[f"stage {stage}"] = record["finished_at"], record["seconds"]
    return found


def result_of(work: Path) -> dict[str, Any]:
    """Path → what is there, without what differs between any two runs."""
    found: dict[str, Any] = {}
    for name, what in contents(work).items():
        path = work / name
        if path.name in _VOLATILE:
            found[name] = "there"
        elif path.suffix == ".db" and path.is_file():
            found[name] = _tables(path)
        elif path.suffix == ".json":
            found[name] = (
                _SECONDS.sub("", path.read_text("utf-8", "replace")) if path.is_file() else list(what)
            )
        else:
            found[name] = list(what)
    return found


def _tables(path: Path) -> dict[str, Any]:
    """Rows of every table of a database, without the seconds of items."""
    found = {}
    with contextlib.closing(sqlite3.connect(f"file:{path}?mode=ro&immutable=1", uri=True)) as connection:
        connection.text_factory = lambda raw: raw.decode("utf-8", "replace")
        tables = [
            name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        ]
        for table in tables:
            columns = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
            if table == "items":
                # Numbers and checksums follow the order and the seconds.
                query = (
                    "SELECT key, fingerprint, attributes, layout, data FROM items JOIN arrays USING (number)"
                )
                found[table] = sorted(map(repr, connection.execute(query)))
            elif table == "about":
                # The place of imported files is that of the test.
                query = "SELECT name, value FROM about WHERE name != 'origin'"
                found[table] = sorted(map(repr, connection.execute(query)))
            elif table not in ("arrays", "sqlite_sequence"):
                found[table] = sorted(
                    map(repr, connection.execute(f"SELECT {', '.join(columns)} FROM {table}"))
                )
    return found
