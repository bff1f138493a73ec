"""What each stage warned of, kept in ``warnings.json`` so that the report can repeat it.

A stage that is redone replaces its warnings; one that is up to date keeps those of the run that made it.
"""

from __future__ import annotations

import contextlib
import functools
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Concatenate, ParamSpec

from corrsfm.errors import WorkspaceError
from corrsfm.files import atomic_write_json, read_json
from corrsfm.workspace.folder import Workspace
from corrsfm.workspace.heard import ThreadWarnings, listening
from corrsfm.workspace.resume import StageOutcome

__all__ = ["BEFORE_STAGES", "collect_warnings", "keep_warnings", "keeps_warnings", "read_warnings"]

BEFORE_STAGES = "run"
"""In the place of a stage: what a whole run warned of before the first one."""


MAX_WARNINGS = 100
MAX_CHARACTERS = 2000

logger = logging.getLogger("corrsfm")

P = ParamSpec("P")


class _Collector(ThreadWarnings):
    """Keeps the different warnings of one thread, the first hundred in full and of the others the number."""

    def __init__(self) -> None:
        super().__init__()
        self.messages: list[str] = []
        self._seen: set[str] = set()

    def hear(self, record: logging.LogRecord) -> None:
        message = record.getMessage()
        if len(message) > MAX_CHARACTERS:
            message = message[:MAX_CHARACTERS] + " …"
        if message in self._seen:
            return
        self._seen.add(message)
        beyond = len(self._seen) - MAX_WARNINGS
        if beyond <= 0:
            self.messages.append(message)
        else:
            del self.messages[MAX_WARNINGS:]
            self.messages.append(f"{beyond} more, in the terminal only")


@contextlib.contextmanager
def collect_warnings() -> Iterator[list[str]]:
    """Collect what this thread logs as a warning or worse, without changing where it is logged.

    Yields
    ------
    list of str
        Grows as warnings come: at most 100 different ones of 2000 characters, then how many there were more.
    """
    with listening(_Collector()) as collector:
        yield collector.messages


def keeps_warnings(
    stage: str,
) -> Callable[
    [Callable[Concatenate[Workspace, P], StageOutcome]], Callable[Concatenate[Workspace, P], StageOutcome]
]:
    """Decorate the function of a stage: what it warns of is kept in the workspace, also if it fails."""

    def decorate(
        function: Callable[Concatenate[Workspace, P], StageOutcome],
    ) -> Callable[Concatenate[Workspace, P], StageOutcome]:
        @functools.wraps(function)
        def run(workspace: Workspace, /, *args: P.args, **kwargs: P.kwargs) -> StageOutcome:
            is_reused = False
            with collect_warnings() as messages:
                try:
                    outcome = function(workspace, *args, **kwargs)
                    is_reused = outcome.skipped and not messages
                finally:
                    if not is_reused:
                        keep_warnings(workspace.warnings_json, stage, messages)
            return outcome

        return run

    return decorate


def keep_warnings(path: Path, stage: str, messages: list[str]) -> None:
    """Put the warnings of a stage in the place of those of its last run."""
    known = read_warnings(path)
    if known.get(stage, []) == messages:
        return
    # A stage must not fail, nor its own error be hidden, because its warnings cannot be written.
    with contextlib.suppress(WorkspaceError, OSError):
        atomic_write_json(path, {**known, stage: list(messages)})


def read_warnings(path: Path) -> dict[str, list[str]]:
    """Stage → its warnings; empty if there is no such file or it is damaged: it holds no results."""
    try:
        values = read_json(path)
    except (OSError, ValueError):
        return {}
    if not isinstance(values, dict):
        return {}
    return {
        stage: [str(message) for message in messages[: MAX_WARNINGS + 1]]
        for stage, messages in values.items()
        if isinstance(messages, list)
    }
