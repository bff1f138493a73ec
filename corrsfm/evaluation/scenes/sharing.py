"""Workspaces that share finished stages: what several reconstructions start from is on disk once."""

from __future__ import annotations

from corrsfm.files import share_file
from corrsfm.workspace import Workspace

__all__ = ["KEPT_MATCHES", "PUTATIVE_MATCHES", "share_stages"]

PUTATIVE_MATCHES = ("images", "features", "pairs", "matches")
"""Everything up to the putative matches."""

KEPT_MATCHES = (*PUTATIVE_MATCHES, "pruned matches")
"""Everything up to the kept matches."""


def share_stages(base: Workspace, target: Workspace, stages: tuple[str, ...] = PUTATIVE_MATCHES) -> None:
    """Give a workspace the photos and the first stages of another without copying them.

    What was made from a stage stays valid while the record of the stage is unchanged. Files are hard links;
    who writes into one copies it first, so neither workspace can harm the other.

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
            source = getattr(base, name)
            link = target.root / source.relative_to(base.root)
            if source.exists():
                share_file(source, link)
            else:
                link.unlink(missing_ok=True)
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
