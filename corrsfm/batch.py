"""Many scenes: every one a process of its own, on this machine or on an existing Dask cluster.

A scene that fails does not stop the others, and running the batch again goes on where each scene stopped,
because `corrsfm run` does.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path

from tqdm import tqdm

from corrsfm.errors import DependencyError, InputError

__all__ = ["SceneStatus", "find_scenes", "run_collection"]

LOG_NAME = "batch.log"


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
    statistics : dict
        Counts from the scene's `report.json`; empty if it has none.
    """

    scene: str
    succeeded: bool
    seconds: float
    message: str = ""
    statistics: dict[str, float] = field(default_factory=dict)


def find_scenes(collection: Path) -> dict[str, Path]:
    """Scenes of a collection: the sub-folders, or their folder `images` where they have one.

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
    scenes = {
        folder.name: folder / "images" if (folder / "images").is_dir() else folder
        for folder in sorted(collection.iterdir())
        if folder.is_dir() and not folder.name.startswith(".")
    }
    if not scenes:
        raise InputError(f"{collection}: no sub-folders; expected one for each scene")
    return scenes


def run_collection(
    collection: Path, output: Path, arguments: Sequence[str] = (), *, jobs: int = 1, dask: str | None = None
) -> list[SceneStatus]:
    """Run every scene of a collection.

    Parameters
    ----------
    collection : Path
        Folder with a sub-folder for each scene.
    output : Path
        The workspaces go to ``output/<scene>``.
    arguments : sequence of str
        Further arguments of `corrsfm run`.
    jobs : int
        Scenes at a time on this machine.
    dask : str, optional
        Address of a Dask scheduler whose workers see the same files; they run the scenes then.

    Returns
    -------
    list of SceneStatus
        Sorted by scene.
    """
    scenes = find_scenes(collection)
    output.mkdir(parents=True, exist_ok=True)
    statuses = []
    with _executor(jobs, dask) as executor:
        waiting = [
            executor.submit(
                run_one, scene, str(images.resolve()), str((output / scene).resolve()), list(arguments)
            )
            for scene, images in scenes.items()
        ]
        with tqdm(total=len(waiting), desc="scenes", unit="scene") as bar:
            for future in as_completed(waiting):
                statuses.append(future.result())
                bar.update()
    return sorted(statuses, key=lambda status: status.scene)


def _executor(jobs: int, dask: str | None) -> Executor:
    if dask is None:
        return ThreadPoolExecutor(jobs)
    try:
        from distributed import Client
    except ImportError as error:
        raise DependencyError("distributed", "running scenes on a Dask cluster", "cluster") from error
    return Client(dask).get_executor(pure=False)


def run_one(scene: str, images: str, workspace: str, arguments: list[str]) -> SceneStatus:
    """Run one scene in a process of its own; its output goes to `batch.log` beside its workspace."""
    started = time.monotonic()
    log = Path(f"{workspace}.{LOG_NAME}")
    command = [sys.executable, "-m", "corrsfm", "--quiet", "run", images, workspace, *arguments]
    with open(log, "w", encoding="utf-8") as handle:
        code = subprocess.run(
            command, stdout=handle, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL
        ).returncode
    lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    return SceneStatus(
        scene=scene,
        succeeded=code == 0,
        seconds=round(time.monotonic() - started, 1),
        message="" if code == 0 else lines[-1] if lines else f"ended with code {code}",
        statistics=_statistics(Path(workspace) / "report.json"),
    )


def _statistics(report: Path) -> dict[str, float]:
    try:
        values = json.loads(report.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return {key: value for key, value in values.items() if isinstance(value, int | float)}
