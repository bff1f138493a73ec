"""What to try next, as commands that can be pasted."""

from __future__ import annotations

import shlex

from corrsfm.report.missing import MissingPhoto, MissingReason
from corrsfm.workspace import Workspace
from corrsfm.workspace.imported import imported_from

__all__ = ["command_again", "more_photos_to_add", "more_photos_to_map", "next_step"]


def command_again(workspace: Workspace, stage: str, *flags: str, images_dir: str | None = None) -> str:
    """The commands that make a stage with further options, and all stages that hang on it.

    Every other option stays what it was.

    Parameters
    ----------
    workspace : Workspace
    stage : str
    flags : str
        Words to add to the first command.
    images_dir : str, optional
        As for `Workspace.command_for`.
    """
    _, *others = workspace.commands_from(stage)
    return "; ".join([workspace.command_for(stage, *flags, images_dir=images_dir), *others])


def next_step(missing: MissingPhoto, workspace: Workspace) -> str:
    """What to try for a photo that is not in the first model."""
    match missing.reason:
        case MissingReason.LEFT_OUT:
            return f"replace the file, then: {workspace.remedy_for('features')}"
        case MissingReason.NO_PAIR:
            return command_again(workspace, "pairs", "--pairing", "exhaustive")
        case MissingReason.NO_MATCH:
            return "look at the photo: it may be blank, blurred or masked; leave it out or replace it"
        case MissingReason.PRUNED:
            return command_again(workspace, "pruned matches", "--method", "ratio")
        case MissingReason.NOT_VERIFIED:
            return command_again(workspace, "pruned matches", "--min-num-inliers", "10")
        case MissingReason.NOT_MAPPED:
            return workspace.command_for("models")
        case MissingReason.OTHER_MODEL | MissingReason.OTHER_COMPONENT:
            return more_photos_to_map(workspace, "between this one and those of the model")
    return more_photos_to_add(workspace, "next to this one")


def more_photos_to_add(workspace: Workspace, where: str) -> str:
    """Photos that make a model firmer, which stays where it is unless its features were imported."""
    if imported_from(workspace, "features") is not None:
        command = workspace.command_for("features")
        return f"take photos {where}, make a file of features that holds them too, then: {command}"
    return f"take photos {where}, then: corrsfm add {shlex.quote(str(workspace.root))} NEWPHOTOS"


def more_photos_to_map(workspace: Workspace, where: str) -> str:
    """Photos that connect parts of a scene: all must be mapped again."""
    folder = shlex.quote(str(workspace.images_dir))
    return f"take photos {where}, put them into {folder}, then: {command_again(workspace, 'images')}"
