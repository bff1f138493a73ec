"""hloc: features, matches and pairs as its tools read them, and a reconstruction in ``sfm``."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pycolmap

from corrsfm.colmap.databases import copy_photos_of
from corrsfm.files import atomic_write_text
from corrsfm.workspace import Workspace
from corrsfm.workspace.hloc import FEATURES, PRUNED
from corrsfm.workspace.lists import read_pairs
from corrsfm.workspace.store import ItemStore

__all__ = ["write_hloc"]


def write_hloc(model: pycolmap.Reconstruction, workspace: Workspace, folder: Path) -> None:
    """``features.h5``, ``matches.h5``, ``pairs.txt`` and ``sfm`` of the photos of a model.

    The matches are the kept ones, with an entry for each keypoint. Keypoints are float32 with the first
    pixel's centre at (0, 0): hloc adds half a pixel when it writes a database.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    workspace : Workspace
    folder : Path
    """
    names = sorted(image.name for image in model.images.values())
    num_keypoints = {}
    with (
        ItemStore(workspace.features, FEATURES).reader() as read,
        h5py.File(folder / "features.h5", "w") as file,
    ):
        for name in names:
            features = read(name)
            num_keypoints[name] = len(features.keypoints)
            arrays, _ = FEATURES.encode(features)
            for key, value in arrays.items():
                file[f"{name}/{key}"] = value
    held = set(names)
    pairs = [pair for pair in read_pairs(workspace).pairs if held >= set(pair)]
    with (
        ItemStore(workspace.pruned, PRUNED).reader() as read_kept,
        h5py.File(folder / "matches.h5", "w") as file,
    ):
        for pair in pairs:
            kept, num = read_kept(pair), num_keypoints[pair[0]]
            matches, scores = np.full(num, -1, np.int32), np.zeros(num, np.float32)
            matches[kept.indices[:, 0]] = kept.indices[:, 1]
            scores[kept.indices[:, 0]] = kept.scores
            file[f"{PRUNED.group(pair)}/matches0"] = matches
            file[f"{PRUNED.group(pair)}/matching_scores0"] = scores
    atomic_write_text(folder / "pairs.txt", "".join(f"{name0} {name1}\n" for name0, name1 in pairs))
    (folder / "sfm").mkdir()
    model.write_binary(folder / "sfm")
    copy_photos_of(workspace.database, folder / "sfm" / "database.db", names)
