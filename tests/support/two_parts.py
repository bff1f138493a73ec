"""A scene whose photos fall into two models, with exact geometry: parts that belong together, or do not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.descriptors import unit_rows
from corrsfm.reconstruction.scene_evidence import SceneEvidence
from corrsfm.types import Features, Pair

WIDTH, HEIGHT, FOCAL_PX = 1000, 800, 900.0


@dataclass(frozen=True, kw_only=True)
class TwoParts:
    """Two models in frames of their own, and everything they were made from."""

    models: tuple[pycolmap.Reconstruction, pycolmap.Reconstruction]
    truth: pycolmap.Reconstruction
    database: Path
    evidence: SceneEvidence


def _photo_pose(angle_deg: float, distance: float = 6.0) -> pycolmap.Rigid3d:
    angle = np.radians(angle_deg)
    turn = np.array([[np.cos(angle), 0, -np.sin(angle)], [0.0, 1.0, 0.0], [np.sin(angle), 0, np.cos(angle)]])
    return pycolmap.Rigid3d(np.column_stack([turn, [0.0, 0.0, distance]]))


def make_two_parts(
    path: Path,
    *,
    angles_deg: tuple[Sequence[float], Sequence[float]],
    num_common_points: int,
    num_own_points: int = 150,
    num_cross_matches: int = 10,
    noise_px: float = 0.5,
    num_false_matches: int = 0,
    unit_descriptors: bool = False,
) -> TwoParts:
    """Photos around a centre, in two groups that no verified pair connects.

    Both groups see the common points, and each its own points besides. Where photos of both groups stand side
    by side, that makes two places that hold things of the same look.

    Parameters
    ----------
    path : Path
        Of the database.
    angles_deg : two sequences of float
        Where the photos of each group stand on the circle.
    num_cross_matches : int
        True matches kept between a photo of either group, too few to be verified.
    num_false_matches : int
        False ones besides.
    unit_descriptors : bool
        Descriptors are unit vectors, as those of networks, not bytes.
    """
    generator = np.random.default_rng(5)
    points = generator.uniform(-1.0, 1.0, (num_common_points + 2 * num_own_points, 3))
    points[num_common_points:] *= 1.6
    prints = generator.integers(20, 236, (len(points), 128))
    seen = [np.r_[:num_common_points, num_common_points : num_common_points + num_own_points]]
    seen.append(np.r_[:num_common_points, num_common_points + num_own_points : len(points)])
    camera = pycolmap.Camera(
        camera_id=1, model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT,
        params=[FOCAL_PX, WIDTH / 2, HEIGHT / 2], has_prior_focal_length=True,
    )  # fmt: skip
    truth = pycolmap.Reconstruction()
    truth.add_camera_with_trivial_rig(camera)
    features: dict[str, Features] = {}
    point_at: dict[str, NDArray[np.intp]] = {}
    group_of: dict[str, int] = {}
    for group, angles in enumerate(angles_deg):
        for number, angle in enumerate(angles):
            name = f"{'ab'[group]}{number}.jpg"
            pose = _photo_pose(angle)
            projected = camera.img_from_cam(pose * points[seen[group]])
            inside = (projected > 0).all(axis=1) & (projected < [WIDTH, HEIGHT]).all(axis=1)
            order = generator.permutation(np.flatnonzero(inside))
            pixels = projected[order] + generator.normal(0, noise_px, (len(order), 2))
            point_at[name], group_of[name] = seen[group][order], group
            looks = prints[point_at[name]] + generator.integers(-9, 10, (len(order), 128))
            ones = np.ones(len(order), np.float32)
            features[name] = Features(
                keypoints=pixels.astype(np.float32), scales=ones, orientations=0 * ones, scores=ones,
                descriptors=unit_rows(looks - 128) if unit_descriptors else looks.astype(np.uint8),
                image_size=(WIDTH, HEIGHT),
            )  # fmt: skip
            image = pycolmap.Image(name=name, keypoints=pixels, camera_id=1, image_id=len(features))
            truth.add_image_with_trivial_frame(image, pose)
    verified = _write(
        path, camera, features, point_at, group_of, num_cross_matches, num_false_matches, generator
    )
    models = tuple(_part(truth, group, points, point_at, group_of) for group in (0, 1))
    second = pycolmap.Sim3d(0.4, pycolmap.Rotation3d(_photo_pose(70.0).rotation.matrix()), [3.0, -1.0, 2.0])
    models[1].transform(second)
    return TwoParts(
        models=(models[0], models[1]),
        truth=truth,
        database=path,
        evidence=SceneEvidence(sorted(features), verified, features.__getitem__),
    )


def _write(
    path: Path,
    camera: pycolmap.Camera,
    features: dict[str, Features],
    point_at: dict[str, NDArray[np.intp]],
    group_of: dict[str, int],
    num_cross: int,
    num_false: int,
    generator: np.random.Generator,
) -> dict[Pair, NDArray[np.int32]]:
    """The database: verified pairs within the groups, a few unverified matches between them."""
    verified: dict[Pair, NDArray[np.int32]] = {}
    with pycolmap.Database.open(path) as database:
        rig = pycolmap.Rig()
        database.write_camera(camera, use_camera_id=True)
        rig.add_ref_sensor(camera.sensor_id)
        rig.rig_id = 1
        database.write_rig(rig, use_rig_id=True)
        ids = {}
        for name, own in features.items():
            image = pycolmap.Image(name=name, camera_id=1)
            image.image_id = ids[name] = database.write_image(image)
            frame = pycolmap.Frame()
            frame.rig_id = 1
            frame.add_data_id(image.data_id)
            database.write_frame(frame)
            database.write_keypoints(image.image_id, own.keypoints)
        names = sorted(features)
        for i, name0 in enumerate(names):
            for name1 in names[i + 1 :]:
                common, index0, index1 = np.intersect1d(point_at[name0], point_at[name1], return_indices=True)
                matches = np.column_stack([index0, index1]).astype(np.uint32)
                inside = group_of[name0] == group_of[name1]
                if not inside:
                    matches = matches[generator.permutation(len(matches))[:num_cross]]
                    false = [
                        generator.permutation(len(features[name]))[:num_false] for name in (name0, name1)
                    ]
                    matches = np.concatenate([matches, np.column_stack(false).astype(np.uint32)])
                database.write_matches(ids[name0], ids[name1], np.unique(matches, axis=0))
                if inside and len(common) >= 15:
                    geometry = pycolmap.TwoViewGeometry()
                    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                    geometry.inlier_matches = matches
                    database.write_two_view_geometry(ids[name0], ids[name1], geometry)
                    verified[name0, name1] = matches.astype(np.int32)
    return verified


def _part(
    truth: pycolmap.Reconstruction,
    group: int,
    points: NDArray[np.float64],
    point_at: dict[str, NDArray[np.intp]],
    group_of: dict[str, int],
) -> pycolmap.Reconstruction:
    """The model of one group, with the points that two of its photos see."""
    model = pycolmap.Reconstruction(truth)
    tracks: dict[int, list[tuple[int, int]]] = {}
    for image in list(model.images.values()):
        if group_of[image.name] != group:
            model.deregister_frame(image.frame_id)
            continue
        for keypoint, point in enumerate(point_at[image.name]):
            tracks.setdefault(int(point), []).append((image.image_id, keypoint))
    for point, seen in sorted(tracks.items()):
        if len(seen) > 1:
            track = pycolmap.Track()
            for image_id, keypoint in seen:
                track.add_element(pycolmap.TrackElement(image_id, keypoint))
            model.add_point3D(points[point], track, np.zeros(3, np.uint8))
    return model
