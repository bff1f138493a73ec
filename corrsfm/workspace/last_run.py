"""What `run.json` says of the run that made a scene."""

from __future__ import annotations

import logging

from corrsfm.files import read_json
from corrsfm.workspace.folder import Workspace

__all__ = ["seed_of_last_run"]

logger = logging.getLogger("corrsfm")


def seed_of_last_run(workspace: Workspace, fingerprint: str | None = None) -> int | None:
    """The seed of the last `corrsfm run`; None if that is not known, or it made other models.

    Parameters
    ----------
    workspace : Workspace
    fingerprint : str, optional
        Of the models that it must have made.
    """
    if workspace.run_json in workspace.changed_records():
        logger.warning("%s: not as it was written; its seed is not used", workspace.run_json)
        return None
    try:
        record = read_json(workspace.run_json)
        if fingerprint not in (None, record["fingerprints"]["models"]):
            return None
        return int(record["seed"])
    # Made step by step, or by an earlier version and damaged since.
    except (OSError, ValueError, LookupError, TypeError):
        return None
