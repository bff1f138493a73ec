"""The folder of a case: a few good photos, a finished scene of them, and other good input to spoil."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

__all__ = ["CAMERA", "NUM_PHOTOS", "SIZE", "Place", "make_base"]

SIZE = (160, 120)
NUM_PHOTOS = 5
CAMERA = "130,80,60"
"""Intrinsics of the photos, for --camera-model SIMPLE_PINHOLE."""

_QUICK = ["--max-features", "200", "--threads", "1", "--device", "cpu"]
SCENE_OPTIONS = ["--camera-model", "SIMPLE_PINHOLE", "--camera-params", CAMERA, *_QUICK]


@dataclass(frozen=True)
class Place:
    """Where a case lies.

    Attributes
    ----------
    base : Path
        What `make_base` made; nothing in it is changed.
    work : Path
        The working directory of the command.
    """

    base: Path
    work: Path

    def photos(self, num: int = 3, name: str = "photos") -> Path:
        """A folder with the first few photos."""
        folder = self.work / name
        folder.mkdir()
        for number in range(num):
            shutil.copy(self.base / "photos" / f"{number}.jpg", folder)
        return folder

    def scene(self, name: str = "scene", photos: int = NUM_PHOTOS) -> Path:
        """A finished workspace of five photos, or of the first four, with the folder ``photos`` of them."""
        if not (self.work / "photos").exists():
            self.photos(photos)
        shutil.copytree(self.base / ("scene" if photos == NUM_PHOTOS else "small_scene"), self.work / name)
        manifest = self.work / name / "workspace.json"
        text = manifest.read_text("utf-8").replace(str(self.base / "photos"), str(self.work / "photos"))
        manifest.write_text(text, "utf-8")
        return self.work / name

    def model(self, name: str = "model") -> Path:
        """A COLMAP model of the photos, in binary."""
        shutil.copytree(self.base / "scene" / "sparse" / "0", self.work / name)
        return self.work / name

    def file(self, name: str, content: bytes | str = b"") -> Path:
        """A file of the working directory."""
        path = self.work / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(
            content if isinstance(content, bytes) else content.encode("utf-8", "surrogateescape")
        )
        return path


def render_photos(folder: Path, num: int = NUM_PHOTOS) -> None:
    """Photos of a made-up room from an arc, small enough to be reconstructed in a second."""
    from phone_video import _RECTANGLES, _look_at, _render, texture

    folder.mkdir(parents=True)
    surfaces = [texture(seed) for seed in range(len(_RECTANGLES))]
    for number in range(num):
        x = 1.6 * number / (num - 1) - 0.8
        centre = np.array([x, 0.1 * np.sin(5 * x), 0.2 * number / num - 1.2])
        picture = _render(*_look_at(centre, np.array([0.2, 0.2, 4.0])), surfaces, SIZE)
        assert cv2.imwrite(str(folder / f"{number}.jpg"), np.clip(picture, 0, 255).astype(np.uint8))


def make_base(folder: Path) -> None:
    """Make what all cases copy: photos, a scene, labelled pairs, files of other tools, a training run."""
    from foreign_files import write_features, write_matches, write_old_database
    from labelled_scene import make_scene
    from sandbox import call

    from corrsfm.labelled.compact import write_scenes
    from corrsfm.model.weights import CHECKPOINT_DIR, DEFAULT_CHECKPOINT

    folder = folder.resolve()
    render_photos(folder / "photos")
    run = ["-q", "run", str(folder / "photos"), str(folder / "scene"), *SCENE_OPTIONS]
    assert call(run) == 0
    for path in sorted((folder / "photos").iterdir()):
        mirrored = folder / "other_photos" / path.name
        mirrored.parent.mkdir(exist_ok=True)
        assert cv2.imwrite(str(mirrored), cv2.flip(cv2.imread(str(path)), 1))
    run = ["-q", "run", str(folder / "other_photos"), str(folder / "other_scene"), *SCENE_OPTIONS]
    assert call(run) == 0
    first = [str(folder / "photos" / f"{number}.jpg") for number in range(NUM_PHOTOS - 1)]
    assert call(["-q", "run", *first, str(folder / "small_scene"), *SCENE_OPTIONS]) == 0
    assert json.loads((folder / "scene" / "report.json").read_text())["models"]
    names = [f"{number}.jpg" for number in range(3)]
    write_features(folder / "hloc_features.h5", names)
    write_matches(folder / "hloc_matches.h5", [("0.jpg", "1.jpg"), ("1.jpg", "2.jpg")])
    write_old_database(folder / "old.db", names)
    write_scenes(folder / "pairs.h5", [make_scene()])
    wall = cv2.imread(str(folder / "photos" / "0.jpg"))
    assert cv2.imwrite(str(folder / "wall.ppm"), wall)
    shutil.copy(CHECKPOINT_DIR / f"{DEFAULT_CHECKPOINT}.pt", folder / "net.pt")
