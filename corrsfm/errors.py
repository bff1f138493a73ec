"""Errors written for the user.

Every error a user can cause derives from `CorrsfmError`; the command line catches that one class, prints
its text and exits non-zero. A text names the file or the pair, what was expected and what to try.

::

    CorrsfmError
    ├── ConfigError            an option or a pipeline file is wrong
    ├── InputError             photos, lists or models that the user gave are not usable
    │   └── ImageError         one photo is not usable
    ├── WorkspaceError         a workspace lacks a file, is damaged, locked or of another version
    ├── CheckpointError        a network checkpoint is damaged or of another network
    ├── DatabaseError          the COLMAP database cannot be read or written
    ├── ReconstructionError    mapping produced no model
    ├── ClusterError           a Dask cluster cannot be used, or was lost
    └── DependencyError        an optional package is needed and absent
"""

from __future__ import annotations

import re
from collections.abc import Iterable

__all__ = [
    "CheckpointError",
    "ClusterError",
    "ConfigError",
    "CorrsfmError",
    "DamageError",
    "DatabaseError",
    "DependencyError",
    "ImageError",
    "InputError",
    "ReconstructionError",
    "WorkspaceError",
    "first_few",
    "lack_or_text",
    "printable",
]

_MAX_NAMED = 5
_MOST_SHOWN_FIRST, _MOST_SHOWN_LAST = 1800, 600

# Anything that may change what a terminal shows, but for the line breaks of our own texts.
_UNPRINTABLE = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


class CorrsfmError(Exception):
    """Root of all errors that corrsfm raises on purpose."""


class ConfigError(CorrsfmError):
    """An option or a pipeline file holds a name or a value that does not exist."""


class InputError(CorrsfmError):
    """Photos, lists or models that the user gave are not usable."""


class ImageError(InputError):
    """One photo is not usable; the text begins with its name."""


class WorkspaceError(CorrsfmError):
    """A workspace lacks a file, holds a damaged one, is locked or of another version."""


class CheckpointError(CorrsfmError):
    """A network checkpoint is damaged, of an unknown format or of another network."""


class DamageError(WorkspaceError):
    """A file of a workspace does not hold what was written to it."""


class DatabaseError(CorrsfmError):
    """A COLMAP database cannot be read or written."""


class ReconstructionError(CorrsfmError):
    """Mapping ended without a model."""


class ClusterError(CorrsfmError):
    """A Dask cluster cannot be used, or was lost."""


class DependencyError(CorrsfmError):
    """An optional package that this operation needs is not installed.

    Parameters
    ----------
    package : str
        The package's name on the index.
    purpose : str
        What it is needed for, as the end of "… is needed for".
    extra : str
        The extra of corrsfm that brings it; empty if it is in none.
    """

    def __init__(self, package: str, purpose: str, extra: str = "") -> None:
        wanted = f"'corrsfm[{extra}]'" if extra else package
        super().__init__(
            f"the package '{package}' is needed for {purpose} and is not installed; try: pip install {wanted}"
        )


def first_few(names: Iterable[str]) -> str:
    """Join the first few names and count the rest, to keep a message readable."""
    names = list(names)
    rest = len(names) - _MAX_NAMED
    return ", ".join(names[:_MAX_NAMED]) + (f" and {rest} more" if rest > 0 else "")


def lack_or_text(error: Exception) -> str:
    """What an error says of values that were read, where Python's says of a missing one its name alone."""
    return f"lacks {error}" if isinstance(error, KeyError) else str(error)


def printable(text: str) -> str:
    """A text for a terminal, without what would steer it or flood it."""
    text = _UNPRINTABLE.sub(lambda found: ascii(found[0])[1:-1], text)
    # The cause is at the beginning, the advice at the end.
    left_out = len(text) - _MOST_SHOWN_FIRST - _MOST_SHOWN_LAST
    if left_out <= 0:
        return text
    return f"{text[:_MOST_SHOWN_FIRST]} … {left_out} more characters … {text[-_MOST_SHOWN_LAST:]}"
