"""corrsfm: structure from motion with learned correspondence pruning.

The names below are the public interface; each is loaded when it is first used, so that importing the package
costs nothing.

::

    check_photos(photos)                                what to know of photos before a run
    forecast_run(folder, names)                         minutes and disk of a run, by a short measurement
    run_scene(photos, workspace, PipelineConfig())      photos → models and a report
    import_features(photos, workspace, features=…)      bring in features and matches of another tool
    open_workspace(folder)                              read what the stages left there
    check_workspace(workspace)                          what is weak about a model, and what to try next
    add_photos(workspace, photos)                       more photos for a model that does not move
    localize(workspace, photos)                         poses of photos that do not join
    export_scene(workspace, output, "nerfstudio")       hand the model and its photos to the next tool
    Pruner.load()(pairs)                                prune matches of your own
    correspondences_from_points(points0, points1, …)    such matches, from two arrays and two cameras
    load_network(checkpoint)                            the network itself, tensors in and out
"""

from __future__ import annotations

import importlib

# pycolmap's wheel exports zlib symbols; unless the real zlib is loaded first, the first zlib compression
# after `import pycolmap` aborts the process.
import zlib  # noqa: F401

TYPE_CHECKING = False  # typing takes a third of the time to import, which "corrsfm --help" should not
if TYPE_CHECKING:
    from typing import Any

    from corrsfm.config import PipelineConfig
    from corrsfm.export.scene import ExportResult, export_scene
    from corrsfm.finished.add import AddResult, add_photos
    from corrsfm.finished.check import WorkspaceCheck, check_workspace
    from corrsfm.finished.localize import LocalizeResult, localize
    from corrsfm.forecast import Forecast, forecast_run
    from corrsfm.images.check import PhotosCheck, check_photos
    from corrsfm.importing.scene import ImportResult, import_features
    from corrsfm.model import load_network
    from corrsfm.pipeline import run_scene
    from corrsfm.prune.correspondences import correspondences_from_points
    from corrsfm.prune.learned import Pruner
    from corrsfm.types import Camera, Correspondences, Features, Matches, PruneResult
    from corrsfm.workspace.scene import Scene, open_workspace

__version__ = "0.1.0"

__all__ = [
    "AddResult",
    "Camera",
    "Correspondences",
    "ExportResult",
    "Features",
    "Forecast",
    "ImportResult",
    "LocalizeResult",
    "Matches",
    "PhotosCheck",
    "PipelineConfig",
    "PruneResult",
    "Pruner",
    "Scene",
    "WorkspaceCheck",
    "__version__",
    "add_photos",
    "check_photos",
    "check_workspace",
    "correspondences_from_points",
    "export_scene",
    "forecast_run",
    "import_features",
    "load_network",
    "localize",
    "open_workspace",
    "run_scene",
]

_HOMES = {
    "AddResult": "finished.add",
    "Camera": "types",
    "Correspondences": "types",
    "ExportResult": "export.scene",
    "Features": "types",
    "Forecast": "forecast",
    "ImportResult": "importing.scene",
    "LocalizeResult": "finished.localize",
    "Matches": "types",
    "PhotosCheck": "images.check",
    "PipelineConfig": "config",
    "PruneResult": "types",
    "Pruner": "prune.learned",
    "Scene": "workspace.scene",
    "WorkspaceCheck": "finished.check",
    "add_photos": "finished.add",
    "check_photos": "images.check",
    "check_workspace": "finished.check",
    "correspondences_from_points": "prune.correspondences",
    "export_scene": "export.scene",
    "forecast_run": "forecast",
    "import_features": "importing.scene",
    "load_network": "model",
    "localize": "finished.localize",
    "open_workspace": "workspace.scene",
    "run_scene": "pipeline",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
