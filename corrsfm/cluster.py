"""Work on a Dask cluster, any of whose workers may vanish at any moment.

A worker that is lost costs what it was working on, which another one repeats; a scheduler that is lost ends
the work with an error, and what was finished by then is kept by whoever wrote it.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import hashlib
import itertools
import logging
import queue
import tempfile
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextvars import ContextVar
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

from corrsfm import __version__
from corrsfm.errors import ClusterError, ConfigError, CorrsfmError, DependencyError
from corrsfm.machine import unheard_by_children

__all__ = ["Cluster", "connected"]

logger = logging.getLogger("corrsfm")

POLL_SECONDS = 0.5
REFRESH_SECONDS = 5.0
CONNECT_SECONDS = 10.0
PATIENCE_SECONDS = 15.0
# Dask gives a task up when four workers have died with it, also where they died of something else.
MAX_SUBMISSIONS = 4

K = TypeVar("K")
R = TypeVar("R")


class Cluster:
    """The workers of a scheduler, or processes of this machine; a context manager.

    Parameters
    ----------
    address : str, optional
        Of a Dask scheduler.
    workers : int
        Without an address: processes to start on this machine, when there is something to do.

    Raises
    ------
    DependencyError
        If Dask is not installed.
    ClusterError
        If no scheduler answers at the address.
    """

    def __init__(self, address: str | None = None, *, workers: int = 0) -> None:
        self.address = address
        self.workers = workers
        self._stack = contextlib.ExitStack()
        self._num_slots = 0
        self._next_count = 0.0
        self._last_seen = time.monotonic()
        self._has_warned = False
        try:
            import distributed  # noqa: F401
        except ImportError as error:
            raise DependencyError("distributed", "working on a Dask cluster", "cluster") from error
        if address is not None:
            # A wrong address is told before hours of other work, not after.
            self._client  # noqa: B018

    def __enter__(self) -> Cluster:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    @functools.cached_property
    def _client(self) -> Any:
        import dask.config
        from distributed import Client, LocalCluster

        # Of a scheduler that is lost it logs a traceback.
        dask_logger = logging.getLogger("distributed.client")
        self._stack.callback(dask_logger.setLevel, dask_logger.level)
        dask_logger.setLevel(logging.CRITICAL)
        target: Any = self.address
        if target is None:
            # Dask leaves files where its scheduler and its workers were.
            scratch = self._stack.enter_context(tempfile.TemporaryDirectory(prefix="corrsfm-"))
            self._stack.enter_context(dask.config.set({"temporary-directory": scratch}))
            with unheard_by_children():
                target = self._stack.enter_context(
                    LocalCluster(
                        n_workers=self.workers,
                        threads_per_worker=1,
                        # The limit would kill a worker at its share of the memory.
                        memory_limit=0,
                        dashboard_address=":0",
                        silence_logs=logging.CRITICAL,
                    )
                )
        try:
            if self.address is not None:
                _greet(self.address)
            client = self._stack.enter_context(Client(target, timeout=CONNECT_SECONDS, set_as_default=False))
        except Exception as error:  # what listens there may be anything
            raise ClusterError(
                f"{self.address or 'this machine'}: no Dask scheduler answers there "
                f"({str(error) or 'nothing came back'}); start one with: dask scheduler"
            ) from error
        try:
            versions = client.run(code_version, on_error="return")
        except Exception as error:  # whatever Dask raises when it loses the scheduler at this moment
            raise self._lost() from error
        _check_workers(versions)
        return client

    def outcomes(
        self, function: Callable[..., R], tasks: Iterable[tuple[K, tuple[Any, ...]]]
    ) -> Generator[tuple[K, R | Exception], None, None]:
        """Do tasks on the workers, a few ahead of what they can do at once.

        Parameters
        ----------
        function : callable
            Importable by the workers. A task may be done more than once, even at the same time.
        tasks : iterable
            A key for the caller, and the arguments.

        Yields
        ------
        key, outcome
            In the order in which they end: what the function returned, or the exception that ended it.

        Raises
        ------
        ClusterError
            If the scheduler is lost.
        """
        from distributed import KilledWorker

        waiting = iter(tasks)
        running: dict[Any, tuple[K, tuple[Any, ...], int]] = {}
        done: queue.SimpleQueue[Any] = queue.SimpleQueue()

        def submit(key: K, arguments: tuple[Any, ...], number: int) -> None:
            future = self._client.submit(_checked, code_version(), function, arguments, pure=False)
            running[future] = key, arguments, number
            future.add_done_callback(done.put)

        try:
            while True:
                free = 2 * max(1, self.count_slots()) - len(running)
                for key, arguments in itertools.islice(waiting, max(0, free)):
                    submit(key, arguments, 1)
                if not running:
                    return
                try:
                    # An unbounded wait can miss an interruption that comes just before it.
                    future = done.get(timeout=POLL_SECONDS)
                except queue.Empty:
                    continue
                key, arguments, number = running.pop(future)
                outcome = self._outcome_of(future)
                if isinstance(outcome, KilledWorker) and number < MAX_SUBMISSIONS:
                    submit(key, arguments, number + 1)
                else:
                    yield key, _explained(outcome)
        finally:
            # What nobody waits for is not begun.
            for future in running:
                future.release()

    def _outcome_of(self, future: Any) -> Any:
        """What a task that has ended returned or raised; waits if its worker took the answer along."""
        try:
            return future.result()
        except CancelledError as error:
            raise self._lost() from error
        except Exception as error:
            return error

    def count_slots(self) -> int:
        """Tasks that the workers can do at once, as of a few seconds ago."""
        now = time.monotonic()
        if now >= self._next_count:
            self._next_count = now + REFRESH_SECONDS
            try:
                self._num_slots = sum(self._client.nthreads().values())
            except (OSError, CancelledError) as error:
                raise self._lost() from error
            if self._num_slots:
                self._last_seen = now
            elif now - self._last_seen > PATIENCE_SECONDS and not self._has_warned:
                self._has_warned = True
                where = self.address or "this machine"
                logger.warning("%s: no worker is there; start some with: dask worker %s", where, where)
        return self._num_slots

    def _lost(self) -> ClusterError:
        return ClusterError(
            f"{self.address or 'local cluster'}: the Dask scheduler is gone; finished work is kept, start "
            "it and run the same command again"
        )


def _greet(address: str) -> None:
    """Raise an error if no scheduler answers; a client would leave threads behind, or wait for ever."""
    from distributed.comm import connect
    from distributed.security import Security

    async def greet() -> None:
        arguments = Security().get_connection_args("client")
        comm = await connect(address, timeout=CONNECT_SECONDS, **arguments)
        await comm.write({"op": "identity", "reply": True})
        answer = await comm.read()
        await comm.close()
        if answer.get("type") != "Scheduler":
            raise ValueError(f"it is a {answer.get('type')}")

    async def greet_in_time() -> None:
        await asyncio.wait_for(greet(), 1.5 * CONNECT_SECONDS)

    with ThreadPoolExecutor(1) as thread:  # the caller may be in a loop of its own, as in a notebook
        thread.submit(asyncio.run, greet_in_time()).result()


_current: ContextVar[Cluster | None] = ContextVar("cluster", default=None)


@contextlib.contextmanager
def connected(address: str | None, workers: int = 0) -> Iterator[Cluster | None]:
    """The cluster that was asked for, None if none was; one within another is the same.

    Raises
    ------
    ConfigError
        If both an address and local workers are asked for.
    DependencyError
        If Dask is not installed.
    ClusterError
        If no scheduler answers at the address.
    """
    if address and workers:
        raise ConfigError("--cluster and --workers: give one of them")
    known = _current.get()
    if not address and not workers:
        yield None
    elif known is not None and (known.address, known.workers) == (address or None, workers):
        yield known
    else:
        with Cluster(address or None, workers=workers) as cluster:
            token = _current.set(cluster)
            try:
                yield cluster
            finally:
                _current.reset(token)


@functools.cache
def code_version() -> str:
    """The version of this corrsfm, and a hash of its source: before a release many have one number."""
    digest = hashlib.sha256()
    root = Path(__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode())
        digest.update(path.read_bytes())
    return f"{__version__} ({digest.hexdigest()[:12]})"


def _check_workers(versions: dict[str, str | Exception]) -> None:
    """Refuse workers that cannot do the work: those without corrsfm would die of the first task."""
    for where, found in sorted(versions.items()):
        # Of an error that its worker cannot send, Dask sends the text; one that is lost is no error here.
        if isinstance(found, Exception) and "corrsfm" in str(found):
            raise ClusterError(
                f"worker {where}: cannot run corrsfm {__version__} ({found}); install it there"
            )
        if isinstance(found, str) and found != code_version():
            raise _other_version(where, code_version(), found)


def _other_version(where: str, wanted: str, found: str) -> ClusterError:
    return ClusterError(f"worker {where}: has corrsfm {found}, the run has {wanted}; install the same there")


def _checked(version: str, function: Callable[..., R], arguments: tuple[Any, ...]) -> R:
    """On a worker: do a task if this is the corrsfm that sent it."""
    from distributed import get_worker

    where = get_worker().address
    if version != code_version():
        raise _other_version(where, version, code_version())
    try:
        return function(*arguments)
    except CorrsfmError as error:
        # Not every error can be made again from its text.
        raise ClusterError(f"worker {where}: {error}") from error


def _explained(outcome: Any) -> Any:
    """An outcome with what Dask says in words of ours."""
    from distributed import KilledWorker

    if isinstance(outcome, KilledWorker):
        return ClusterError(
            f"{MAX_SUBMISSIONS * (outcome.allowed_failures + 1)} workers died while they did this, the last "
            f"at {outcome.last_worker.address}; see their logs, and run the same command again"
        )
    is_missing = isinstance(outcome, ImportError | AttributeError) and "corrsfm" in str(outcome)
    if is_missing or (isinstance(outcome, RuntimeError) and "deserialization" in str(outcome)):
        why = str(outcome).partition("\n")[0]
        return ClusterError(
            f"the scheduler or a worker cannot run corrsfm {__version__} ({why}); install the same there"
        )
    return outcome
