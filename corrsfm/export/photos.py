"""The photos of a model for another tool: copied as they are, or undistorted to pinhole cameras."""

from __future__ import annotations

import logging
import shutil
import stat
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.colmap.log import colmap_log
from corrsfm.disk import room_for
from corrsfm.errors import InputError, first_few
from corrsfm.files import sha256_of
from corrsfm.images.photos import read_image, read_photo_info

__all__ = [
    "check_photos",
    "copy_photos",
    "crop_to_principal_point",
    "flat_names",
    "is_undistortable",
    "undistort",
]

logger = logging.getLogger("corrsfm")

_JPEG_QUALITY = 95
# More than any format takes of three channels, with what else may be in the file.
_BYTES_OF_PIXEL, _EXTRA_BYTES = 4, 1 << 17
_NUM_BORDER_SAMPLES = 33
_LARGEST_RETURN_ERROR_PX = 0.5


def check_photos(model: pycolmap.Reconstruction, images_dir: Path, hashes: Mapping[str, str]) -> None:
    """Refuse to begin if photos are gone, damaged or of another size; COLMAP would abort the process.

    Photos with another content and the same size, such as ones with corrected colours, are warned of.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    images_dir : Path
    hashes : mapping of str to str
        Photo → SHA-256 of the file that was reconstructed.

    Raises
    ------
    InputError
        Naming the photos; `ImageError` for one that cannot be read to the end.
    """
    images = sorted(model.images.values(), key=lambda image: image.name)
    missing = [image.name for image in images if not (images_dir / image.name).is_file()]
    if missing:
        raise InputError(
            f"{images_dir}: {len(missing)} photos of the model are not there: {first_few(missing)}; if the "
            "folder was moved, say where it is with --images FOLDER"
        )
    changed = []
    for image in images:
        path, camera = images_dir / image.name, model.cameras[image.camera_id]
        if sha256_of(path) == hashes.get(image.name):
            continue
        info = read_photo_info(path)
        if (info.width, info.height) != (camera.width, camera.height):
            raise InputError(
                f"{path}: has {info.width}×{info.height} pixels, but {camera.width}×{camera.height} when it "
                "was reconstructed; put the photo of that size back, or run the scene again with the new one"
            )
        read_image(path)
        changed.append(image.name)
    if changed:
        logger.warning(
            "changed since they were reconstructed: %s in %s; that is fine for other colours; if they show "
            "something else, put the earlier ones back or run the scene again",
            first_few(changed),
            images_dir,
        )


def copy_photos(names: Iterable[str], images_dir: Path, folder: Path) -> None:
    """Copy photos, not link them: tools resize in place."""
    for name in names:
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        _copy(images_dir / name, target)


def _copy(photo: Path, target: Path) -> None:
    shutil.copy2(photo, target)
    # The photos may be read-only; what is exported is the user's to change.
    target.chmod(target.stat().st_mode | stat.S_IWUSR)


def is_undistortable(camera: pycolmap.Camera) -> bool:
    """Whether a pinhole camera can show all that a camera sees.

    Every pixel of the border must have a ray in front of the camera that leads back to it; the rays of a
    fisheye beyond 180 degrees, or of distortion that folds over, do not.
    """
    steps = np.linspace(0.0, 1.0, _NUM_BORDER_SAMPLES)
    ends = np.ones_like(steps)
    unit = np.concatenate(
        [
            np.column_stack(side)
            for side in ((steps, 0 * ends), (steps, ends), (0 * ends, steps), (ends, steps))
        ]
    )
    pixels = unit * [camera.width, camera.height]
    rays = np.asarray(camera.cam_from_img(pixels))
    if not np.isfinite(rays).all():
        return False
    back = np.asarray(camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))])))
    return bool((np.linalg.norm(back - pixels, axis=1) < _LARGEST_RETURN_ERROR_PX).all())


def undistort(model: pycolmap.Reconstruction, images_dir: Path, folder: Path) -> pycolmap.Reconstruction:
    """Write undistorted photos to ``folder/images``.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        The photos are those of its images.
    images_dir : Path
    folder : Path
        Exists; nothing else is left there.

    Returns
    -------
    pycolmap.Reconstruction
        The model of the undistorted photos: PINHOLE cameras, the same poses and points, keypoints moved.

    Raises
    ------
    InputError
        If a camera cannot be undistorted or a photo cannot be read.
    """
    for camera in model.cameras.values():
        if not is_undistortable(camera):
            raise InputError(
                f"camera {camera.camera_id} ({camera.model_name}) cannot be undistorted: it sees more than a "
                "pinhole camera can show, or its distortion folds over; --for colmap keeps cameras as they "
                "are, and --for nerfstudio keeps fisheyes"
            )
    cameras = {number: _pinhole_of(camera) for number, camera in model.cameras.items()}
    for image in sorted(model.images.values(), key=lambda image: image.name):
        target = folder / "images" / image.name
        target.parent.mkdir(parents=True, exist_ok=True)
        _undistort_photo(images_dir / image.name, model.cameras[image.camera_id], target)
    pinhole = pycolmap.Reconstruction(model)
    for image in pinhole.images.values():
        before, after = model.cameras[image.camera_id], cameras[image.camera_id]
        if image.points2D and not before.is_undistorted():
            rays = np.asarray(before.cam_from_img(np.array([point.xy for point in image.points2D])))
            moved = np.asarray(after.img_from_cam(np.column_stack([rays, np.ones(len(rays))])))
            for point, xy in zip(image.points2D, moved, strict=True):
                # A keypoint where the distortion has no inverse stays where it is, as in COLMAP.
                if np.isfinite(xy).all():
                    point.xy = xy
    for number, camera in pinhole.cameras.items():
        camera.model = cameras[number].model
        camera.width, camera.height = cameras[number].width, cameras[number].height
        camera.params = cameras[number].params
    return pinhole


def _pinhole_of(camera: pycolmap.Camera) -> pycolmap.Camera:
    """The PINHOLE camera of undistorted photos."""
    if not camera.is_undistorted():
        return pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    pinhole = pycolmap.Camera(camera.todict())
    # Of whatever model: a distortion that is zero makes none of it PINHOLE, which is all that others read.
    focal_lengths = [camera.focal_length_x, camera.focal_length_y]
    pinhole.model = pycolmap.CameraModelId.PINHOLE
    pinhole.params = [*focal_lengths, camera.principal_point_x, camera.principal_point_y]
    return pinhole


def _undistort_photo(photo: Path, camera: pycolmap.Camera, target: Path) -> None:
    """Write one undistorted photo; one without distortion is copied."""
    if camera.is_undistorted():
        _copy(photo, target)
        return
    with colmap_log():
        whole = pycolmap.Bitmap.read(photo, as_rgb=True)
        if whole is None or (whole.width, whole.height) != (camera.width, camera.height):
            raise InputError(
                f"{photo}: COLMAP cannot read it, or it has another size; re-export it as JPEG or PNG, in "
                "the size that was reconstructed"
            )
        undistorted, _ = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), whole, camera)
        _write_photo(undistorted, target)


def _write_photo(photo: pycolmap.Bitmap, path: Path) -> None:
    """Write a photo in the format of its name."""
    photo.set_jpeg_quality(_JPEG_QUALITY)
    # On a full disk the JPEG library ends the process, and that of PNG says nothing.
    with room_for(path.parent, photo.width * photo.height * _BYTES_OF_PIXEL + _EXTRA_BYTES), colmap_log():
        is_written = photo.write(path, delinearize_colorspace=False)
    if not is_written:
        raise InputError(f"{path}: cannot be written in this format; re-export the photo as JPEG or PNG")


def crop_to_principal_point(model: pycolmap.Reconstruction, images_dir: Path) -> None:
    """Crop photos so that the principal point is in their middle, to a quarter of a pixel.

    gaussian-splatting takes it to be there, whatever the camera says.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        With PINHOLE cameras. They and the keypoints are changed in place; some of these may lie outside then.
    images_dir : Path
        The photos are replaced, where they are cropped.

    Raises
    ------
    InputError
        If a photo cannot be written.
    """
    for camera in model.cameras.values():
        fx, fy, *centre = camera.params
        size = np.array([camera.width, camera.height])
        # Columns and rows to cut: on the left and top if positive, else on the right and bottom.
        cut = np.rint(2 * np.array(centre) - size).astype(int)
        if not cut.any():
            continue
        start, end = np.maximum(cut, 0), size + np.minimum(cut, 0)
        for image in model.images.values():
            if image.camera_id == camera.camera_id:
                _crop_photo(images_dir / image.name, start, end)
                for point in image.points2D:
                    point.xy = point.xy - start
        camera.width, camera.height = (int(length) for length in end - start)
        camera.params = [fx, fy, *(centre - start)]


def _crop_photo(path: Path, start: NDArray[np.int64], end: NDArray[np.int64]) -> None:
    whole = pycolmap.Bitmap.read(path, as_rgb=True)
    if whole is None:
        raise InputError(f"{path}: cannot be cropped; re-export the photo as JPEG or PNG")
    pixels = whole.to_array()[start[1] : end[1], start[0] : end[0]]
    _write_photo(pycolmap.Bitmap.from_array(np.ascontiguousarray(pixels)), path)


def flat_names(names: Iterable[str]) -> dict[str, str]:
    """Names without folders, for tools that look photos up by their last part.

    Raises
    ------
    InputError
        If two would become one.
    """
    flat = {name: name.replace("/", "_") for name in names}
    num = Counter(flat.values())
    clash = [name for name in flat if num[flat[name]] > 1]
    if clash:
        raise InputError(f"without their folders these photos have one name: {first_few(clash)}; rename one")
    return flat
