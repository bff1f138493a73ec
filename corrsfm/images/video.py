"""Frames of a video worth reconstructing: where the camera moves, the sharpest of each stretch.

A video is decoded twice, since the frame counts and times that containers announce are often wrong: once to
measure every frame on a small copy, once to keep those that are chosen.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from corrsfm.errors import ConfigError, InputError

__all__ = ["Measured", "choose_frames", "measure_video", "read_frames", "seconds_of"]

# Longest sides of the copies on which sharpness and motion are measured.
_SHARPNESS_PX = 640
_MOTION_PX = 320
_MAX_CORNERS = 150
_MIN_CORNERS = 10
_MOVING_SHARE = 0.8
# Motion in widths of the frame. Below the first the camera counts as standing: hands tremble.
_STANDING = 0.01
_NEW_REFERENCE = 0.04
_SHORTEST_STRETCH_S = 1e-3
# Without options: a frame for every fortieth of the width that the picture moves, but not too many.
_SPACING = 0.025
_MOST_FRAMES = 300
# A stretch that is blurred all through is left out: its best frame has this little of the detail (as energy)
# of the frames around. A Gaussian blur of 1.5 px at the measured size leaves less than a tenth.
_BLURRED_SHARE = 0.2
_FRAMES_AROUND = 5
# How lists begin that FFmpeg would follow to other files and addresses.
_PLAYLISTS = (b"ffconcat", b"#EXTM3U", b"v=0")


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Every frame of a video.

    Attributes
    ----------
    width, height : int
        Pixels, after the rotation that the container asks for.
    times_s : (N,) float64
        Rising.
    sharpness : (N,) float64
        Energy of fine detail; comparable between frames that show the same.
    path : (N,) float64
        How far the picture has moved since the first frame, in widths of the frame; rising.
    num_announced : int
        Frames that the container announces; 0 if it does not.
    """

    width: int
    height: int
    times_s: NDArray[np.float64]
    sharpness: NDArray[np.float64]
    path: NDArray[np.float64]
    num_announced: int


def seconds_of(text: str) -> float:
    """The seconds of a duration such as ``0.5s``, ``500ms`` or ``0.5``.

    Raises
    ------
    ConfigError
        If it is none.
    """
    number, factor = text.strip().lower(), 1.0
    for unit, value in (("ms", 1e-3), ("s", 1.0)):
        if number.endswith(unit):
            number, factor = number[: -len(unit)], value
            break
    try:
        seconds = float(number) * factor
    except ValueError:
        seconds = float("nan")
    if not (np.isfinite(seconds) and seconds >= _SHORTEST_STRETCH_S):
        raise ConfigError(f"every is '{text}', expected a time from 1ms on, such as 0.5s or 500ms")
    return seconds


def _open(path: Path) -> cv2.VideoCapture:
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a video")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: the file is empty; copy the video again")
    with open(path, "rb") as file:
        if file.read(len(max(_PLAYLISTS, key=len))).startswith(_PLAYLISTS):
            raise InputError(f"{path}: is a list of other files, expected a video")
    # FFmpeg and OpenCV report what is wrong with a video by themselves, line upon line.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    cv2.utils.logging.setLogLevel(level)
    if not capture.isOpened():
        raise InputError(
            f"{path}: cannot be opened as a video; it is damaged, cut off (which loses the index of a "
            "recording) or no video; copy it again, and check that a player plays it"
        )
    # Phones record lying on their side and say so; this is OpenCV's default, but not of every version.
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
    return capture


def measure_video(
    path: Path, track: Callable[[Iterator, int], Iterable] = lambda frames, total: frames
) -> Measured:
    """Measure every frame of a video.

    Parameters
    ----------
    path : Path
    track : callable, optional
        Frames and the number that the container announces → the same frames, with progress shown.

    Raises
    ------
    InputError
        If it is missing, no video, or holds no frame that can be decoded.
    """
    capture = _open(path)
    rate = capture.get(cv2.CAP_PROP_FPS)
    rate = rate if np.isfinite(rate) and rate > 0 else 30.0
    num_announced = int(max(0.0, capture.get(cv2.CAP_PROP_FRAME_COUNT)))
    times: list[float] = []
    sharpness: list[float] = []
    path_length: list[float] = []
    motion = _Motion()
    size = (0, 0)
    for time_s, frame in track(_decoded(capture), num_announced):
        # Some containers have no times, or times that stand still.
        times.append(time_s if not times or time_s > times[-1] else times[-1] + 1.0 / rate)
        size = (frame.shape[1], frame.shape[0])
        grey = _reduced(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), _SHARPNESS_PX)
        sharpness.append(float(cv2.Laplacian(grey, cv2.CV_32F).var()))
        path_length.append(motion.moved_to(_reduced(grey, _MOTION_PX)))
    if not times:
        raise InputError(f"{path}: holds no frame that can be decoded; check that a player plays it")
    return Measured(
        width=size[0],
        height=size[1],
        times_s=np.array(times),
        sharpness=np.array(sharpness),
        path=np.array(path_length),
        num_announced=num_announced,
    )


def _decoded(capture: cv2.VideoCapture) -> Iterator[tuple[float, NDArray[np.uint8]]]:
    """Seconds and pixels of every frame; releases the video at its end."""
    while capture.grab():
        time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
        decoded, frame = capture.retrieve()
        if not decoded:
            break
        yield time_s, np.asarray(frame, np.uint8)
    capture.release()


def _reduced(grey: NDArray[np.uint8], side_px: int) -> NDArray[np.uint8]:
    factor = side_px / max(grey.shape)
    if factor >= 1:
        return grey
    size = (max(1, round(grey.shape[1] * factor)), max(1, round(grey.shape[0] * factor)))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)


class _Motion:
    """How far the picture has moved, measured against a reference that is renewed after some motion.

    Corners are followed from the reference, not from frame to frame, so that trembling does not add up.
    """

    def __init__(self) -> None:
        self._reference: NDArray[np.uint8] | None = None
        self._corners: NDArray[np.float32] | None = None
        self._before = 0.0
        self._farthest = 0.0

    def moved_to(self, grey: NDArray[np.uint8]) -> float:
        """Widths of the frame moved since the first."""
        if self._reference is None or self._corners is None:
            self._renew(grey)
            return self._before
        moved = self._displacement(grey)
        self._farthest = max(self._farthest, moved)
        total = self._before + self._farthest
        if moved >= _NEW_REFERENCE:
            self._before = total
            self._renew(grey)
        return total

    def _displacement(self, grey: NDArray[np.uint8]) -> float:
        """How far the corners moved, or enough for a new reference where they are lost.

        Not the median: of a camera that circles its subject, half the picture stays in place.
        """
        assert self._reference is not None and self._corners is not None
        ends, found, _ = cv2.calcOpticalFlowPyrLK(self._reference, grey, self._corners, None)  # type: ignore[call-overload]
        followed = found.ravel() == 1
        if followed.sum() < _MIN_CORNERS:
            return _NEW_REFERENCE
        offsets = (ends - self._corners).reshape(-1, 2)[followed]
        return float(np.quantile(np.linalg.norm(offsets, axis=1), _MOVING_SHARE)) / max(grey.shape)

    def _renew(self, grey: NDArray[np.uint8]) -> None:
        corners = cv2.goodFeaturesToTrack(grey, _MAX_CORNERS, 0.01, 6)
        enough = corners is not None and len(corners) >= _MIN_CORNERS
        self._farthest = 0.0
        self._reference = grey
        self._corners = np.asarray(corners, np.float32) if enough else None


def choose_frames(measured: Measured, *, num_frames: int = 0, every_s: float = 0.0) -> NDArray[np.int64]:
    """Choose frames: the sharpest of each stretch, none where the camera stands.

    Parameters
    ----------
    measured : Measured
    num_frames : int
        Stretches of equal motion; 0 for one to every fortieth of the width that the picture moves, at most
        300.
    every_s : float
        Stretches of equal time instead, of which those in which the camera stands are left out; 0 for
        stretches of motion.

    Returns
    -------
    (K,) int64
        Indices of frames, rising. Stretches that are blurred all through have none.
    """
    num = len(measured.times_s)
    if every_s:
        stretch = ((measured.times_s - measured.times_s[0]) / every_s).astype(np.int64)
    else:
        length = measured.path[-1]
        wanted = num_frames or int(np.clip(round(length / _SPACING), 1, _MOST_FRAMES))
        stretch = np.minimum(measured.path / max(length, 1e-9) * wanted, wanted - 1).astype(np.int64)
    starts = np.flatnonzero(np.diff(stretch, prepend=-1))
    ends = np.append(starts[1:], num)
    best = [int(s + np.argmax(measured.sharpness[s:e])) for s, e in zip(starts, ends, strict=True)]
    if every_s:
        best = _without_standing(best, measured.path)
    return np.array(_without_blurred(best, measured.sharpness), np.int64)


def _without_standing(frames: Sequence[int], path: NDArray[np.float64]) -> list[int]:
    kept: list[int] = []
    for frame in frames:
        if not kept or path[frame] - path[kept[-1]] >= _STANDING:
            kept.append(frame)
    return kept


def _without_blurred(frames: Sequence[int], sharpness: NDArray[np.float64]) -> list[int]:
    values = sharpness[list(frames)]
    around = [
        np.median(values[max(0, i - _FRAMES_AROUND) : i + _FRAMES_AROUND + 1]) for i in range(len(values))
    ]
    return [
        frame
        for frame, value, usual in zip(frames, values, around, strict=True)
        if value >= _BLURRED_SHARE * usual
    ]


def read_frames(path: Path, numbers: Sequence[int]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Decode some frames.

    Parameters
    ----------
    path : Path
    numbers : sequence of int
        Rising, counted from 0.

    Yields
    ------
    number : int
    frame : (H, W, 3) uint8
        Blue first, turned as the container asks.

    Raises
    ------
    InputError
        If the video cannot be opened, or a frame that could be decoded before now cannot.
    """
    capture = _open(path)
    position = 0
    for number in numbers:
        while position < number and capture.grab():
            position += 1
        decoded, frame = capture.read()
        position += 1
        if not decoded:
            raise InputError(f"{path}: frame {number} can no longer be decoded; has the video changed?")
        yield number, np.asarray(frame, np.uint8)
    capture.release()
