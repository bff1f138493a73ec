"""Which points of two models may be the same, and how the models then lie to one another."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.colmap.cameras import camera_from_pycolmap, normalise_points
from corrsfm.colmap.log import colmap_log
from corrsfm.colmap.sqlite import database_errors
from corrsfm.reconstruction.predicted import nearest_descriptors
from corrsfm.reconstruction.resection import Landmarks
from corrsfm.reconstruction.similarity import Observed, Similarity, find_similarity
from corrsfm.types import Features

__all__ = ["Candidates", "Placement", "candidates_of", "find_placements", "registered_images"]

# Comparing descriptors takes time by the square.
_MAX_POINTS = 20_000
_MAX_ERROR_SHARE, _LEAST_ERROR_PX = 0.01, 4.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidates:
    """Observations that may be of the same point, of two models a and b.

    Attributes
    ----------
    a, b : (M, 3) int64
        Image id, keypoint and point id; row i of both may be of one point.
    """

    a: NDArray[np.int64]
    b: NDArray[np.int64]

    def same_points(self, chosen: NDArray[np.bool_]) -> list[tuple[int, int]]:
        """Distinct pairs of point ids among chosen rows, each point once, those with most rows first."""
        pairs, counts = np.unique(
            np.column_stack([self.a[chosen, 2], self.b[chosen, 2]]), axis=0, return_counts=True
        )
        taken_a: set[int] = set()
        taken_b: set[int] = set()
        same = []
        for row in np.argsort(-counts, kind="stable"):
            point_a, point_b = (int(value) for value in pairs[row])
            if point_a not in taken_a and point_b not in taken_b:
                taken_a.add(point_a)
                taken_b.add(point_b)
                same.append((point_a, point_b))
        return same


@dataclass(frozen=True, kw_only=True, eq=False)
class Placement:
    """How two models may lie to one another.

    Attributes
    ----------
    a_from_b : Similarity
    same_points : list of (int, int)
        Distinct points of a and of b that agree with it and so would be the same.
    """

    a_from_b: Similarity
    same_points: list[tuple[int, int]]


def candidates_of(
    a: pycolmap.Reconstruction,
    b: pycolmap.Reconstruction,
    database: Path,
    load: Callable[[str], Features],
) -> Candidates:
    """What may be the same point in both: by photos that both hold, kept matches, and descriptors.

    Parameters
    ----------
    a, b : pycolmap.Reconstruction
    database : Path
        That they were mapped from; not changed.
    load : callable
        Photo → its features.

    Raises
    ------
    DatabaseError
        If the database cannot be read.
    """
    rows = [
        *_by_common_photos(a, b),
        *_by_kept_matches(a, b, database),
        *_by_looks(a, b, load),
    ]
    unique = np.unique(np.array(rows, np.int64).reshape(-1, 6), axis=0)
    return Candidates(a=unique[:, :3], b=unique[:, 3:])


def find_placements(
    a: pycolmap.Reconstruction, b: pycolmap.Reconstruction, candidates: Candidates, *, num: int, seed: int = 0
) -> Iterator[Placement]:
    """Similarities between two models that most of what may be the same point agrees with.

    Parameters
    ----------
    a, b : pycolmap.Reconstruction
    candidates : Candidates
        Of the two.
    num : int
        Placements at most. The second is what most of those say that disagree with the first, and so on.
    seed : int

    Yields
    ------
    Placement
        Found when it is asked for; not necessarily with many points.
    """
    longest = float(np.median([max(camera.width, camera.height) for camera in a.cameras.values()]))
    max_error_px = max(_LEAST_ERROR_PX, _MAX_ERROR_SHARE * longest)
    for _ in range(num):
        side_a, side_b = (_observed(model, rows) for model, rows in ((a, candidates.a), (b, candidates.b)))
        found = find_similarity(side_a, side_b, max_error_px=max_error_px, seed=seed)
        if found is None:
            return
        a_from_b, agreeing = found
        yield Placement(a_from_b=a_from_b, same_points=candidates.same_points(agreeing))
        candidates = Candidates(a=candidates.a[~agreeing], b=candidates.b[~agreeing])


def registered_images(model: pycolmap.Reconstruction) -> dict[str, pycolmap.Image]:
    """Photo → its image, of those with a pose."""
    return {image.name: image for image in model.images.values() if image.has_pose}


def _by_common_photos(a: pycolmap.Reconstruction, b: pycolmap.Reconstruction) -> list[tuple[int, ...]]:
    """Keypoints of photos in both models that see a point in both."""
    landmarks_a, landmarks_b = Landmarks(a), Landmarks(b)
    images_a, images_b = registered_images(a), registered_images(b)
    rows: list[tuple[int, ...]] = []
    for name in sorted(images_a.keys() & images_b.keys()):
        points_a, points_b = landmarks_a.of_keypoints(name), landmarks_b.of_keypoints(name)
        for k in np.flatnonzero((points_a >= 0) & (points_b >= 0)):
            image_a, image_b = images_a[name].image_id, images_b[name].image_id
            rows.append((image_a, int(k), int(points_a[k]), image_b, int(k), int(points_b[k])))
    return rows


def _by_kept_matches(
    a: pycolmap.Reconstruction, b: pycolmap.Reconstruction, database: Path
) -> list[tuple[int, ...]]:
    """Kept matches between a photo of either model, whether or not the pair was verified."""
    ids_a = {image.image_id: name for name, image in registered_images(a).items()}
    ids_b = {image.image_id: name for name, image in registered_images(b).items()}
    landmarks_a, landmarks_b = Landmarks(a), Landmarks(b)
    rows: list[tuple[int, ...]] = []
    with colmap_log(), database_errors(database), pycolmap.Database.open(database) as tables:
        for pair_id in sorted(tables.read_num_matches()[0]):
            id0, id1 = pycolmap.pair_id_to_image_pair(pair_id)
            for first, second, columns in ((id0, id1, (0, 1)), (id1, id0, (1, 0))):
                if first not in ids_a or second not in ids_b or first in ids_b or second in ids_a:
                    continue
                matches = np.asarray(tables.read_matches(id0, id1), np.int64)[:, columns]
                points_a = landmarks_a.of_keypoints(ids_a[first])[matches[:, 0]]
                points_b = landmarks_b.of_keypoints(ids_b[second])[matches[:, 1]]
                for row in np.flatnonzero((points_a >= 0) & (points_b >= 0)):
                    rows.append(
                        (
                            first,
                            int(matches[row, 0]),
                            int(points_a[row]),
                            second,
                            int(matches[row, 1]),
                            int(points_b[row]),
                        )
                    )
    return rows


def _by_looks(
    a: pycolmap.Reconstruction, b: pycolmap.Reconstruction, load: Callable[[str], Features]
) -> list[tuple[int, ...]]:
    """Points of either model whose descriptors are nearest to each other and clearly nearer than the next."""
    rows_a, descriptors_a = _described(a, load)
    rows_b, descriptors_b = _described(b, load)
    forward, backward = _nearest(descriptors_a, descriptors_b), _nearest(descriptors_b, descriptors_a)
    return [(*rows_a[i], *rows_b[j]) for i, j in sorted(forward.items()) if backward.get(j) == i]


def _nearest(a: NDArray, b: NDArray) -> dict[int, int]:
    """Row of a → its nearest row of b, where it passes the ratio test against the second."""
    if len(a) == 0 or len(b) < 2:
        return {}
    found = nearest_descriptors(a, b, num=2)
    return {int(row): int(index) for row, index in zip(found.keypoints, found.indices[:, 0], strict=True)}


def _described(
    model: pycolmap.Reconstruction, load: Callable[[str], Features]
) -> tuple[list[tuple[int, int, int]], NDArray]:
    """An observation (image id, keypoint, point id) of each point, long tracks first, and its descriptor."""
    ranked = sorted(model.points3D.items(), key=lambda item: (-item[1].track.length(), item[0]))
    rows = []
    for point_id, point in ranked[:_MAX_POINTS]:
        first = min(point.track.elements, key=lambda element: (element.image_id, element.point2D_idx))
        rows.append((int(first.image_id), int(first.point2D_idx), int(point_id)))
    by_image: dict[int, list[int]] = defaultdict(list)
    for number, row in enumerate(rows):
        by_image[row[0]].append(number)
    descriptors: NDArray = np.zeros((0, 128), np.uint8)
    for image_id, numbers in sorted(by_image.items()):
        own = load(model.images[image_id].name).descriptors
        if len(descriptors) == 0:
            # Bytes of SIFT, or floats of a network.
            descriptors = np.zeros((len(rows), own.shape[1]), own.dtype)
        descriptors[numbers] = own[[rows[number][1] for number in numbers]]
    return rows, descriptors


def _observed(model: pycolmap.Reconstruction, rows: NDArray[np.int64]) -> Observed:
    """The points of observations (M, 3) as in `Candidates`, each with the photo that sees it."""
    num = len(rows)
    rotations, translations = np.zeros((num, 3, 3)), np.zeros((num, 3))
    rays, focal_px = np.zeros((num, 2)), np.zeros(num)
    for image_id in np.unique(rows[:, 0]):
        image = model.images[int(image_id)]
        here = rows[:, 0] == image_id
        pose = image.cam_from_world()
        rotations[here], translations[here] = pose.rotation.matrix(), pose.translation
        pixels = np.array([image.points2D[int(k)].xy for k in rows[here, 1]])
        camera = model.cameras[image.camera_id]
        rays[here] = normalise_points(camera_from_pycolmap(camera), pixels)
        focal_px[here] = camera.mean_focal_length()
    points = np.array([model.points3D[int(i)].xyz for i in rows[:, 2]]).reshape(-1, 3)
    return Observed(
        points=points, rotations=rotations, translations=translations, rays=rays, focal_px=focal_px
    )
