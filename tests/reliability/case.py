"""A bad input, what it must come to, and how that is judged."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from place import Place
from sandbox import Outcome, differences, leftovers

__all__ = ["EITHER", "FINE", "REFUSED", "Case", "Trial", "find_faults"]

FINE, REFUSED, EITHER = "fine", "refused", "either"

MOST_MEMORY_MB = 2500.0
LONGEST_MESSAGE = 3000
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]")
# A library's or the interpreter's own words, which tell a user nothing.
_RAW = re.compile(
    r"Traceback \(most recent|\bObject at 0x|<\w+ object at|Segmentation|terminate called|Aborted"
)


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A command on bad input.

    Attributes
    ----------
    arguments : list of str
    named : list of str
        Of which a refusal must contain one: the bad file or option.
    writes : list of str
        What the command may make or change, relative to the working directory, unless it refuses.
    expected : str
    begins : bool
        Whether a refusal may come after finished work, which then stays in ``writes``.
    as_nobody : bool
        Runs without the rights of root.
    """

    arguments: list[str]
    named: list[str]
    writes: list[str]
    expected: str = REFUSED
    begins: bool = False
    as_nobody: bool = False


@dataclass(frozen=True, kw_only=True)
class Case:
    """A named way to make a trial in a place."""

    name: str
    prepare: Callable[[Place], Trial]


def find_faults(
    trial: Trial, outcome: Outcome, before: dict[str, Any], after: dict[str, Any], around: dict[str, Any]
) -> list[str]:
    """What a command did wrong.

    Parameters
    ----------
    before, after : dict
        `contents` of the working directory.
    around : dict
        Contents of the folder for temporary files afterwards.
    """
    faults = []
    text = outcome.err + outcome.out
    if outcome.hung:
        return [f"hung for {outcome.seconds:.0f} s"]
    if outcome.code < 0:
        faults.append(f"died by signal {-outcome.code}")
    elif outcome.code not in (0, 1, 2):
        faults.append(f"exit status {outcome.code}")
    if raw := _RAW.search(text):
        faults.append(f"raw: {raw[0]}")
    if control := _CONTROL.search(text):
        faults.append(f"control character {control[0]!r} on the terminal")
    if outcome.peak_mb > MOST_MEMORY_MB:
        faults.append(f"{outcome.peak_mb:.0f} MB of memory")
    if outcome.orphans:
        faults.append(f"{outcome.orphans} processes left behind")
    refused = outcome.code != 0
    if trial.expected == REFUSED and not refused:
        faults.append("accepted")
    if trial.expected == FINE and refused:
        faults.append("refused")
    if refused and not faults:
        faults += _faults_of_message(outcome, trial)
    changed = differences(before, after)
    if outside := [name for name in changed if not _is_within(name, trial.writes)]:
        faults.append(f"changed: {', '.join(outside[:5])}")
    if (
        refused
        and not trial.begins
        and (begun := [name for name in changed if _is_within(name, trial.writes)])
    ):
        faults.append(f"left behind: {', '.join(begun[:5])}")
    if left := leftovers({name: None for name in after.keys() - before.keys()}):
        faults.append(f"half written: {', '.join(left[:5])}")
    # torch makes a cache of its own.
    if kept := [name for name in around if not name.startswith("torchinductor")]:
        faults.append(f"temporary files: {', '.join(sorted(kept)[:5])}")
    return faults


def _faults_of_message(outcome: Outcome, trial: Trial) -> list[str]:
    lines = [line for line in outcome.err.splitlines() if line.startswith("Error: ")]
    # `check` says what it found on standard output and ends with status 1.
    message = outcome.err[outcome.err.find("Error: ") :] if lines else outcome.out
    if len(lines) > 1:
        return ["several errors"]
    if not message.strip():
        return ["no message"]
    faults = []
    if len(message) > LONGEST_MESSAGE:
        faults.append(f"a message of {len(message)} characters")
    if not any(name in message for name in trial.named):
        faults.append(f"does not name {' or '.join(trial.named)}")
    return faults


def _is_within(name: str, places: list[str]) -> bool:
    return any(name == place or place in map(str, Path(name).parents) for place in places)
