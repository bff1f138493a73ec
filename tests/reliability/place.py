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
_CAMERAS = ["--camera-model", "SIMPLE_PINHOLE", "--camera-params", CAMERA]
SCENE_OPTIONS = [*_CAMERAS, *_QUICK]
# Matches of other tools carry no ratios, which the network reads; and features are not limited again.
IMPORTED_OPTIONS = [*_CAMERAS, "--method", "loransac", "--threads", "1", "--device", "cpu"]


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
        return self._copy_of("scene" if photos == NUM_PHOTOS else "small_scene", name)

    def imported_scene(self, name: str = "scene") -> Path:
        """A finished workspace of features and matches that were imported from ``hloc``."""
        self.photos(NUM_PHOTOS)
        shutil.copytree(self.base / "hloc", self.work / "hloc")
        return self._copy_of("imported_scene", name)

    def grown_scene(self, name: str = "scene") -> Path:
        """A finished workspace of four photos that a fifth was added to."""
        self.photos(NUM_PHOTOS)
        return self._copy_of("grown_scene", name)

    def _copy_of(self, scene: str, name: str) -> Path:
        """A copy of a workspace that knows its photos, and what it was imported from, in this place."""
        shutil.copytree(self.base / scene, self.work / name)
        from corrsfm.workspace.manifest import write_manifest

        manifest = self.work / name / "workspace.json"
        text = manifest.read_text("utf-8")
        for folder, here in (("grown_photos", "photos"), ("photos", "photos"), ("hloc", "hloc")):
            text = text.replace(f'"{self.base / folder}', f'"{self.work / here}')
        values = json.loads(text)
        write_manifest(manifest, {key: value for key, value in values.items() if key != "checksum"})
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
    from corrsfm.model.weights import CHECKPOINT_DIR, DEFAULT_CHECKPOINTS

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
    _make_imported(folder)
    _make_grown(folder)
    names = [f"{number}.jpg" for number in range(3)]
    write_features(folder / "hloc_features.h5", names)
    write_matches(folder / "hloc_matches.h5", [("0.jpg", "1.jpg"), ("1.jpg", "2.jpg")])
    write_old_database(folder / "old.db", names)
    write_scenes(folder / "pairs.h5", [make_scene()])
    wall = cv2.imread(str(folder / "photos" / "0.jpg"))
    assert cv2.imwrite(str(folder / "wall.ppm"), wall)
    shutil.copy(CHECKPOINT_DIR / f"{DEFAULT_CHECKPOINTS['corradaptor']}.pt", folder / "net.pt")


def _make_imported(folder: Path) -> None:
    """A scene of what another was exported to."""
    from sandbox import call

    assert call(["-q", "export", str(folder / "scene"), str(folder / "hloc"), "--for", "hloc"]) == 0
    photos, scene = str(folder / "photos"), str(folder / "imported_scene")
    files = [f"--{name}={folder / 'hloc' / name}.h5" for name in ("features", "matches")]
    assert call(["-q", "import", photos, scene, *files, "--kind", "sift", *_CAMERAS]) == 0
    assert call(["-q", "run", photos, scene, *IMPORTED_OPTIONS]) == 0
    assert json.loads((folder / "imported_scene" / "report.json").read_text())["models"]


def _make_grown(folder: Path) -> None:
    """A scene of four photos that a fifth was added to."""
    from sandbox import call

    for number in range(NUM_PHOTOS - 1):
        (folder / "grown_photos").mkdir(exist_ok=True)
        shutil.copy(folder / "photos" / f"{number}.jpg", folder / "grown_photos")
    scene = str(folder / "grown_scene")
    assert call(["-q", "run", str(folder / "grown_photos"), scene, *SCENE_OPTIONS]) == 0
    new = str(folder / "photos" / f"{NUM_PHOTOS - 1}.jpg")
    assert call(["-q", "add", scene, new, "--threads", "1", "--device", "cpu"]) == 0
    assert json.loads((folder / "grown_scene" / "added.json").read_text())["photos"]["4.jpg"]["model"] == 0
