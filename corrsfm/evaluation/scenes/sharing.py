"""Workspaces that share finished stages: what several reconstructions start from is on disk once."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from corrsfm.workspace import Workspace

__all__ = ["KEPT_MATCHES", "PUTATIVE_MATCHES", "share_stages"]

PUTATIVE_MATCHES = ("images", "features", "pairs", "matches")
"""Everything up to the putative matches."""

KEPT_MATCHES = (*PUTATIVE_MATCHES, "pruned matches")
"""Everything up to the kept matches."""


def share_stages(base: Workspace, target: Workspace, stages: tuple[str, ...] = PUTATIVE_MATCHES) -> None:
    """Give a workspace the photos and the first stages of another without copying them.

    What was made from a stage stays valid while the record of the stage is unchanged. Files are hard links;
    stages replace files rather than change them, so neither workspace can harm the other.

    Parameters
    ----------
    base, target : Workspace
    stages : tuple of str
        `PUTATIVE_MATCHES` or `KEPT_MATCHES`. With kept matches, nothing reads the putative ones any more:
        their file may be missing.
    """
    target.images_dir = base.images_dir
    for stage in stages:
        for name in _FILES[stage]:
            _link(getattr(base, name), getattr(target, name))
        record = base.require(stage)
        known = target.record_of(stage)
        if known is None or known.fingerprint != record.fingerprint:
            target.finish(stage, record)


_FILES = {
    "images": ("images_txt", "images_json"),
    "features": ("features",),
    "pairs": ("pairs", "pair_origins"),
    "matches": ("matches",),
    "pruned matches": ("pruned",),
}


def _link(source: Path, link: Path) -> None:
    if link.exists() and source.exists() and os.path.samefile(source, link):
        return
    link.unlink(missing_ok=True)
    if not source.exists():
        return
    try:
        os.link(source, link)
    except OSError:
        # Some file systems have no hard links.
        shutil.copy2(source, link)
