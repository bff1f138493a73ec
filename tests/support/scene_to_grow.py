"""A reconstructed scene of five rendered photos, and two more of the same place that are not in it yet."""

from __future__ import annotations

import hashlib
import shutil
from dataclasses import dataclass
from pathlib import Path

import pycolmap
from rendered_scene import CONFIG, render_scene

from corrsfm.pipeline import run_scene


@dataclass(frozen=True, kw_only=True)
class SceneToGrow:
    """Folders of a scene; `copy` gives a test its own."""

    workspace: Path
    photos: Path
    new: Path
    truth: Path

    def copy(self, folder: Path) -> SceneToGrow:
        """The same in another folder; the workspace knows its photos there."""
        shutil.copytree(self.workspace.parent, folder, dirs_exist_ok=True, copy_function=shutil.copy2)
        moved = SceneToGrow(
            workspace=folder / "scene", photos=folder / "photos", new=folder / "new", truth=folder / "truth"
        )
        manifest = moved.workspace / "workspace.json"
        text = manifest.read_text(encoding="utf-8")
        manifest.write_text(text.replace(str(self.photos.resolve()), str(moved.photos.resolve())), "utf-8")
        return moved

    @property
    def new_names(self) -> list[str]:
        return sorted(path.name for path in self.new.iterdir())

    def model(self) -> pycolmap.Reconstruction:
        return pycolmap.Reconstruction(self.workspace / "sparse" / "0")


def make_scene_to_grow(root: Path) -> SceneToGrow:
    """Render seven photos, reconstruct five of them, and keep the first and the fourth for later."""
    images, truth = render_scene(root, num_photos=7)
    new = root / "new"
    new.mkdir()
    names = sorted(path.name for path in images.iterdir())
    for name in (names[0], names[3]):
        (images / name).rename(new / name)
    images.rename(root / "photos")
    run_scene(root / "photos", root / "scene", CONFIG)
    return SceneToGrow(workspace=root / "scene", photos=root / "photos", new=new, truth=truth)


def contents(folder: Path) -> dict[str, str]:
    """Path → hash of every file below a folder."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
