"""A ring of photos around an object whose two sides are partly equal, mapped right, or folded in two."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.types import Pair

_DISTANCE = 5.0
_VISIBLE_DEG = 60.0
_SIZE = 1000


class Ring:
    """Photos ``00`` … equally spaced around a drum of radius 1; texture t sits at ``angle_deg[t]``, in front.

    The back has the same textures, 180 degrees further, where ``is_equal(angle_deg, height)`` holds, and
    textures of its own elsewhere.

    Attributes
    ----------
    names : list of str
    verified : dict of Pair to (K, 2) int32
        The equal textures of the two sides are confused, as feature matching would do.
    """

    def __init__(
        self,
        num_photos: int,
        is_equal: Callable[[NDArray, NDArray], NDArray[np.bool_]],
        num_textures: int = 600,
        seed: int = 0,
    ) -> None:
        rng = np.random.default_rng(seed)
        angle, height = rng.uniform(0, 180, num_textures), rng.uniform(-1, 1, num_textures)
        texture = np.arange(num_textures)
        behind = np.where(is_equal(angle, height), texture, texture + num_textures)
        self.names = [f"{i:02d}" for i in range(num_photos)]
        self.photo_deg = np.arange(num_photos) * 360.0 / num_photos
        self._angle = np.concatenate([angle, angle + 180])
        self._height = np.tile(height, 2)
        self._texture = np.concatenate([texture, behind])
        off = (self._angle - self.photo_deg[:, None] + 180) % 360 - 180
        # Keypoint k of a photo shows the k-th of the patches that face it.
        self._seen = [np.flatnonzero(np.abs(row) < _VISIBLE_DEG) for row in off]
        self._off = [row[seen] for row, seen in zip(off, self._seen, strict=True)]
        self.verified = self._match()

    def is_behind(self, name: str) -> bool:
        """Whether a photo shows more of the back than of the front."""
        return bool(self.photo_deg[self.names.index(name)] >= 180)

    def _match(self) -> dict[Pair, NDArray[np.int32]]:
        verified = {}
        for i, seen0 in enumerate(self._seen):
            for j in range(i + 1, len(self._seen)):
                seen1 = self._seen[j]
                _, rows0, rows1 = np.intersect1d(
                    self._texture[seen0], self._texture[seen1], return_indices=True
                )
                true = seen0[rows0] == seen1[rows1]
                # One pose explains either the true matches or the confused ones.
                chosen = true if 2 * true.sum() >= len(true) else ~true
                if chosen.sum() >= 15:
                    verified[self.names[i], self.names[j]] = np.column_stack(
                        [rows0[chosen], rows1[chosen]]
                    ).astype(np.int32)
        return verified

    def model(self, *, folded: bool) -> pycolmap.Reconstruction:
        """The ring as it is, or with the photos of the back on those of the front."""
        model = pycolmap.Reconstruction()
        camera = pycolmap.Camera(
            camera_id=1, model="PINHOLE", width=_SIZE, height=_SIZE, params=[1500.0, 1500.0, 500.0, 500.0]
        )
        model.add_camera_with_trivial_rig(camera)
        tracks: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for i, (seen, off) in enumerate(zip(self._seen, self._off, strict=True)):
            azimuth = self.photo_deg[i] - (180.0 if folded and self.photo_deg[i] >= 180 else 0.0)
            cam_from_world = _pose(azimuth)
            patches = _on_drum(azimuth + off, self._height[seen])
            pixels = camera.img_from_cam(patches @ cam_from_world[:, :3].T + cam_from_world[:, 3])
            image = pycolmap.Image(name=self.names[i], camera_id=1, image_id=i + 1, keypoints=pixels)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(cam_from_world))
            for row, (patch, angle) in enumerate(zip(seen, azimuth + off, strict=True)):
                tracks.setdefault((int(self._texture[patch]), round(angle * 1e6) % 360_000_000), []).append(
                    (i + 1, row)
                )
        for (texture, angle), elements in tracks.items():
            if len(elements) < 2:
                continue
            height = self._height[np.flatnonzero(self._texture == texture)[0]]
            track = pycolmap.Track([pycolmap.TrackElement(*one) for one in elements])
            model.add_point3D(_on_drum(np.array([angle / 1e6]), np.array([height]))[0], track)
        return model


def _on_drum(angle_deg: NDArray, height: NDArray) -> NDArray[np.float64]:
    angle = np.radians(angle_deg)
    return np.column_stack([np.sin(angle), -height, np.cos(angle)])


def _pose(azimuth_deg: float) -> NDArray[np.float64]:
    """(3, 4) ``cam_from_world`` of a camera on the ring that looks at its centre, y down."""
    sine, cosine = np.sin(np.radians(azimuth_deg)), np.cos(np.radians(azimuth_deg))
    centre = _DISTANCE * np.array([sine, 0.0, cosine])
    rotation = np.array([[-cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, -cosine]])
    return np.column_stack([rotation, -rotation @ centre])
