"""A reconstruction measured against known cameras."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from corrsfm.errors import InputError, lack_or_text
from corrsfm.evaluation.metrics import extent_of, pose_auc, position_errors, relative_pose_errors
from corrsfm.files import read_json
from corrsfm.geometry import Pose, camera_centre
from corrsfm.workspace import Workspace

__all__ = [
    "SCENE_THRESHOLDS_DEG",
    "SceneScore",
    "evaluate_scene",
    "find_model",
    "read_poses",
    "read_truth",
    "require_common_names",
    "score_poses",
]

SCENE_THRESHOLDS_DEG = (1.0, 5.0, 10.0)


@dataclass(frozen=True, kw_only=True)
class SceneScore:
    """How a reconstruction compares with known cameras.

    Attributes
    ----------
    num_photos : int
        Photos with known cameras.
    num_registered : int
        Those of them that are registered in the reconstruction.
    auc : dict of str to float
        Percent, by threshold in degrees: exact AUC of the relative pose over all pairs of photos with known
        cameras; a pair with an unregistered photo is a failure.
    median_pair_error_deg : float or None
        Over the pairs of registered photos.
    position_error_mean, position_error_median, position_error_max : float or None
        Distance of camera centres after the best similarity alignment, in units of the known cameras; None
        with fewer than three registered photos or centres on one line.
    extent : float
        Diagonal of the box around the known camera centres, to put the errors in proportion.
    position_error_percent : float or None
        Mean position error in percent of the extent.
    """

    num_photos: int
    num_registered: int
    auc: dict[str, float]
    median_pair_error_deg: float | None
    position_error_mean: float | None
    position_error_median: float | None
    position_error_max: float | None
    extent: float
    position_error_percent: float | None

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return dataclasses.asdict(self)


def find_model(folder: Path) -> Path:
    """The model in a folder, see `corrsfm.colmap.models.find_model`; of a workspace the largest one.

    Raises
    ------
    InputError
        If there is none.
    WorkspaceError
        If the models of a workspace are older than what it now holds.
    """
    from corrsfm.colmap import models

    if (folder / "workspace.json").exists() and not models.is_model(folder):
        Workspace(folder).require("models")
    return models.find_model(folder)


def read_poses(folder: Path) -> dict[str, Pose]:
    """Camera poses by photo name.

    Parameters
    ----------
    folder : Path
        A COLMAP model, binary or text, a workspace or another folder that `find_model` finds one in, or a
        folder of camera files: ``PHOTO.json``, the photo's name with its suffix, each an object with
        ``rotation`` (3 × 3, rows) and ``translation`` (3) of ``cam_from_world``.

    Returns
    -------
    dict
        Name to rotation (3, 3) and translation (3,) of ``cam_from_world``, sorted by name.

    Raises
    ------
    InputError
        If the folder holds neither, or a file is damaged.
    """
    from corrsfm.colmap.models import find_model, poses_of, read_model

    try:
        model = find_model(folder)
    except InputError:
        if (folder / "workspace.json").exists():
            raise
    else:
        return poses_of(read_model(model))
    files = sorted(folder.rglob("*.json")) if folder.is_dir() else []
    if not files:
        raise InputError(
            f"{folder}: no ground truth found; expected a COLMAP model (images.bin or images.txt) or camera "
            "files PHOTO.json with 'rotation' and 'translation'"
        )
    return {path.relative_to(folder).as_posix().removesuffix(".json"): _read_camera(path) for path in files}


def read_truth(folder: Path) -> dict[str, Pose]:
    """Known cameras, see `read_poses`.

    Raises
    ------
    InputError
        If they cannot be read, or are fewer than two.
    """
    truth = read_poses(folder)
    if len(truth) < 2:
        raise InputError(f"{folder}: only {len(truth)} known cameras; at least 2 are needed to compare poses")
    return truth


def require_common_names(
    names: Collection[str], source: Path, truth: Collection[str], ground_truth: Path
) -> None:
    """Check that a scene and its known cameras are about the same photos.

    Parameters
    ----------
    names : collection of str
        Photos of the scene.
    source : Path
        Where they are, for the message.
    truth : collection of str
        Photos with known cameras.
    ground_truth : Path
        Where these are.

    Raises
    ------
    InputError
        If they have no name in common.
    """
    if set(names).isdisjoint(truth):
        raise InputError(
            f"{source} and {ground_truth} share no photo name (such as '{next(iter(names), 'none')}' and "
            f"'{next(iter(truth))}'); names must be paths relative to the same image folder"
        )


def _read_camera(path: Path) -> Pose:
    try:
        values = read_json(path)
        rotation = np.array(values["rotation"], np.float64).reshape(3, 3)
        translation = np.array(values["translation"], np.float64).reshape(3)
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputError(
            f"{path}: not a camera file ({lack_or_text(error)}); expected 'rotation' (3 × 3) and "
            "'translation' (3) of cam_from_world"
        ) from error
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
        raise InputError(f"{path}: 'rotation' is not a rotation matrix; expected cam_from_world, rows first")
    # Squares of larger numbers, whatever their unit, are infinite.
    if not (np.abs(translation) < 1e100).all():
        raise InputError(f"{path}: 'translation' is {translation}; expected three finite numbers")
    return rotation, translation


def score_poses(poses: Mapping[str, Pose], truth: Mapping[str, Pose]) -> SceneScore:
    """Score camera poses against known ones; `SceneScore` says how photos count that only one of them has."""
    names = [name for name in sorted(truth) if name in poses]
    errors = relative_pose_errors(poses, truth)
    centres = np.array([camera_centre(truth[name]) for name in sorted(truth)])
    extent = extent_of(centres)
    finite = errors[np.isfinite(errors)]
    distances = None
    # Where all stand in one place, any model shrunk to a point would fit.
    if len(names) >= 3 and extent:
        try:
            distances = position_errors(
                [camera_centre(poses[name]) for name in names], [camera_centre(truth[name]) for name in names]
            )
        except ValueError:
            # Centres on one line leave the alignment open; relative poses are judged all the same.
            distances = None
    mean = None if distances is None else float(distances.mean())
    return SceneScore(
        num_photos=len(truth),
        num_registered=len(names),
        auc={
            f"{threshold:g}": value
            for threshold, value in zip(
                SCENE_THRESHOLDS_DEG, pose_auc(errors, SCENE_THRESHOLDS_DEG), strict=True
            )
        },
        median_pair_error_deg=float(np.median(finite)) if len(finite) else None,
        position_error_mean=mean,
        position_error_median=None if distances is None else float(np.median(distances)),
        position_error_max=None if distances is None else float(distances.max()),
        extent=extent,
        position_error_percent=100.0 * mean / extent if mean is not None and extent > 0 else None,
    )


def evaluate_scene(model: Path, ground_truth: Path) -> SceneScore:
    """Measure a reconstruction against known cameras.

    Parameters
    ----------
    model : Path
        A COLMAP model or a workspace; of a workspace the largest model counts.
    ground_truth : Path
        See `read_poses`.

    Raises
    ------
    InputError
        If one cannot be read, they share no photo, or fewer than two cameras are known.
    """
    truth = read_truth(ground_truth)
    poses = read_poses(find_model(model))
    require_common_names(poses, model, truth, ground_truth)
    return score_poses(poses, truth)
