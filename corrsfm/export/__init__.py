"""From a finished reconstruction to the next tool.

::

    export/
    ├── scene.py        what is asked for and whether it can be had; one folder or file, written whole
    ├── world.py        upright, to scale, without stray points
    ├── photos.py       the photos of a model, as they are or undistorted
    ├── trainers.py     Gaussian splatting and nerfstudio
    ├── mvs.py          OpenMVS, Bundler, NVM: undistorted photos and text
    ├── colmap.py       COLMAP of today and COLMAP 3.8
    ├── hloc.py         hloc's features, matches and sfm folder
    └── tables.py       points as PLY, poses as CSV
"""

from __future__ import annotations

from enum import StrEnum

__all__ = ["ExportTarget"]


class ExportTarget(StrEnum):
    """What an export is for."""

    SPLAT = "splat"
    NERFSTUDIO = "nerfstudio"
    COLMAP = "colmap"
    COLMAP3 = "colmap3"
    HLOC = "hloc"
    OPENMVS = "openmvs"
    BUNDLER = "bundler"
    NVM = "nvm"
    PLY = "ply"
    CSV = "csv"
