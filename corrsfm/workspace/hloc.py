"""What hloc's files share: its pixel convention and its keys, for export, import and old workspaces."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from corrsfm.errors import InputError
from corrsfm.types import Pair

__all__ = ["HALF_PIXEL", "check_hloc_keys", "pair_group"]

HALF_PIXEL = np.float32(0.5)
"""hloc's keypoints have the centre of the first pixel at (0, 0)."""


def pair_group(pair: Pair) -> str:
    """The HDF5 group of a pair: ``name0/name1`` with slashes inside a name as dashes."""
    return "/".join(name.replace("/", "-") for name in pair)


def check_hloc_keys(names: Iterable[str]) -> None:
    """Refuse names that hloc's layout cannot tell apart.

    Raises
    ------
    InputError
        Naming the two photos.
    """
    seen: dict[str, str] = {}
    for name in names:
        key = name.replace("/", "-")
        if key in seen:
            raise InputError(
                f"the photos '{seen[key]}' and '{name}' would share the key '{key}' in hloc's match files; "
                "rename one"
            )
        seen[key] = name
