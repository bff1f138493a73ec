"""Exporting a workspace: what can be had is checked first, and the export appears whole or not at all."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pycolmap

from corrsfm.colmap.models import poses_of
from corrsfm.disk import why_not
from corrsfm.errors import InputError, WorkspaceError, first_few
from corrsfm.export import ExportTarget
from corrsfm.export.colmap import write_colmap, write_colmap3
from corrsfm.export.gps import GpsFit, fit_to_gps
from corrsfm.export.hloc import write_hloc
from corrsfm.export.mvs import write_bundler, write_nvm, write_openmvs
from corrsfm.export.photos import check_photos
from corrsfm.export.tables import write_csv, write_ply
from corrsfm.export.trainers import write_nerfstudio, write_splat
from corrsfm.export.world import common_up, crop_to_bulk, held_upright, scale_of, similarity, turn_to_z
from corrsfm.files import atomic_path, read_json
from corrsfm.geometry import Pose
from corrsfm.images.photos import read_photo_info
from corrsfm.workspace import Workspace
from corrsfm.workspace.lists import read_index
from corrsfm.workspace.models import changed_models, models_of

__all__ = ["ExportResult", "export_scene"]

logger = logging.getLogger("corrsfm")

_FILES = (ExportTarget.PLY, ExportTarget.CSV)
_WITHOUT_PHOTOS = (*_FILES, ExportTarget.HLOC)
_NEED_POINTS = (
    ExportTarget.SPLAT, ExportTarget.OPENMVS, ExportTarget.BUNDLER, ExportTarget.NVM, ExportTarget.PLY,
)  # fmt: skip
# Their lists are text with spaces between names and numbers.
_NO_SPACES = (ExportTarget.HLOC, ExportTarget.OPENMVS, ExportTarget.BUNDLER, ExportTarget.NVM)


@dataclass(frozen=True, kw_only=True)
class ExportResult:
    """What was exported.

    Attributes
    ----------
    target : ExportTarget
    output : Path
    photos, left_out : tuple of str
        Photos of the scene that the model ``sparse/0`` holds and that it does not, sorted.
    num_points, num_cropped : int
        Points of the exported model, and how many cropping dropped.
    scale : float
        Exported units per unit of ``sparse/0``; metres if a distance was given.
    gps : GpsFit or None
        How the model lies on the ground, if it was fitted to GPS positions; of the model after ``upright``.
    rotation : tuple of tuple of float
        Rows of the rotation (3, 3) from the axes of ``sparse/0`` to the exported ones, those of the target's
        own convention apart.
    verdict : str or None
        Grade of the model: good, doubtful or wrong; None if there is no record.
    """

    target: ExportTarget
    output: Path
    photos: tuple[str, ...]
    left_out: tuple[str, ...]
    num_points: int
    num_cropped: int
    scale: float
    rotation: tuple[tuple[float, ...], ...]
    gps: GpsFit | None
    verdict: str | None

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {**asdict(self), "target": str(self.target), "output": str(self.output)}


def export_scene(
    workspace: Path | str,
    output: Path | str,
    target: ExportTarget | str,
    *,
    images_dir: Path | str | None = None,
    upright: bool = False,
    scale: tuple[str, str, float] | Literal["gps"] | None = None,
    crop: bool = False,
) -> ExportResult:
    """Export the model ``sparse/0`` of a workspace with its photos for another tool.

    Parameters
    ----------
    workspace : path
    output : path
        A folder that does not exist or is empty; for ``ply`` and ``csv`` a file that does not exist.
    target : ExportTarget or str
    images_dir : path, optional
        Where the photos are now, if not where they were reconstructed from.
    upright : bool
        Turn the world so that the cameras' common up is +z.
    scale : (str, str, float) or "gps", optional
        Two photos and the distance of their centres in metres; or ``gps``, to fit the model to the positions
        in EXIF: metres east, north and up of their middle, turned about +z only with ``upright``.
    crop : bool
        Drop points outside twice the box that holds the middle 90 % of them along each axis.

    Returns
    -------
    ExportResult

    Raises
    ------
    InputError
        If the output is not free, photos are gone, the model lacks points that the target needs, or a camera
        or name does not fit the target. Nothing is left behind.
    WorkspaceError
        If the workspace has no current model, another process works there, or the output cannot be written.
    """
    source, target = Workspace(Path(workspace)), _target_of(target)
    with source.reading():
        _require_model(source, needs_features=target is ExportTarget.HLOC)
        # Not in place of a link, which may lead to a larger disk.
        leads_on = os.path.islink(output) and os.path.isdir(output)
        path = Path(output).resolve() if leads_on else Path(output)
        return _export_models(source, path, target, images_dir, upright, scale, crop)


def _export_models(
    source: Workspace,
    path: Path,
    target: ExportTarget,
    images_dir: Path | str | None,
    upright: bool,
    scale: tuple[str, str, float] | Literal["gps"] | None,
    crop: bool,
) -> ExportResult:
    """As `export_scene`, while nobody writes in the workspace."""
    photos = Path(images_dir) if images_dir is not None else source.images_dir
    _check_output(path, source, photos, is_file=target in _FILES)
    index = read_index(source)
    model = models_of(source)[0]
    names = tuple(poses_of(model))
    if target in _NO_SPACES and (spaced := [name for name in names if " " in name]):
        raise InputError(
            f"--for {target} writes lists that cannot hold spaces: {first_few(spaced)}; rename the photos "
            "and reconstruct again"
        )
    if target not in _WITHOUT_PHOTOS:
        check_photos(model, photos, {record.name: record.sha256 for record in index.records})

    turn, factor, fit = np.eye(3), 1.0, None
    if upright:
        turn = turn_to_z(common_up(_as_held(model, photos)))
        model.transform(similarity(turn, 1.0))
    if scale == "gps":
        positions = {record.name: record.gps for record in index.records if record.gps is not None}
        fit = fit_to_gps(poses_of(model), positions, is_upright=upright)
        turn, factor = np.array(fit.rotation) @ turn, fit.scale
        model.transform(similarity(fit.rotation, fit.scale, fit.translation))
    elif scale is not None:
        factor = scale_of(model, *scale)
        model.transform(similarity(np.eye(3), factor))
    num_cropped = crop_to_bulk(model) if crop else 0
    if target in _NEED_POINTS and not model.num_points3D():
        raise InputError(f"{source.sparse / '0'}: holds no points, which --for {target} needs")

    try:
        with atomic_path(path) as temporary:
            if target not in _FILES:
                temporary.mkdir()
            _writers(source, photos, upright or fit is not None)[target](model, temporary)
    except OSError as error:
        raise WorkspaceError(f"{why_not(error, path, 'written')}; nothing is left there") from error
    return ExportResult(
        target=target,
        output=path,
        photos=names,
        left_out=tuple(name for name in index.names if name not in set(names)),
        num_points=model.num_points3D(),
        num_cropped=num_cropped,
        scale=factor,
        rotation=tuple(tuple(float(value) for value in row) for row in turn),
        gps=fit,
        verdict=_verdict_of(source),
    )


def _require_model(source: Workspace, *, needs_features: bool) -> None:
    """Refuse a model that does not belong to the database; warn of one that photos have changed since."""
    record = source.record_of("models")
    made_from = record.inputs if record is not None else {}
    held = {stage: one.fingerprint for stage in made_from if (one := source.record_of(stage)) is not None}
    try:
        source.require("models")
    except WorkspaceError as error:
        if record is None or held != made_from or needs_features:
            raise
        # A run that stopped at a bad photo must not take the finished model away.
        logger.warning("%s; the model from before is exported", error)


def _as_held(model: pycolmap.Reconstruction, photos: Path) -> list[Pose]:
    """Poses of the cameras, turned as EXIF says where the photos are there."""
    return [
        held_upright(pose, read_photo_info(photos / name).orientation if (photos / name).is_file() else 1)
        for name, pose in poses_of(model).items()
    ]


def _writers(
    source: Workspace, photos: Path, upright: bool
) -> dict[ExportTarget, Callable[[pycolmap.Reconstruction, Path], None]]:
    """The function of each target: a model and a path to write to, which does not exist unless a folder."""
    return {
        ExportTarget.SPLAT: lambda model, path: write_splat(model, photos, path),
        ExportTarget.NERFSTUDIO: lambda model, path: write_nerfstudio(model, photos, path, z_is_up=upright),
        ExportTarget.COLMAP: lambda model, path: write_colmap(model, photos, source.database, path),
        ExportTarget.COLMAP3: lambda model, path: write_colmap3(model, photos, source.database, path),
        ExportTarget.HLOC: lambda model, path: write_hloc(model, source, path),
        ExportTarget.OPENMVS: lambda model, path: write_openmvs(model, photos, path),
        ExportTarget.BUNDLER: lambda model, path: write_bundler(model, photos, path),
        ExportTarget.NVM: lambda model, path: write_nvm(model, photos, path),
        ExportTarget.PLY: write_ply,
        ExportTarget.CSV: write_csv,
    }


def _target_of(name: ExportTarget | str) -> ExportTarget:
    try:
        return ExportTarget(name)
    except ValueError as error:
        raise InputError(f"no export for '{name}'; choose one of {', '.join(ExportTarget)}") from error


def _check_output(path: Path, workspace: Workspace, photos: Path, *, is_file: bool) -> None:
    """Refuse a place where something would be lost or mixed up."""
    place = path.resolve()
    if place == workspace.root.resolve():
        raise InputError(f"{path}: is the workspace; choose another folder, such as {path / 'export'}")
    for folder, what in ((workspace.sparse, "the models of the workspace"), (photos, "the photos")):
        if place.is_relative_to(folder.resolve()):
            raise InputError(f"{path}: lies in the folder of {what}; choose another place")
    if is_file:
        if os.path.lexists(path):
            raise InputError(f"{path}: exists already; choose another name for the file, or remove it")
    elif path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; expected a folder to export to")
    elif path.is_dir() and any(path.iterdir()):
        raise InputError(f"{path}: is not empty; choose another folder, or remove it")


def _verdict_of(workspace: Workspace) -> str | None:
    """The grade of the model; logged with reasons and a next step unless it is good."""
    if changed_models(workspace):
        return None
    try:
        verdict = read_json(workspace.evidence)["verdict"]
        grade, reasons, steps = verdict["grade"], verdict["reasons"], verdict["next_steps"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if grade != "good":
        advice = f"; try {steps[0]}" if steps else ""
        logger.warning("the verdict on this model is %s: %s%s", grade, "; ".join(reasons), advice)
    return str(grade)
