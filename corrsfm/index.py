"""The index of a workspace: which photos there are and which cameras took them.

`images.txt` names the photos, one per line, for people and other tools; `images.json` holds the same with
hashes, cameras, masks and GPS positions.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from typing import Any

from corrsfm.errors import WorkspaceError
from corrsfm.types import Camera, ImageRecord
from corrsfm.workspace import Workspace, atomic_write_json, atomic_write_text

__all__ = ["Index", "read_index", "write_index"]


@dataclass(frozen=True, kw_only=True)
class Index:
    """Photos of a scene, sorted by name, and their cameras.

    Attributes
    ----------
    records : tuple of ImageRecord
    cameras : tuple of Camera
        ``records[i].camera_id`` counts into it.
    """

    records: tuple[ImageRecord, ...]
    cameras: tuple[Camera, ...]

    @property
    def names(self) -> list[str]:
        """Names of the photos, sorted."""
        return [record.name for record in self.records]

    def camera_of(self, record: ImageRecord) -> Camera:
        """The camera that took a photo."""
        return self.cameras[record.camera_id]


def write_index(workspace: Workspace, index: Index) -> None:
    """Write `images.json`, then `images.txt`."""
    atomic_write_json(
        workspace.images_json,
        {
            "cameras": [dataclasses.asdict(camera) for camera in index.cameras],
            "images": [dataclasses.asdict(record) for record in index.records],
        },
    )
    atomic_write_text(workspace.images_txt, "".join(f"{name}\n" for name in index.names))


def read_index(workspace: Workspace) -> Index:
    """Read `images.json`.

    Raises
    ------
    WorkspaceError
        If it is missing or damaged.
    """
    path = workspace.images_json
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        cameras = tuple(Camera(**_tuples(entry, "params")) for entry in values["cameras"])
        records = tuple(ImageRecord(**_tuples(entry, "gps")) for entry in values["images"])
    except FileNotFoundError as error:
        raise WorkspaceError(
            f"{path}: missing; index the photos with: corrsfm extract IMAGES {workspace.root}"
        ) from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise WorkspaceError(
            f"{path}: damaged ({error}); make it anew with: corrsfm extract IMAGES {workspace.root}"
        ) from error
    return Index(records=records, cameras=cameras)


def _tuples(entry: dict[str, Any], key: str) -> dict[str, Any]:
    """JSON has no tuples."""
    return {**entry, key: tuple(entry[key]) if entry[key] is not None else None}
