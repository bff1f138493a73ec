"""Lists of a workspace: its photos, their cameras and the pairs to match.

`images.txt` names the photos and `pairs.txt` the pairs, one per line, for people and other tools;
`images.json` adds hashes, cameras, masks and GPS positions, `pair_origins.tsv` where each pair came from.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import shlex
import sys
from dataclasses import dataclass
from typing import Any

from corrsfm.disk import explain
from corrsfm.errors import InputError, WorkspaceError
from corrsfm.files import atomic_write_json, atomic_write_text, read_json
from corrsfm.types import Camera, ImageRecord, PairList
from corrsfm.workspace.folder import Workspace

__all__ = [
    "Index",
    "read_added",
    "read_index",
    "read_pairs",
    "write_index",
    "write_pairs",
]


@dataclass(frozen=True, kw_only=True)
class Index:
    """Photos of a scene, sorted by name, and their cameras.

    Attributes
    ----------
    records : tuple of ImageRecord
    cameras : tuple of Camera
        ``records[i].camera_id`` is an index into it.
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
        values = json.loads(workspace.read_list("images", path))
        cameras = tuple(Camera(**_tuples(entry, "params")) for entry in values["cameras"])
        records = tuple(ImageRecord(**_tuples(entry, "gps")) for entry in values["images"])
    except FileNotFoundError as error:
        raise WorkspaceError(
            f"{path}: missing; index the photos with: {workspace.command_for('images')}"
        ) from error
    except (InputError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise WorkspaceError(
            f"{path}: damaged ({error}); make it again with: {workspace.command_for('images')}"
        ) from error
    return Index(records=records, cameras=cameras)


def read_added(workspace: Workspace) -> dict[str, dict[str, Any]]:
    """Photos that were put into finished models, and what is known of each; empty if there are none."""
    try:
        photos = dict(read_json(workspace.added)["photos"])
        if not all("model" in found for found in photos.values()):
            raise ValueError("a photo without its model")
        return photos
    except FileNotFoundError:
        return {}
    except PermissionError as error:
        raise WorkspaceError(explain(error)) from error
    except (OSError, ValueError, KeyError, TypeError) as error:
        remedy = shlex.join(["rm", "-r", str(workspace.added)])
        raise WorkspaceError(
            f"{workspace.added}: damaged ({error}); what it says of added photos is lost, the models are "
            f"not; run: {remedy}"
        ) from error


def _tuples(entry: dict[str, Any], key: str) -> dict[str, Any]:
    """JSON has no tuples."""
    return {**entry, key: tuple(entry[key]) if entry[key] is not None else None}


def write_pairs(workspace: Workspace, pair_list: PairList) -> None:
    """Write `pair_origins.tsv`, then `pairs.txt`, which hloc reads too."""
    lines = [f"{name0} {name1}\n" for name0, name1 in pair_list.pairs]
    origins = [
        f"{name0}\t{name1}\t{','.join(origin)}\n"
        for (name0, name1), origin in zip(pair_list.pairs, pair_list.origins, strict=True)
    ]
    atomic_write_text(workspace.pair_origins, "".join(origins))
    atomic_write_text(workspace.pairs, "".join(lines))


def read_pairs(workspace: Workspace) -> PairList:
    """The pairs of a workspace with their origins.

    Raises
    ------
    WorkspaceError
        If they are missing or damaged.
    """
    path = workspace.pair_origins
    try:
        # splitlines would also split at characters that a name may hold.
        lines = workspace.read_list("pairs", path).decode().split("\n")
        rows = (line.split("\t") for line in lines if line)
        # A large scene has each name and each origin many times: one object for all.
        origin_of = functools.cache(lambda text: tuple(text.split(",")))
        pairs, origins = [], []
        for name0, name1, origin in rows:
            pairs.append((sys.intern(name0), sys.intern(name1)))
            origins.append(origin_of(origin))
        return PairList(pairs=tuple(pairs), origins=tuple(origins))
    except FileNotFoundError as error:
        raise WorkspaceError(f"{path}: missing; run: {workspace.command_for('pairs')}") from error
    except (OSError, ValueError) as error:
        command = workspace.command_for("pairs", "--overwrite")
        raise WorkspaceError(f"{path}: damaged ({error}); run: {command}") from error
