"""Frozen records that stages exchange, and the conventions they follow.

Pixels
    COLMAP's convention everywhere in memory: the centre of the first pixel is (0.5, 0.5), x to the right,
    y down. HDF5 files follow hloc and put it at (0, 0); `corrsfm.workspace.hloc` converts, nothing else does.
Normalised coordinates
    ``(x, y)`` such that ``(x, y, 1)`` is the viewing ray in the camera frame (x right, y down, z forward).
Images of a pair
    are ``0`` and ``1``; transforms are named ``cam1_from_cam0``; an essential matrix fulfils
    ``x1ᵀ E x0 = 0``.
Names
    An image's name is its posix path relative to the image folder; nothing else is used as a key.

Shapes and dtypes are checked once, here, at construction; a mismatch raises `ValueError` because it is a
programming error, not a user's.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from corrsfm.camera import Camera
from corrsfm.errors import InputError

__all__ = [
    "Camera",
    "Correspondences",
    "Features",
    "ImageRecord",
    "Matches",
    "ModelSummary",
    "Pair",
    "PairList",
    "PairStatistics",
    "PruneResult",
    "TwoViewModel",
    "VerifiedPair",
    "check_array",
    "check_indices",
]

Pair = tuple[str, str]
"""Two image names; the order is the orientation of everything stored for the pair."""


def check_array(name: str, array: NDArray, shape: tuple[int | None, ...], dtype: type) -> None:
    """Raise `ValueError` unless an array has this shape, of which None fits anything, and this dtype."""
    if array.dtype != np.dtype(dtype):
        raise ValueError(f"{name}: expected dtype {np.dtype(dtype)}, got {array.dtype}")
    if array.ndim != len(shape) or any(
        s is not None and s != a for s, a in zip(shape, array.shape, strict=True)
    ):
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}")


def check_indices(pair: Pair, indices: NDArray[np.int32], num_keypoints: tuple[int, int]) -> None:
    """Refuse matches of keypoints that the photos do not have.

    Parameters
    ----------
    pair : Pair
    indices : (N, 2) int32
    num_keypoints : tuple of int
        Of the two photos.

    Raises
    ------
    InputError
        Naming the pair, the keypoint and the photo.
    """
    for name, column, num in zip(pair, indices.T, num_keypoints, strict=True):
        if len(column) and (column.min() < 0 or column.max() >= num):
            wrong = int(column.min() if column.min() < 0 else column.max())
            raise InputError(
                f"pair {' – '.join(pair)}: a match uses keypoint {wrong} of {name}, which has {num}; the "
                "matches belong to other features, match and prune again with --overwrite"
            )


@dataclass(frozen=True, kw_only=True)
class ImageRecord:
    """One photo of a scene.

    Attributes
    ----------
    name : str
        Posix path relative to the image folder.
    camera_id : int
        Index into the scene's cameras, from 0.
    sha256 : str
        Hash of the file's bytes; part of every fingerprint that depends on the photo.
    mask : str or None
        Path of the mask relative to the mask folder, if there is one. Zero means "ignore".
    mask_sha256 : str or None
        Hash of the mask's bytes.
    gps : tuple of float or None
        Latitude and longitude in degrees, altitude in metres (WGS84), from EXIF.
    """

    name: str
    camera_id: int
    sha256: str
    mask: str | None = None
    mask_sha256: str | None = None
    gps: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        # A list may come from anybody, and what is exported is written under these names.
        for name in (self.name, self.mask):
            if name is not None and (not name or name.startswith("/") or ".." in name.split("/")):
                raise InputError(f"'{name}' does not name a file below a folder")


@dataclass(frozen=True, kw_only=True)
class Features:
    """Keypoints and descriptors of one image; N may be 0.

    Attributes
    ----------
    keypoints : (N, 2) float32
        Pixels of the original image, COLMAP convention.
    scales : (N,) float32 or None
        Keypoint sizes (standard deviation σ of the SIFT scale) in pixels; None if the features have none.
    orientations : (N,) float32 or None
        Keypoint orientations in radians, in [-π, π), from the x axis towards the y axis; None likewise.
    scores : (N,) float32
        What the extractor ranks by (response × scale, or scale); larger is stronger. NaN if nobody said.
    descriptors : (N, D) uint8 or float32
        SIFT's, quantised the way COLMAP does (unit vector × 512, clipped to 255), or unit vectors.
    image_size : tuple of int
        Width and height in pixels.
    """

    keypoints: NDArray[np.float32]
    scales: NDArray[np.float32] | None
    orientations: NDArray[np.float32] | None
    scores: NDArray[np.float32]
    descriptors: NDArray[np.uint8] | NDArray[np.float32]
    image_size: tuple[int, int]

    def __post_init__(self) -> None:
        num = len(self.keypoints)
        check_array("keypoints", self.keypoints, (num, 2), np.float32)
        if self.scales is not None:
            check_array("scales", self.scales, (num,), np.float32)
        if self.orientations is not None:
            check_array("orientations", self.orientations, (num,), np.float32)
        check_array("scores", self.scores, (num,), np.float32)
        floats = self.descriptors.dtype == np.float32
        check_array("descriptors", self.descriptors, (num, None), np.float32 if floats else np.uint8)

    def __len__(self) -> int:
        return len(self.keypoints)


@dataclass(frozen=True, kw_only=True)
class Matches:
    """Putative matches of one pair, before any filter; M may be 0.

    One match for every keypoint of image 0 that has a nearest neighbour in image 1, ordered by the index in
    image 0, so that every later filter can be tried without matching again. A learned matcher, or another
    tool, leaves fewer.

    Attributes
    ----------
    indices : (M, 2) int32
        Keypoint indices in image 0 and image 1; column 0 strictly increases.
    ratios : (M,) float32
        Distance to the nearest over distance to the second nearest descriptor, in [0, 1]; NaN where
        ``scores`` stand in their place.
    mutual : (M,) bool
        True where the match is also the nearest neighbour from image 1 to image 0.
    scores : (M,) float32 or None
        Confidence of a matcher that compares more than descriptors, or of another tool; larger is surer.
        None for nearest neighbours.
    """

    indices: NDArray[np.int32]
    ratios: NDArray[np.float32]
    mutual: NDArray[np.bool_]
    scores: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        num = len(self.indices)
        check_array("indices", self.indices, (num, 2), np.int32)
        check_array("ratios", self.ratios, (num,), np.float32)
        check_array("mutual", self.mutual, (num,), np.bool_)
        if self.scores is not None:
            check_array("scores", self.scores, (num,), np.float32)

    def __len__(self) -> int:
        return len(self.indices)


@dataclass(frozen=True, kw_only=True)
class PairList:
    """The pairs to match and where each came from.

    Attributes
    ----------
    pairs : tuple of Pair
        Without repetition in either orientation, sorted.
    origins : tuple of tuple of str
        For each pair the sorted names of the strategies that proposed it.
    """

    pairs: tuple[Pair, ...]
    origins: tuple[tuple[str, ...], ...]

    def __post_init__(self) -> None:
        if len(self.pairs) != len(self.origins):
            raise ValueError(f"{len(self.pairs)} pairs but {len(self.origins)} origins")

    def __len__(self) -> int:
        return len(self.pairs)


@dataclass(frozen=True, kw_only=True)
class Correspondences:
    """Everything a prune method may know about the putative matches of one pair; M may be 0.

    Attributes
    ----------
    points0, points1 : (M, 2) float32
        Matched keypoints in pixels, COLMAP convention.
    normalised : (M, 4) float32
        ``x0 y0 x1 y1`` normalised by the intrinsics known before reconstruction.
    ratios : (M,) float32
        Ratio of the two nearest descriptor distances; NaN for matches that have ``scores`` instead.
    mutual : (M,) bool
        Mutual nearest neighbours.
    log_scale_ratios : (M,) float32
        Natural logarithm of scale in image 1 over scale in image 0; NaN for features without scale.
    rotations : (M,) float32
        Orientation in image 1 minus orientation in image 0, radians, wrapped to [-π, π); NaN likewise.
    camera0, camera1 : Camera
        The cameras that ``normalised`` was made with.
    name : str
        ``"name0 – name1"`` for messages.
    mutual_known : bool
        False if ``mutual`` only stands in for what nobody said.
    scores : (M,) float32 or None
        See `Matches`.
    shapes_known : bool
        False if the features have no scale and orientation.
    """

    points0: NDArray[np.float32]
    points1: NDArray[np.float32]
    normalised: NDArray[np.float32]
    ratios: NDArray[np.float32]
    mutual: NDArray[np.bool_]
    log_scale_ratios: NDArray[np.float32]
    rotations: NDArray[np.float32]
    camera0: Camera
    camera1: Camera
    name: str = ""
    mutual_known: bool = True
    scores: NDArray[np.float32] | None = None
    shapes_known: bool = True

    def __post_init__(self) -> None:
        num = len(self.points0)
        check_array("points0", self.points0, (num, 2), np.float32)
        check_array("points1", self.points1, (num, 2), np.float32)
        check_array("normalised", self.normalised, (num, 4), np.float32)
        check_array("ratios", self.ratios, (num,), np.float32)
        check_array("mutual", self.mutual, (num,), np.bool_)
        check_array("log_scale_ratios", self.log_scale_ratios, (num,), np.float32)
        check_array("rotations", self.rotations, (num,), np.float32)
        if self.scores is not None:
            check_array("scores", self.scores, (num,), np.float32)

    def __len__(self) -> int:
        return len(self.points0)


@dataclass(frozen=True, kw_only=True)
class TwoViewModel:
    """A two-view geometry.

    Attributes
    ----------
    kind : {"essential", "fundamental", "homography"}
        What the matrix is; essential matrices act on normalised coordinates, the others on pixels.
    matrix : (3, 3) float64
        Maps image 0 to image 1.
    """

    kind: Literal["essential", "fundamental", "homography"]
    matrix: NDArray[np.float64]

    def __post_init__(self) -> None:
        check_array("matrix", self.matrix, (3, 3), np.float64)


@dataclass(frozen=True, kw_only=True)
class PruneResult:
    """What a prune method says about the putative matches of one pair.

    Attributes
    ----------
    scores : (M,) float32
        Confidence that a match is an inlier, in [0, 1], in the order of the putative matches.
    inlier_mask : (M,) bool
        The matches to keep. A pair pruned to nothing has no True entry and stays recorded.
    model : TwoViewModel or None
        The geometry the method settled on, if it estimates one.
    residuals : (M,) float32
        Squared symmetric epipolar distances to the model in normalised coordinates; NaN without a model.
    decided_by : str
        Which branch of a composite method decided (for `cascade`), else the method's name.
    """

    scores: NDArray[np.float32]
    inlier_mask: NDArray[np.bool_]
    model: TwoViewModel | None = None
    residuals: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    decided_by: str = ""

    def __post_init__(self) -> None:
        num = len(self.scores)
        check_array("scores", self.scores, (num,), np.float32)
        check_array("inlier_mask", self.inlier_mask, (num,), np.bool_)
        if len(self.residuals) == 0:
            object.__setattr__(self, "residuals", np.full(num, np.nan, np.float32))
        check_array("residuals", self.residuals, (num,), np.float32)

    def __len__(self) -> int:
        return len(self.scores)


@dataclass(frozen=True, kw_only=True, slots=True)
class VerifiedPair:
    """What a database says about a pair.

    Attributes
    ----------
    name0, name1 : str
        ``name0 < name1``.
    num_matches : int
        Matches that were verified; 0 for a pair pruned to nothing.
    num_inliers : int
        Matches that agree with the two-view geometry.
    """

    name0: str
    name1: str
    num_matches: int
    num_inliers: int


@dataclass(frozen=True, kw_only=True, slots=True)
class PairStatistics:
    """How many matches of a pair survived each step.

    Attributes
    ----------
    name0, name1 : str
    num_putative : int
        Matches of the descriptors.
    num_kept : int
        Matches that passed pruning.
    num_verified : int
        Kept matches that agree with the verified two-view geometry.
    """

    name0: str
    name1: str
    num_putative: int
    num_kept: int
    num_verified: int


@dataclass(frozen=True, kw_only=True)
class ModelSummary:
    """A reconstructed model in numbers.

    Attributes
    ----------
    image_names : tuple of str
        Registered photos, sorted.
    num_points, num_observations : int
    mean_track_length : float
        Observations per point.
    mean_observations_per_image : float
    mean_error_px, median_error_px, p95_error_px : float
        Reprojection error over all observations, in pixels; NaN for a model without points.
    """

    image_names: tuple[str, ...]
    num_points: int
    num_observations: int
    mean_track_length: float
    mean_observations_per_image: float
    mean_error_px: float
    median_error_px: float
    p95_error_px: float

    @property
    def num_images(self) -> int:
        """Number of registered photos."""
        return len(self.image_names)
