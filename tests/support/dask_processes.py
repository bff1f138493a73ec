"""A scheduler and workers of Dask as processes that can be killed, and what must be equal afterwards."""

import os
import random
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from corrsfm import open_workspace

REPOSITORY = Path(__file__).resolve().parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class DaskProcesses:
    """A scheduler and workers on this machine; a context manager that ends them."""

    def __init__(self, num_workers: int, environment: dict[str, str] | None = None) -> None:
        self.address = f"tcp://127.0.0.1:{free_port()}"
        self._environment = {**ENVIRONMENT, **(environment or {})}
        self.scheduler = self._start_scheduler()
        self.workers = [self._start_worker() for _ in range(num_workers)]

    def __enter__(self) -> "DaskProcesses":
        return self

    def __exit__(self, *_: object) -> None:
        for process in [*self.workers, self.scheduler]:
            process.kill()
            process.wait()

    def _start(self, *words: str) -> subprocess.Popen:
        return subprocess.Popen(
            [sys.executable, "-W", "ignore", "-m", *words, "--no-dashboard"],
            env=self._environment, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip

    def _start_scheduler(self) -> subprocess.Popen:
        host, port = self.address.removeprefix("tcp://").split(":")
        process = self._start("distributed.cli.dask_scheduler", "--host", host, "--port", port)
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            try:
                socket.create_connection((host, int(port)), 1).close()
                return process
            except OSError:
                time.sleep(0.1)
        raise TimeoutError("no scheduler")

    def _start_worker(self) -> subprocess.Popen:
        return self._start(
            "distributed.cli.dask_worker", self.address, "--nthreads", "1", "--no-nanny",
            "--memory-limit", "0", "--death-timeout", "30",
        )  # fmt: skip

    def replace_worker(self, number: int, signal_number: int = signal.SIGKILL) -> None:
        """Kill a worker, but nothing that it started, and start another one in its place."""
        self.workers[number].send_signal(signal_number)
        self.workers[number].wait()
        self.workers[number] = self._start_worker()

    def replace_scheduler(self) -> None:
        """Kill the scheduler and its workers, and start others at the same address."""
        for process in [self.scheduler, *self.workers]:
            process.kill()
            process.wait()
        self.scheduler = self._start_scheduler()
        self.workers = [self._start_worker() for _ in self.workers]


@dataclass
class Storm:
    """Kills at random moments while a command runs, which is started again until it succeeds.

    Attributes
    ----------
    under_way : Path
        Exists while workers have something to do; at other times none is killed.
    kills : Counter
        Of workers, clients and schedulers.
    ends : Counter
        How the command ended, each time.
    """

    command: list[str]
    processes: DaskProcesses
    random: random.Random
    under_way: Path
    pause: tuple[float, float] = (0.5, 6.0)
    odds: tuple[float, float, float] = (0.9, 0.05, 0.05)
    max_kills: int = 1_000_000
    kills: Counter = field(default_factory=Counter)
    ends: Counter = field(default_factory=Counter)
    errors: list[str] = field(default_factory=list)

    def run(self, seconds: float) -> None:
        """Run the command to its success; `TimeoutError` after some seconds."""
        deadline = time.monotonic() + seconds
        while True:
            process = subprocess.Popen(
                self.command, env=ENVIRONMENT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT, text=True,
            )  # fmt: skip
            with process:
                self._kill_around(process, deadline)
                output, _ = process.communicate()
            self.ends[process.returncode] += 1
            if process.returncode == 0:
                return
            if process.returncode != -signal.SIGKILL:
                self.errors.append(output.strip())

    def _kill_around(self, process: subprocess.Popen, deadline: float) -> None:
        while True:
            try:
                process.wait(self.random.uniform(*self.pause))
                return
            except subprocess.TimeoutExpired:
                pass
            if time.monotonic() > deadline:
                process.kill()
                raise TimeoutError(f"{dict(self.kills)} {self.errors}")
            if self.kills.total() >= self.max_kills or not self.under_way.exists():
                continue
            (target,) = self.random.choices(["worker", "client", "scheduler"], self.odds)
            self.kills[target] += 1
            if target == "worker":
                self.processes.replace_worker(self.random.randrange(len(self.processes.workers)))
            elif target == "client":
                process.kill()
            else:
                self.processes.replace_scheduler()


def differences(first: Path, second: Path) -> list[str]:
    """What two workspaces do not have in common: items, byte by byte, rows of the database, model files."""
    scene0, scene1 = open_workspace(first), open_workspace(second)
    found = [name for name in ("photos", "pairs") if getattr(scene0, name) != getattr(scene1, name)]
    for kind, keys in (("features", scene0.photos), ("matches", scene0.pairs), ("kept", scene0.pairs)):
        for key in keys:
            values0, values1 = (dict(_parts(getattr(scene, kind)(key))) for scene in (scene0, scene1))
            if values0 != values1:
                found.append(f"{kind} of {key}")
    if _rows(first / "database.db") != _rows(second / "database.db"):
        found.append("database.db")
    models0, models1 = (
        {path.relative_to(root).as_posix(): path.read_bytes() for path in sorted(root.glob("sparse/*/*.bin"))}
        for root in (first, second)
    )
    return found + [f"model file {name}" for name in models0.keys() | models1.keys()
                    if models0.get(name) != models1.get(name)]  # fmt: skip


def _parts(item: object, prefix: str = "") -> Iterator[tuple[str, object]]:
    """Every field of an item, arrays as bytes."""
    for name, value in vars(item).items():
        if isinstance(value, np.ndarray):
            yield prefix + name, (value.dtype.str, value.shape, value.tobytes())
        elif hasattr(value, "__dataclass_fields__"):
            yield from _parts(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _rows(path: Path) -> dict[str, list[tuple]] | None:
    if not path.exists():
        return None
    with closing(sqlite3.connect(path)) as connection:
        tables = [
            name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        ]
        return {table: sorted(connection.execute(f"SELECT * FROM {table}"), key=repr) for table in tables}


@contextmanager
def no_orphans(folder: Path) -> Iterator[None]:
    """Check that no process that was called with something in a folder is left."""
    yield
    deadline = time.monotonic() + 10
    while (left := _called_with(folder)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not left, left


def _called_with(folder: Path) -> list[str]:
    command = ["ps", "-eww", "-o", "pid,args"]
    listing = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return [line for line in listing.splitlines() if str(folder) in line]
