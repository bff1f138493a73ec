"""Putative matches: nearest neighbours of descriptors, or LightGlue.

::

    matches/
    ├── stage.py        files to files
    ├── nearest.py      nearest neighbours
    └── lightglue.py    LightGlue
"""

from __future__ import annotations

from collections.abc import Callable

from corrsfm.config import FeatureKind, Matcher, MatchesConfig
from corrsfm.types import Features, Matches

__all__ = ["create_matcher"]


def create_matcher(
    config: MatchesConfig, load: Callable[[str], Features], kind: FeatureKind, *, device: str = "cpu"
) -> Callable[[str, str], Matches]:
    """A function of the names of two photos that matches them; threads may share it.

    Parameters
    ----------
    config : MatchesConfig
    load : callable
        Photo → its features.
    kind : FeatureKind
        What they are.
    device : str
        A torch device.

    Raises
    ------
    DependencyError
        If the matcher is not installed.
    """
    # Imported late because they load torch.
    if config.matcher is Matcher.LIGHTGLUE:
        from corrsfm.matches.lightglue import LightGlueMatcher

        return LightGlueMatcher(load, kind, device=device).match
    from corrsfm.matches import nearest

    return nearest.Matcher(
        lambda name: load(name).descriptors, device=device, block_size=config.block_size
    ).match
