"""The frames of a video as photos in a folder, with their times; an interrupted extraction is resumed.

A frame's name is its number in the video, so a file that exists is right whatever options chose it, as long
as the video is the same. ``frames.json`` is written last: without it the folder is not finished.
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from corrsfm.errors import InputError, WorkspaceError, first_few
from corrsfm.files import FRAME_TIMES, OWN_RECORD, atomic_path, atomic_write_json, read_json, sha256_of
from corrsfm.images.video import Measured, choose_frames, measure_video, read_frames, seconds_of

__all__ = ["Frame", "are_frames_of", "extract_frames"]

logger = logging.getLogger("corrsfm")

_JPEG_QUALITY = 97
# What is measured, and how; a change makes old measurements stale.
_VERSION = 1
# Containers count a few frames too many.
_LEAST_DECODED = 0.97


Track = Callable[[Iterable, int, str], Iterable]
"""Items, their number and what is done with them → the same items, with progress shown."""


@dataclass(frozen=True, kw_only=True)
class Frame:
    """A frame of a video.

    Attributes
    ----------
    name : str
        Of the file in the folder of the frames.
    number : int
        In the video, from 0.
    time_s : float
        Seconds from the start of the video.
    """

    name: str
    number: int
    time_s: float


def extract_frames(
    video: Path,
    folder: Path,
    *,
    num_frames: int = 0,
    every: str = "",
    hash_of: Callable[[Path], str] = sha256_of,
    track: Track = lambda items, total, text: items,
) -> list[Frame]:
    """Choose frames of a video and write them as JPEG, with ``frames.json``.

    Frames that an earlier call wrote are kept if they are still wanted.

    Parameters
    ----------
    video, folder : Path
    num_frames : int
        As in `choose_frames`.
    every : str
        A duration such as ``0.5s``; see `choose_frames`.
    hash_of : callable, optional
        Replacement for `corrsfm.files.sha256_of`, such as a cache.
    track : callable, optional
        Shows progress.

    Returns
    -------
    list of Frame
        In the order of time.

    Raises
    ------
    ConfigError
        If the duration is none.
    InputError
        If there is no such video, it cannot be decoded, or gives fewer than two frames.
    WorkspaceError
        If the folder holds files of others, or cannot be written.
    """
    every_s = seconds_of(every) if every else 0.0
    measured = _measured(video, folder, hash_of, track)
    num = len(measured.times_s)
    if num < _LEAST_DECODED * measured.num_announced:
        logger.warning(
            "%s: only %d of %d frames can be decoded, up to %.1f s; the video is cut off or damaged there",
            video,
            num,
            measured.num_announced,
            measured.times_s[-1],
        )
    numbers = choose_frames(measured, num_frames=num_frames, every_s=every_s)
    frames = [
        Frame(
            name=f"frame_{number:06d}.jpg",
            number=int(number),
            time_s=round(float(measured.times_s[number]), 4),
        )
        for number in numbers
    ]
    if len(frames) < 2:
        raise InputError(
            f"{video}: {num} frames can be decoded, in which the picture moves by {measured.path[-1]:.0%} of "
            f"its width: fewer than two frames to reconstruct from; {_more_frames(num_frames, every)}"
        )
    try:
        _write(video, folder, frames, {"frames": num_frames, "every": every}, hash_of, track)
    except OSError as error:
        raise WorkspaceError(f"{folder}: frames cannot be written ({error.strerror})") from error
    if len(frames) < num_frames:
        logger.info(
            "%s: %d frames rather than %d: the other stretches hold no frame, or only blurred ones",
            video.name,
            len(frames),
            num_frames,
        )
    logger.info(
        "%s: %d of %d frames, of %d×%d pixels, %.1f s; the sharpest of each stretch where the camera moves",
        video.name,
        len(frames),
        num,
        measured.width,
        measured.height,
        measured.times_s[-1] - measured.times_s[0],
    )
    return frames


def _more_frames(num_frames: int, every: str) -> str:
    """What to try where fewer than two frames were chosen."""
    if num_frames == 1:
        return "ask for more than --frames 1"
    return f"film while you walk, or try {f'less than --every {every}' if every else '--every 0.1s'}"


def _measured(video: Path, folder: Path, hash_of: Callable[[Path], str], track: Track) -> Measured:
    """Measurements of every frame, from an earlier call if it was of this video."""
    if not video.is_file():
        raise InputError(f"{video}: no such file; expected a video")
    path = folder / OWN_RECORD
    others = folder.is_dir() and any(not item.name.startswith(".") for item in folder.iterdir())
    if others and not path.is_file():
        raise WorkspaceError(
            f"{folder}: holds files of others, and the frames of {video.name} would go there; choose another "
            "workspace, or give that folder itself as photos"
        )
    key = _key_of(video, hash_of)
    try:
        values = read_json(path)
        if values.pop("key") == key:
            arrays = {name: np.array(values[name]) for name in ("times_s", "sharpness", "path")}
            return Measured(**(values | arrays))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        pass
    logger.info("%s: measuring sharpness and motion of every frame", video.name)
    measured = measure_video(video, lambda frames, total: track(frames, total, "measuring frames"))
    # Frames of another video have the same names.
    for name in _frames_in(folder):
        (folder / name).unlink()
    (folder / FRAME_TIMES).unlink(missing_ok=True)
    plain: dict[str, Any] = {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in dataclasses.asdict(measured).items()
    }
    atomic_write_json(path, {"key": key, **plain})
    return measured


def _key_of(video: Path, hash_of: Callable[[Path], str]) -> dict[str, Any]:
    """What measurements of a video are kept under."""
    return {"version": _VERSION, "sha256": hash_of(video)}


def are_frames_of(video: Path, folder: Path) -> bool:
    """Whether the frames in a folder are those of a video, wherever that was when they were taken."""
    try:
        return read_json(folder / OWN_RECORD)["key"] == _key_of(video, sha256_of)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _frames_in(folder: Path) -> set[str]:
    return {path.name for path in folder.glob("frame_*.jpg")}


def _write(
    video: Path,
    folder: Path,
    frames: Sequence[Frame],
    options: dict[str, Any],
    hash_of: Callable[[Path], str],
    track: Track,
) -> None:
    """Bring a folder to exactly these frames, and record them."""
    record: dict[str, Any] = {
        "video": str(video.resolve()),
        "options": options,
        "frames": [dataclasses.asdict(frame) for frame in frames],
    }
    there = _frames_in(folder)
    try:
        before = read_json(folder / FRAME_TIMES)
        hashes = dict(before.get("sha256", {}))
    except (OSError, ValueError, TypeError, AttributeError):
        before, hashes = None, {}
    if changed := sorted(name for name in there & hashes.keys() if hash_of(folder / name) != hashes[name]):
        logger.warning("%s: have changed and are taken from the video again: %s", folder, first_few(changed))
        there -= set(changed)
    wanted = {frame.name for frame in frames}
    missing = [frame for frame in frames if frame.name not in there]
    record["sha256"] = {name: hashes[name] for name in sorted(there & wanted & hashes.keys())}
    if before == record and there == wanted:
        return
    if before is not None and before.get("options") != options:
        known = before.get("options", {})
        changes = (
            f"{key} {known.get(key)} → {options[key]}" for key in options if known.get(key) != options[key]
        )
        logger.info(
            "frames: chosen again (%s): %d new, %d kept, %d removed",
            ", ".join(changes),
            len(missing),
            len(there & wanted),
            len(there - wanted),
        )
    (folder / FRAME_TIMES).unlink(missing_ok=True)
    for name in there - wanted:
        (folder / name).unlink()
    by_number = {frame.number: frame for frame in missing}
    for number, picture in track(read_frames(video, list(by_number)), len(missing), "writing frames"):
        _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        with atomic_path(folder / by_number[number].name) as temporary:
            temporary.write_bytes(encoded.tobytes())
        record["sha256"][by_number[number].name] = hashlib.sha256(encoded.tobytes()).hexdigest()
    atomic_write_json(folder / FRAME_TIMES, record)
