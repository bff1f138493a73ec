"""Tries to break corrsfm: bad inputs, damages, kills, power cuts, full disks, permissions, surroundings.

python tests/reliability/run.py inputs damages kills cuts disks permissions surroundings --jobs 2 \\
    --results results/reliability.json
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shlex
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

# Read at the first import of numpy: a thread that runs would be lost in a forked child, with what it holds.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[_name] = "1"

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent / "support"), str(HERE.parents[1])]

import bad_files  # noqa: E402
import bad_models  # noqa: E402
import bad_options  # noqa: E402
import bad_paths  # noqa: E402
import bad_photos  # noqa: E402
from case import Case, Trial, find_faults  # noqa: E402
from damages import Damage, all_damages, lay_out, try_damage  # noqa: E402
from full_disks import WRITERS, all_full_disks, try_full_disk, why_no_mounts  # noqa: E402
from kills import (  # noqa: E402
    COMMANDS,
    faults_after,
    kill_command,
    prepared,
    result_of,
    result_unhindered,
    undisturbed,
)
from permissions import DOINGS, all_closed, try_closed, why_no_users  # noqa: E402
from place import Place, make_base  # noqa: E402
from power_cuts import record_cuts  # noqa: E402
from sandbox import contents, fork, in_child, preload, run_command  # noqa: E402
from surroundings import Surrounding, all_surroundings, try_surrounding  # noqa: E402

Row = dict[str, Any]

COUNTED = {
    "inputs": "traceback, crash, hang, over 2.5 GB, no line that names the cause, a file left or changed",
    "damages": "the same, damage that changes results silently, advice that does not mend it",
    "kills": "finished work that is made again, another result than undisturbed, a file left",
    "disks": "no line that says so, a file lost, changed or left, another result once there is space",
    "permissions": "no line that names the file, advice that does not help, a file changed, another result",
    "cuts": "work that was said to be finished and is lost, another result, a file left",
    "surroundings": "traceback, hang, wrong exit status, work stopped or lost, a file or process left",
}
"""What each attempt counts as a fault, for the table of results."""
NAMES = {
    "inputs": "bad inputs", "damages": "damages of a scene", "kills": "kills at random moments",
    "cuts": "simulated power cuts", "disks": "full disks", "permissions": "closed files and folders",
    "surroundings": "hostile surroundings",
}  # fmt: skip


def all_cases() -> list[Case]:
    """The whole corpus of bad inputs, in a fixed order."""
    modules = (bad_paths, bad_photos, bad_options, bad_files, bad_models)
    found = [case for module in modules for case in module.cases()]
    names = Counter(case.name for case in found)
    assert max(names.values()) == 1, [name for name, num in names.items() if num > 1]
    return found


class Trials:
    """All attempts from one base folder, each in a folder of its own.

    Parameters
    ----------
    root : Path
    seed : int
    jobs : int
        At a time.
    only : str
        What the name of an attempt contains.
    is_careless : bool
        See `record_cuts`.
    """

    def __init__(self, root: Path, seed: int, jobs: int, only: str, is_careless: bool = False) -> None:
        self.base = root / "base"
        self.base.mkdir()
        in_child(lambda: _quietly(lambda: make_base(self.base)))
        os.chmod(root, 0o755)
        self._root, self._seed, self._jobs, self._only = root, seed, jobs, only
        self._is_careless = is_careless

    def _drawn(self, items: list[Any], most: int | None) -> list[Any]:
        if most is None or most >= len(items):
            return items
        return random.Random(self._seed).sample(items, most)

    def inputs(self, most: int | None) -> list[Row]:
        """Try bad inputs."""
        cases = self._drawn([case for case in all_cases() if self._only in case.name], most)

        return self._each(cases, self._try_case)

    def _each(self, found: Sequence[Any], attempt: Callable[[Any, Path], Row]) -> list[Row]:
        """Rows of attempts, each in a folder of its own that goes afterwards."""

        def work(job: int) -> Iterator[Row]:
            for number, one in enumerate(found[job :: self._jobs]):
                folder = self._root / f"attempt-{job}-{number}"
                yield attempt(one, folder)
                _remove(folder)

        return _side_by_side(work, self._root, self._jobs)

    def _try_case(self, case: Case, folder: Path) -> Row:
        work = folder / "work"
        work.mkdir(parents=True)
        os.chmod(folder, 0o777)
        trial = Trial(**in_child(lambda: asdict(case.prepare(Place(self.base, work)))))
        before = contents(work)
        outcome = run_command(trial.arguments, folder, as_nobody=trial.as_nobody)
        faults = find_faults(trial, outcome, before, contents(work), contents(folder / "tmp"))
        return {
            "case": case.name,
            "faults": faults,
            "code": outcome.code,
            "seconds": round(outcome.seconds, 2),
            "peak_mb": round(outcome.peak_mb),
            "arguments": trial.arguments,
            "said": (outcome.err + outcome.out)[-3000:],
        }

    def damages(self, most: int | None) -> list[Row]:
        """Damage every file of a scene in every way, and follow the advice."""
        found = [damage for damage in all_damages(self.base) if self._only in damage.name]
        found = self._drawn(found, most)
        expected = {
            scene: in_child(lambda s=scene: _result_of_whole(self.base, self._root / f"whole {s}", s))
            for scene in {damage.scene for damage in found}
        }

        def attempt(damage: Damage, folder: Path) -> Row:
            rng = random.Random(f"{self._seed} {damage.name}")
            return in_child(lambda: try_damage(damage, self.base, folder, expected[damage.scene], rng))

        return self._each(found, attempt)

    def kills(self, most: int | None) -> list[Row]:
        """Kill commands so many times, half of them `corrsfm run`; a row for each that is through."""
        names = [name for name in COMMANDS if name.startswith(self._only)]

        def work(job: int) -> Iterator[Row]:
            rng, done = random.Random(f"{self._seed} {job}"), 0
            expected: dict[str, Any] = {}
            # Some commands end before their first kill.
            while done < (most or 1000) / self._jobs:
                name = "run" if "run" in names and rng.random() < 0.5 else rng.choice(names)
                if name not in expected:
                    expected[name] = undisturbed(name, self.base, self._root / f"straight-{job}-{name}")
                folder = self._root / f"kill-{job}-{done}"
                trial = kill_command(name, self.base, folder, *expected[name], rng)
                _remove(folder)
                done += len(trial["moments"])
                yield trial

        return _side_by_side(work, self._root, self._jobs)

    def cuts(self, most: int | None) -> list[Row]:
        """Let the power fail at every flush of commands, and run them again on what the disk kept."""
        found, expected = [], {}
        for name in ("run", "prune", "add"):
            if not name.startswith(self._only):
                continue
            expected[name], _ = in_child(
                lambda n=name: undisturbed(n, self.base, self._root / f"before cuts {n}")
            )
            folder = self._root / f"cut {name}"
            words = in_child(lambda n=name, f=folder: prepared(n, self.base, f))
            outcome, cuts = record_cuts(words, folder, COMMANDS[name].makes, is_careless=self._is_careless)
            assert outcome.code == 0, outcome.err
            found += [(name, words, folder, cut) for cut in cuts]

        def work(_: int) -> Iterator[Row]:
            for name, words, folder, cut in self._drawn(found, most):
                yield faults_after(name, words, folder, cut, expected[name])

        # One at a time: each is run where its photos are.
        return _side_by_side(work, self._root, 1)

    def surroundings(self, most: int | None) -> list[Row]:
        """Start commands with streams closed or full, little memory, no folder, and under signals."""
        found = self._drawn([one for one in all_surroundings() if self._only in one.name], most)
        expected, _ = in_child(lambda: undisturbed("run", self.base, self._root / "in peace"))

        def attempt(one: Surrounding, folder: Path) -> Row:
            return try_surrounding(
                one, self.base, folder, expected, random.Random(f"{self._seed} {one.name}")
            )

        return self._each(found, attempt)

    def disks(self, most: int | None) -> list[Row]:
        """Let the disk run full under commands, and run them again with space."""
        if why_not := why_no_mounts():
            print(f"{NAMES['disks']}: skipped: {why_not}")
            return []
        found = self._drawn([disk for disk in all_full_disks() if self._only in disk.name], most)
        expected = {
            name: in_child(
                lambda n=name: result_unhindered(WRITERS[n].prepare, self.base, self._root / f"u {n}")
            )
            for name in dict.fromkeys(disk.command for disk in found)
        }

        return self._each(
            found,
            lambda disk, folder: in_child(
                lambda: try_full_disk(disk, self.base, folder, expected[disk.command])
            ),
        )

    def permissions(self, most: int | None) -> list[Row]:
        """Close files and folders to commands of an ordinary user, and follow the advice."""
        if why_not := why_no_users():
            print(f"{NAMES['permissions']}: skipped: {why_not}")
            return []
        found = self._drawn(
            [closed for closed in all_closed(self.base / "scene") if self._only in closed.name], most
        )
        expected = {
            name: in_child(
                lambda n=name: result_unhindered(DOINGS[n].prepare, self.base, self._root / f"p {n}")
            )
            for name in dict.fromkeys(closed.command for closed in found)
        }

        return self._each(
            found,
            lambda closed, folder: in_child(
                lambda: try_closed(closed, self.base, folder, expected[closed.command])
            ),
        )


def _result_of_whole(base: Path, folder: Path, scene: str) -> dict[str, Any]:
    """What a scene holds that was not damaged."""
    return result_of(lay_out(base, folder, scene).work / "scene")


def _quietly(function: Callable[[], None]) -> None:
    with open(os.devnull, "w") as nothing, contextlib.redirect_stdout(nothing):
        function()


def _remove(folder: Path) -> None:
    for root, folders, _ in os.walk(folder):
        for name in folders:
            if not os.path.islink(os.path.join(root, name)):
                os.chmod(os.path.join(root, name), 0o700)
    shutil.rmtree(os.fsencode(folder))


def _side_by_side(work: Callable[[int], Iterator[Row]], root: Path, jobs: int) -> list[Row]:
    """Rows of several processes."""

    def write_rows(job: int) -> None:
        with open(root / f"results{job}", "w", encoding="utf-8", errors="backslashreplace") as file:
            for result in work(job):
                file.write(json.dumps(result) + "\n")
                file.flush()

    pids = [fork(lambda job=job: write_rows(job)) for job in range(jobs)]
    codes = [os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in pids]
    assert not any(codes), codes
    return [
        json.loads(line)
        for job in range(jobs)
        for line in (root / f"results{job}").read_text("utf-8").splitlines()
    ]


def _show(what: str, rows: list[Row]) -> int:
    """Print what went wrong, and how much; the number of attempts."""
    bad = [row for row in rows if row["faults"]]
    for row in bad:
        print(f"{row['case']}: {'; '.join(row['faults'])}")
        print(f"    {row.get('arguments') or row['moments']}"[:400])
        print("    " + row["said"].strip().replace("\n", "\n    ")[-900:])
    number = sum(len(row["moments"]) for row in rows) if what == "kills" else len(rows)
    print(f"{NAMES[what]}: {number}, with faults: {len(bad)}")
    return number


def main() -> int:
    """Try what the arguments say; 1 if something went wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="+", choices=list(NAMES))
    parser.add_argument("--most", type=int, help="Of each, drawn at random; if not given all, or 1000 kills.")
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--only", default="", help="Those whose name contains this, or begins with it.")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument(
        "--careless", action="store_true", help="Cuts as if files were not flushed: must fail."
    )
    parser.add_argument("--rows", type=Path, help="JSON file for everything that was tried.")
    parser.add_argument("--results", type=Path, help="Result file, for the tables.")
    options = parser.parse_args()
    print(f"seed {options.seed}", flush=True)
    preload()
    faults = 0
    with tempfile.TemporaryDirectory(prefix="corrsfm-") as root:
        trials = Trials(Path(root), options.seed, options.jobs, options.only, options.careless)
        found = {what: getattr(trials, what)(options.most) for what in options.what}
    for what, rows in found.items():
        number, bad = _show(what, rows), sum(bool(row["faults"]) for row in rows)
        faults += bad
        if options.results:
            from tools.house_tables import keep_row

            row = {"number": number, "faults": bad, "counted": COUNTED[what], "seed": options.seed}
            command = shlex.join(["python", "tests/reliability/run.py", *sys.argv[1:]])
            keep_row(options.results, "reliability", NAMES[what], row, command=command)
    if options.rows:
        options.rows.write_text(json.dumps(found, indent=1))
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())
