"""Many scenes, each in its own process, on this machine or on an existing Dask cluster.

A scene that fails does not stop the others. Running the batch again resumes each scene where it stopped, as
`corrsfm run` does. An interrupted batch ends the scenes on this machine; those that a Dask worker has begun
run to their end, and a later batch waits for them. A scene's process ends with the one that started it, so
that a worker that was killed leaves nothing that holds the workspace.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from corrsfm.cluster import Cluster
from corrsfm.config import load_pipeline
from corrsfm.disk import why_not
from corrsfm.errors import ClusterError, CorrsfmError, InputError, WorkspaceError, printable
from corrsfm.files import read_json
from corrsfm.images.listing import holds_pictures
from corrsfm.machine import count_threads

__all__ = ["SceneStatus", "find_scenes", "run_collection"]

logger = logging.getLogger("corrsfm")

LOG_NAME = "batch.log"
# Shorter than what a command has to clear up after SIGTERM, so that there is time to tell how to go on.
GRACE_SECONDS = 5.0
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
        # A name on disk need not be text, nor one line.
        scene = printable(self.scene).replace("\n", "\\n").replace("\t", "\\t")
        text = f"{scene:<24} {result} {self.seconds:8.1f} s  {outcome}"
        return text.rstrip().replace("\n", "\n    ")


def find_scenes(collection: Path, *, leave_out: Path | None = None) -> dict[str, Path]:
    """Scenes of a collection: the sub-folders, or their folder `images` where they have one.

    Folders of workspaces, such as the output of another batch, are none.

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
    try:
        folders = sorted(path for path in collection.iterdir() if _is_folder(path))
    except OSError as error:
        raise InputError(f"{collection}: cannot be read ({error.strerror}); check its permissions") from error
    scenes = {
        folder.name: _photos_of(folder)
        for folder in folders
        if not folder.name.startswith(".")
        and not (leave_out is not None and _are_same(folder, leave_out))
        and not _holds_workspaces(folder)
    }
    if not scenes:
        raise InputError(
            f"{collection}: no sub-folders; expected one for each scene; for photos of one scene: corrsfm run"
        )
    return scenes


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError:
        # A link into a folder that may not be read.
        return True


def _are_same(folder: Path, other: Path) -> bool:
    try:
        return os.path.samefile(folder, other)
    except OSError:
        return False


def _holds_workspaces(folder: Path) -> bool:
    """Whether there is nothing in a folder but workspaces and files of a batch."""
    try:
        inside = [path for path in folder.iterdir() if not path.name.startswith(".")]
        # A batch leaves a log beside each workspace.
        others = [path for path in inside if not path.name.endswith(LOG_NAME)]
        return bool(others) and all((path / "workspace.json").is_file() for path in others)
    except OSError:
        return False


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
        If the collection holds no scene, or is the output.
    WorkspaceError
        If the output cannot be written.
    KeyboardInterrupt
        On Ctrl-C or SIGTERM, after ending the scenes under way; the same call resumes them.
    """
    scenes = find_scenes(collection, leave_out=output)
    if output.resolve() == collection.resolve():
        raise InputError(
            f"{output}: is the collection itself; choose another folder, such as {output / 'out'}"
        )
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WorkspaceError(f"{why_not(error, output, 'made')}; or choose another folder") from error
    threads = _threads_argument(arguments, min(jobs, len(scenes))) if dask is None else []
    tasks = [
        # Not resolved: a link that leads nowhere is the trouble of its scene alone.
        (scene, (scene, os.path.abspath(images), os.path.abspath(output / scene), [*threads, *arguments]))
        for scene, images in scenes.items()
    ]
    statuses: list[SceneStatus] = []
    with _terminable(), tqdm(total=len(tasks), desc="scenes", unit="scene") as bar:
        logger.info("scenes to do: %d", len(tasks))
        with contextlib.closing(_here(tasks, jobs) if dask is None else _on_dask(tasks, dask)) as outcomes:
            for scene, outcome in outcomes:
                statuses.append(_status_of(scene, outcome))
                bar.update()
                logger.info("[%d/%d] %s", len(statuses), len(tasks), statuses[-1])
    return sorted(statuses, key=lambda status: status.scene)


Task = tuple[str, tuple[str, str, str, list[str]]]
"""A scene, and the arguments of `run_one`."""
Outcomes = Generator[tuple[str, SceneStatus | Exception], None, None]


def _here(tasks: Sequence[Task], jobs: int) -> Outcomes:
    """Run scenes on this machine; those under way end when the caller wants no more."""
    processes = _Processes()
    with ThreadPoolExecutor(jobs) as executor:
        waiting = {
            executor.submit(run_one, *arguments, call=processes.call): scene for scene, arguments in tasks
        }
        try:
            pending = set(waiting)
            while pending:
                # An unbounded wait can miss an interruption that comes just before it.
                done, pending = wait(pending, POLL_SECONDS, FIRST_COMPLETED)
                for future in done:
                    error = future.exception()
                    if error is not None and not isinstance(error, Exception):
                        raise error
                    yield waiting[future], error or future.result()
        finally:
            for future in waiting:
                future.cancel()
            processes.end()


def _on_dask(tasks: Sequence[Task], address: str) -> Outcomes:
    """Run scenes on the workers of a scheduler; if it is lost, so are the answers of all that is left."""
    left = {scene for scene, _ in tasks}
    with Cluster(address) as cluster:
        try:
            for scene, outcome in cluster.outcomes(run_one, tasks):
                left.remove(scene)
                yield scene, outcome
        except ClusterError as error:
            for scene in sorted(left):
                yield scene, error


def _status_of(scene: str, outcome: SceneStatus | Exception) -> SceneStatus:
    """How a scene ended, also where the process or the machine that ran it did."""
    if isinstance(outcome, SceneStatus):
        return outcome
    what = str(outcome)
    if not isinstance(outcome, CorrsfmError):
        what = f"{type(outcome).__name__}: {what}; run the same command again"
    return SceneStatus(scene=scene, succeeded=False, seconds=0.0, message=f"Error: {what}")


def _threads_argument(arguments: Sequence[str], jobs: int) -> list[str]:
    """Arguments that give each concurrent scene its share of the cores, unless the user chose."""
    if jobs == 1 or _value_of("--threads", arguments):
        return []
    pipeline = _value_of("--pipeline", arguments)
    if pipeline and load_pipeline(Path(pipeline)).run.threads:
        return []
    return ["--threads", str(max(1, count_threads(0) // jobs))]


def _value_of(flag: str, arguments: Sequence[str]) -> str:
    """The value that is given for an option; empty if it is not there."""
    for argument, following in itertools.pairwise([*arguments, ""]):
        name, _, value = argument.partition("=")
        if name == flag:
            return value or following
    return ""


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
        with process:
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
    in_main_thread = threading.current_thread() is threading.main_thread()
    # Only there a handler may be set; a command has one already, which knows what to say.
    if not in_main_thread or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _open_at_once(path: str, flags: int) -> int:
    """Open a file; a pipe that nobody reads is refused in place of waited for, and a link not followed."""
    return os.open(path, flags | os.O_NONBLOCK | os.O_NOFOLLOW, 0o666)


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
    command = [sys.executable, "-m", "corrsfm", "--quiet", "--attended", "run", images, workspace]
    # A scene of a batch that was killed may still be ending.
    command += ["--wait", *arguments]
    try:
        handle = open(log, "w", encoding="utf-8", opener=_open_at_once)  # noqa: SIM115
    except OSError as error:
        why = "is a link" if log.is_symlink() else error.strerror
        code, message = 1, f"Error: {log}: cannot be written ({why}); the scene was not run"
    else:
        with handle:
            # The pipe closes with this process, and the scene's process ends.
            code = call(command, stdout=handle, stderr=subprocess.STDOUT, stdin=subprocess.PIPE)
        message = _why(code, log)
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
    if _value_of("--image-list", arguments):
        return True
    pipeline = _value_of("--pipeline", arguments)
    return bool(pipeline) and load_pipeline(Path(pipeline)).images.image_list is not None


def _why(code: int, log: Path) -> str:
    """Why a scene's process failed; empty if it did not."""
    if code == 0:
        return ""
    if code > 0:
        return _last_error(log) or f"ended with code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    hint = ", as when memory runs out: give it fewer --threads, or the batch fewer --jobs"
    return f"Error: killed ({name}{hint if -code == signal.SIGKILL else ''}); run the same command again"


def _last_error(log: Path) -> str:
    """All lines of the last error in a log, or the last line if there is no error."""
    lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    starts = [number for number, line in enumerate(lines) if line.startswith("Error:")]
    return "\n".join(lines[starts[-1] if starts else -1 :])


def _summary(report: Path) -> dict[str, Any]:
    """The summary of a report; empty if there is none."""
    try:
        return dict(read_json(report)["summary"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}
