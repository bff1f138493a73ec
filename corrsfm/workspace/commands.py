"""The commands that make each stage, with the options that a workspace remembers."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from corrsfm import config as cfg
from corrsfm.config.fields import flags_of

__all__ = ["STAGE_COMMANDS", "command_for", "label_of"]


STAGE_COMMANDS = {
    "images": "extract",
    "features": "extract",
    "pairs": "pairs",
    "matches": "match",
    "pruned matches": "prune",
    "verified matches": "prune",
    "models": "reconstruct",
}
"""The stages, in order, and the command that makes each.

The names are part of every fingerprint, so those of version 0.1.0 stay; `label_of` is what people read.
"""


_OPTIONS: dict[str, dict[str, type]] = {
    "extract": {
        "images": cfg.ImagesConfig,
        "features": cfg.FeaturesConfig,
        "pairs": cfg.PairsConfig,
        "matches": cfg.MatchesConfig,
    },
    "pairs": {"pairs": cfg.PairsConfig},
    "match": {"matches": cfg.MatchesConfig},
    "prune": {"pruned matches": cfg.PruneConfig, "verified matches": cfg.DatabaseConfig},
    "reconstruct": {"models": cfg.ReconstructionConfig},
}


def label_of(stage: str) -> str:
    """What to call a stage in a line for people."""
    return "kept matches" if stage == "pruned matches" else stage


def command_for(
    stage: str,
    root: Path,
    photos: Sequence[str],
    recorded: Mapping[str, dict[str, Any]],
    flags: Sequence[str] = (),
) -> str:
    """The command that makes a stage, with the options that it was made with, quoted for a shell.

    The seed is not recorded with a stage and so not repeated.

    Parameters
    ----------
    stage : str
    root : Path
        The workspace.
    photos : sequence of str
        What the user named as photos, or a word in its place.
    recorded : mapping
        Stage → the options that it was made with, of the stages that finished.
    flags : sequence of str
        Further words. What was imported can only be imported again, in place of what is there, whatever they
        ask for.
    """
    if "has_shapes" in recorded.get(stage, {}):
        return _import_command(root, photos, recorded)
    command = STAGE_COMMANDS[stage]
    words = ["corrsfm", command, *(photos if command == "extract" else []), str(root)]
    for name, options in _OPTIONS[command].items():
        if name in recorded:
            words += flags_of(options, recorded[name])
    return shlex.join([*words, *flags])


def _import_command(root: Path, photos: Sequence[str], recorded: Mapping[str, dict[str, Any]]) -> str:
    """The command that imported features, and matches unless they were left."""
    source = {key: value for key, value in recorded["features"].items() if key != "has_shapes"}
    words = ["corrsfm", "import", *photos, str(root), *flags_of(cfg.ImportedConfig, source)]
    if source.get("database") and "has_shapes" not in recorded.get("matches", {}):
        words.append("--rematch")
    return shlex.join([*words, *flags_of(cfg.ImagesConfig, recorded.get("images", {})), "--overwrite"])
