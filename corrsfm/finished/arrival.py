"""Photos on their way into a finished scene: which are new, and what an interruption left pending."""

from __future__ import annotations

import logging
import shlex
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from corrsfm.disk import explain
from corrsfm.errors import InputError, WorkspaceError, first_few
from corrsfm.files import atomic_path, read_json, sha256_of
from corrsfm.finished.incoming import Incoming
from corrsfm.workspace import Workspace
from corrsfm.workspace.commands import STAGE_COMMANDS
from corrsfm.workspace.lists import read_index
from corrsfm.workspace.models import models_of

__all__ = [
    "Pending",
    "copy_photos",
    "pending_addition",
    "require_folder",
    "sort_out",
]

logger = logging.getLogger("corrsfm")


@dataclass(frozen=True, kw_only=True)
class Pending:
    """What `adding.json` keeps of an addition until it has finished.

    Attributes
    ----------
    photos : dict of str to str
        New photo → hash of its bytes.
    options : dict
        Stage → its options. A stage that is interrupted while it writes has no record for a moment.
    refine : bool
        Whether everything is to be adjusted at the end.
    """

    photos: dict[str, str]
    options: dict[str, dict[str, Any]]
    refine: bool = False


def pending_addition(workspace: Workspace) -> Pending:
    """The addition that was interrupted, or one without photos yet.

    Raises
    ------
    WorkspaceError
        If nothing was interrupted and the scene has no current model, or its database or models were damaged
        since.
    """
    try:
        pending = Pending(**read_json(workspace.adding))
        if not _is_table(pending.photos, str) or not _is_table(pending.options, dict):
            raise TypeError("its photos or options are no tables")
        if missing := STAGE_COMMANDS.keys() - pending.options.keys():
            raise TypeError(f"lacks the options of {min(missing)}")
    except FileNotFoundError:
        workspace.require("models")
        models_of(workspace)
        # Photos are put into what is there, and cannot mend it; mapped again it would not be the same model.
        if changed := workspace.changed_files("verified matches"):
            raise WorkspaceError(
                f"{first_few(map(str, changed))}: not as it was written; corrsfm check "
                f"{shlex.quote(str(workspace.root))} says how it is made again"
            ) from None
        return Pending(
            photos={}, options={stage: workspace.require(stage).config for stage in STAGE_COMMANDS}
        )
    except (OSError, ValueError, TypeError) as error:
        removal = shlex.join(["rm", str(workspace.adding)])
        raise WorkspaceError(
            f"{workspace.adding}: damaged ({error}); remove it, with: {removal}; then run the command that "
            "made the scene again"
        ) from error
    logger.info("going on with the addition of %s", first_few(pending.photos))
    return pending


def _is_table(values: Any, kind: type) -> bool:
    return isinstance(values, dict) and all(isinstance(value, kind) for value in values.values())


def sort_out(
    found: Sequence[Incoming], workspace: Workspace, pending: Mapping[str, str]
) -> tuple[list[Incoming], tuple[str, ...]]:
    """The photos that are new, and the names of those that the scene holds already.

    Raises
    ------
    InputError
        Naming photos whose name another photo has.
    """
    known = {record.name: record.sha256 for record in read_index(workspace).records}
    new, already, taken = [], [], []
    for photo in found:
        place = workspace.images_dir / photo.name
        there = pending.get(photo.name) or known.get(photo.name)
        if there is None and place.is_file():
            there = sha256_of(place)
        if there not in (None, photo.sha256):
            taken.append(f"{photo.path}: the scene has another photo of the name {photo.name}")
        elif photo.name in known and photo.name not in pending:
            already.append(photo.name)
        else:
            new.append(photo)
    if taken:
        raise InputError("\n".join(taken) + "\nrename them and add them again; nothing was changed")
    return new, tuple(already)


def require_folder(workspace: Workspace, incoming: Sequence[Incoming], wanted: Mapping[str, str]) -> None:
    """Check that the folder of the scene's photos is there, with what an interrupted addition copied.

    Raises
    ------
    InputError
        Naming what is missing.
    """
    folder = workspace.images_dir
    if not folder.is_dir():
        raise InputError(
            f"{folder}: the folder of the scene's photos is not there; mount it, or say where it is with: "
            + workspace.command_for("images", images_dir="NEWDIR")
        )
    named = {photo.name for photo in incoming}
    lost = [name for name in wanted if name not in named and not (folder / name).is_file()]
    if lost:
        raise InputError(
            f"{folder}: photos of the interrupted addition are not there: {first_few(lost)}; name them "
            f"again, or give that addition up, with: {shlex.join(['rm', str(workspace.adding)])}"
        )


def copy_photos(incoming: Sequence[Incoming], folder: Path) -> None:
    """Copy the photos that lie elsewhere into the folder of the scene's photos."""
    outside = [photo for photo in incoming if not (folder / photo.name).is_file()]
    for photo in outside:
        try:
            with atomic_path(folder / photo.name) as temporary:
                shutil.copy2(photo.file, temporary)
        except OSError as error:
            raise InputError(
                f"{explain(error, folder / photo.name)}; or put the new photos there yourself, and run the "
                "same command on them there"
            ) from error
    if outside:
        logger.info("copied to %s: %s", folder, first_few(photo.name for photo in outside))
