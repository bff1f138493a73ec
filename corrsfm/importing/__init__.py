"""Features and matches that other tools made, brought into a workspace.

::

    importing/
    ├── hloc.py         its HDF5 files
    ├── database.py     a COLMAP database
    └── scene.py        what came is checked against the photos, then written
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from corrsfm.types import Features, Matches, Pair

__all__ = ["Source"]


class Source(Protocol):
    """Files of another tool.

    Attributes
    ----------
    label : str
        The file, for messages and for the record.
    names : sequence of str
        Photos that it has keypoints of.
    pairs : sequence of Pair
        Pairs that it has matches of, each with the smaller name first; empty if it has none.
    """

    @property
    def label(self) -> str: ...

    @property
    def names(self) -> Sequence[str]: ...

    @property
    def pairs(self) -> Sequence[Pair]: ...

    def features(self, name: str, image_size: tuple[int, int]) -> Features:
        """Features of a photo of a size in pixels; raises `InputError` if they are not usable."""
        ...

    def matches(self, pair: Pair, num0: int, num1: int) -> Matches:
        """Matches of two photos with so many keypoints; raises `InputError` if they are not usable."""
        ...

    def remarks(self) -> list[str]:
        """What to warn of after everything was read."""
        ...
