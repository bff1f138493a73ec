"""Candidates mapped side by side, each in a process of its own.

pycolmap's mappers hold one log and one random seed per process, and a candidate on one thread is a function
of its description alone: so processes, not threads, and the results do not depend on how many.
"""

from __future__ import annotations

import logging
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from corrsfm.files import read_json
from corrsfm.machine import end_with_parent, hear_interruptions, unheard_by_children
from corrsfm.reconstruction.calibration import DEFAULT_REFINEMENT, Refinement
from corrsfm.reconstruction.candidates import Candidate, map_candidate

if TYPE_CHECKING:
    import pycolmap

__all__ = ["CandidatePool"]

logger = logging.getLogger("corrsfm")


class CandidatePool:
    """Maps candidates of one database, several at a time; a context manager.

    Parameters
    ----------
    database : Path
        With verified two-view geometries; not changed.
    workdir : Path
        Every candidate gets a folder of its name here and is read from it if an earlier run finished it.
    refinement : Refinement
    num_processes : int
        1 maps in this process.
    """

    def __init__(
        self,
        database: Path,
        workdir: Path,
        *,
        refinement: Refinement = DEFAULT_REFINEMENT,
        num_processes: int = 1,
    ) -> None:
        self._database = database
        self._workdir = workdir
        self._refinement = refinement
        # A fork would copy pycolmap's threads in whatever state they are.
        self._executor = (
            ProcessPoolExecutor(
                num_processes,
                mp_context=multiprocessing.get_context("spawn"),
                initializer=_end_with_parent,
            )
            if num_processes > 1
            else None
        )

    def __enter__(self) -> CandidatePool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)

    def map(
        self, candidates: Sequence[Candidate], *, max_runtime_seconds: int = 0
    ) -> list[pycolmap.Reconstruction | None]:
        """The model of each candidate in their order, None where none came out.

        Parameters
        ----------
        candidates : sequence of Candidate
        max_runtime_seconds : int
            Of one candidate; 0 for no limit.

        Raises
        ------
        DatabaseError
            If the database cannot be read.
        """
        options: dict[str, Any] = {
            "refinement": self._refinement,
            "max_runtime_seconds": max_runtime_seconds,
        }
        if self._executor is not None:
            jobs = [(candidate, self._database, self._folder(candidate), options) for candidate in candidates]
            try:
                with unheard_by_children():
                    outcomes = self._executor.map(_map_in_process, jobs)
                for _ in outcomes:
                    pass
            except BrokenProcessPool:
                # Killed for memory, or started from a script without a main guard.
                logger.warning(
                    "a process that mapped a candidate ended abruptly; going on with one at a time"
                )
                self._executor.shutdown(cancel_futures=True)
                self._executor = None
        # Models do not travel between processes; all of them lie in their folders now.
        return [
            map_candidate(candidate, self._database, self._folder(candidate), **options)
            for candidate in candidates
        ]

    def seconds(self, candidate: Candidate) -> float:
        """Seconds that a mapped candidate took, when it was mapped."""
        values = read_json(self._folder(candidate) / "candidate.json")
        return float(values["seconds"])

    def _folder(self, candidate: Candidate) -> Path:
        return self._workdir / candidate.name


def _end_with_parent() -> None:
    """Leave no process that writes on when the run was killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    end_with_parent(parent.sentinel)
    hear_interruptions()


def _map_in_process(job: tuple[Candidate, Path, Path, dict[str, Any]]) -> None:
    candidate, database, folder, options = job
    map_candidate(candidate, database, folder, **options)
