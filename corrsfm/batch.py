"""Many scenes, each in its own process, on this machine or on an existing Dask cluster.

A scene that fails does not stop the others. Running the batch again resumes each scene where it stopped, as
`corrsfm run` does. An interrupted batch ends the scenes on this machine; those that a Dask worker has begun
run to their end.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import logging
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from corrsfm.config import load_pipeline
from corrsfm.errors import DependencyError, InputError, WorkspaceError
from corrsfm.images.listing import holds_pictures
from corrsfm.machine import count_threads

__all__ = ["SceneStatus", "find_scenes", "run_collection"]

logger = logging.getLogger("corrsfm")

LOG_NAME = "batch.log"
GRACE_SECONDS = 10.0
POLL_SECONDS = 0.5


@dataclass(frozen=True, kw_only=True)
class SceneStatus:
    """How one scene of a batch ended.

    Attributes
    ----------
    scene : str
    succeeded : bool
    seconds : float
    message : str
        The error, if there was one.
    empty : bool
        There was nothing to do: the folder holds no photo. It did not succeed then, and did not fail either.
    verdict : str
        The grade of the first model; empty if there is no verdict.
    statistics : dict
        The numbers of the summary in the `report.json` of a scene that succeeded; else empty.
    """

    scene: str
    succeeded: bool
    seconds: float
    message: str = ""
    empty: bool = False
    verdict: str = ""
    statistics: dict[str, float] = field(default_factory=dict)

    @property
    def failed(self) -> bool:
        """Whether there were photos and no model came out."""
        return not self.succeeded and not self.empty

    def __str__(self) -> str:
        """One line for a person, but for the further lines of a message."""
        result = "ok    " if self.succeeded else "empty " if self.empty else "FAILED"
        outcome = self.message
        if self.succeeded and "num_images" in self.statistics:
            num, num_all = (f"{self.statistics[key]:g}" for key in ("num_registered", "num_images"))
            outcome = ", ".join(filter(None, [f"{num} of {num_all} photos", self.verdict]))
        # A name on disk need not be text.
        scene = self.scene.encode("utf-8", "replace").decode().replace("\n", "?")
        text = f"{scene:<24} {result} {self.seconds:8.1f} s  {outcome}"
        return text.rstrip().replace("\n", "\n    ")


def find_scenes(collection: Path, *, leave_out: Path | None = None) -> dict[str, Path]:
    """Scenes of a collection: the sub-folders, or their folder `images` where they have one.

    Parameters
    ----------
    collection : Path
    leave_out : Path, optional
        A sub-folder to skip.

    Returns
    -------
    dict
        Scene name → folder of photos, sorted by name.

    Raises
    ------
    InputError
        If there is none.
    """
    if not collection.is_dir():
        raise InputError(f"{collection}: not a folder; expected one with a sub-folder for each scene")
    other = leave_out.resolve() if leave_out is not None else None
    try:
        folders = sorted(path for path in collection.iterdir() if path.is_dir())
    except OSError as error:
        raise InputError(f"{collection}: cannot be read ({error.strerror}); check its permissions") from error
    scenes = {
        folder.name: _photos_of(folder)
        for folder in folders
        if not folder.name.startswith(".") and folder.resolve() != other
    }
    if not scenes:
        raise InputError(
            f"{collection}: no sub-folders; expected one for each scene; for photos of one scene: corrsfm run"
        )
    return scenes


def _photos_of(scene: Path) -> Path:
    try:
        return scene / "images" if (scene / "images").is_dir() else scene
    except OSError:
        # The scene's own run says that it may not be read.
        return scene


def run_collection(
    collection: Path, output: Path, arguments: Sequence[str] = (), *, jobs: int = 1, dask: str | None = None
) -> list[SceneStatus]:
    """Run every scene of a collection; whatever happens to one is in its status, and the others go on.

    Parameters
    ----------
    collection : Path
        Folder with a sub-folder for each scene.
    output : Path
        The workspaces go to ``output/<scene>``.
    arguments : sequence of str
        Further arguments of `corrsfm run`.
    jobs : int
        Scenes at a time on this machine. They share its cores evenly, unless the arguments, or a pipeline
        file among them, say how many threads each may use.
    dask : str, optional
        Address of a Dask scheduler whose workers see the same files; its workers then run the scenes.

    Returns
    -------
    list of SceneStatus
        Sorted by scene.

    Raises
    ------
    InputError
        If the collection holds no scene.
    WorkspaceError
        If the output cannot be written.
    KeyboardInterrupt
        On Ctrl-C or SIGTERM, after ending the scenes under way; the same call resumes them.
    """
    scenes = find_scenes(collection, leave_out=output)
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WorkspaceError(f"{output}: cannot be made ({error.strerror}); choose another folder") from error
    statuses: list[SceneStatus] = []
    processes = _Processes()
    # Dask could not send the processes of this machine to a worker.
    work: Callable[..., SceneStatus] = run_one
    if dask is None:
        work = functools.partial(run_one, call=processes.call)
    threads = _threads_argument(arguments, min(jobs, len(scenes))) if dask is None else []
    waiting: dict[Future[SceneStatus], str] = {}
    with _terminable(), _executor(jobs, dask) as executor:
        try:
            for scene, images in scenes.items():
                places = str(images.resolve()), str((output / scene).resolve())
                waiting[executor.submit(work, scene, *places, [*threads, *arguments])] = scene
            with tqdm(total=len(waiting), desc="scenes", unit="scene") as bar:
                pending = set(waiting)
                logger.info("scenes to do: %d", len(pending))
                while pending:
                    # An unbounded wait can miss an interruption that comes just before it.
                    done, pending = wait(pending, POLL_SECONDS, FIRST_COMPLETED)
                    for future in done:
                        statuses.append(_status_of(waiting[future], future))
                        bar.update()
                        logger.info("[%d/%d] %s", len(statuses), len(waiting), statuses[-1])
        except BaseException:
            for future in waiting:
                future.cancel()
            processes.end()
            raise
    return sorted(statuses, key=lambda status: status.scene)


def _status_of(scene: str, future: Future[SceneStatus]) -> SceneStatus:
    """How a scene ended, also where the process or the machine that ran it did."""
    try:
        return future.result()
    except Exception as error:
        message = f"Error: {type(error).__name__}: {error}; run the same command again"
        return SceneStatus(scene=scene, succeeded=False, seconds=0.0, message=message)


def _threads_argument(arguments: Sequence[str], jobs: int) -> list[str]:
    """Arguments that give each concurrent scene its share of the cores, unless the user chose."""
    if jobs == 1 or any(argument.split("=")[0] == "--threads" for argument in arguments):
        return []
    for argument, following in itertools.pairwise([*arguments, ""]):
        flag, _, value = argument.partition("=")
        if flag == "--pipeline" and load_pipeline(Path(value or following)).run.threads:
            return []
    return ["--threads", str(max(1, count_threads(0) // jobs))]


class _Processes:
    """The processes of the scenes on this machine; `end` ends them together."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen] = set()
        self._ended = False

    def call(self, command: Sequence[str], **streams: Any) -> int:
        """Like `subprocess.call`, but starts nothing after `end`."""
        with self._lock:
            if self._ended:
                return -signal.SIGTERM
            process = subprocess.Popen(command, **streams)
            self._running.add(process)
        try:
            return process.wait()
        finally:
            with self._lock:
                self._running.discard(process)

    def end(self) -> None:
        """Terminate all processes, and kill those that do not react."""
        with self._lock:
            self._ended = True
            running = list(self._running)
        for process in running:
            process.terminate()
        deadline = time.monotonic() + GRACE_SECONDS
        for process in running:
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Turn SIGTERM into an interruption; by default it ends this process and leaves its scenes running."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread may set handlers
        yield
        return

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _executor(jobs: int, dask: str | None) -> Executor:
    if dask is None:
        return ThreadPoolExecutor(jobs)
    try:
        from distributed import Client
    except ImportError as error:
        raise DependencyError("distributed", "running scenes on a Dask cluster", "cluster") from error
    return Client(dask).get_executor(pure=False)


def run_one(
    scene: str,
    images: str,
    workspace: str,
    arguments: list[str],
    *,
    call: Callable[..., int] = subprocess.call,
) -> SceneStatus:
    """Run one scene in its own process; its output goes to a log beside its workspace."""
    started = time.monotonic()
    if not _lists_photos(arguments) and not holds_pictures(Path(images)):
        return SceneStatus(scene=scene, succeeded=False, empty=True, seconds=0.0, message="no photos")
    log = Path(f"{workspace}.{LOG_NAME}")
    command = [sys.executable, "-m", "corrsfm", "--quiet", "run", images, workspace, *arguments]
    try:
        with open(log, "w", encoding="utf-8") as handle:
            code = call(command, stdout=handle, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
        message = "" if code == 0 else _last_error(log) or f"ended with code {code}"
    except OSError as error:
        code, message = 1, f"Error: {log}: cannot be written ({error.strerror}); the scene was not run"
    summary = _summary(Path(workspace) / "report.json") if code == 0 else {}
    return SceneStatus(
        scene=scene,
        succeeded=code == 0,
        seconds=round(time.monotonic() - started, 1),
        message=message,
        verdict=str(summary.get("verdict") or ""),
        statistics={key: value for key, value in summary.items() if isinstance(value, int | float)},
    )


def _lists_photos(arguments: Sequence[str]) -> bool:
    """Whether a list, and no suffix, says which files are photos."""
    return any(argument.split("=")[0] in ("--image-list", "--pipeline") for argument in arguments)


def _last_error(log: Path) -> str:
    """All lines of the last error in a log, or the last line if there is no error."""
    lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    starts = [number for number, line in enumerate(lines) if line.startswith("Error:")]
    return "\n".join(lines[starts[-1] if starts else -1 :])


def _summary(report: Path) -> dict[str, Any]:
    """The summary of a report; empty if there is none."""
    try:
        return dict(json.loads(report.read_text(encoding="utf-8"))["summary"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}
