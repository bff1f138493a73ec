"""Features of photos: SIFT, or those of a network.

::

    features/
    ├── stage.py        files to files
    ├── sift.py         SIFT, by OpenCV or pycolmap
    └── learned.py      ALIKED, DISK and SuperPoint
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from corrsfm.config import Extractor, FeatureKind, FeaturesConfig
from corrsfm.types import Features

__all__ = ["algorithm_of", "create_extractor", "reads_colour"]


def reads_colour(extractor: Extractor) -> bool:
    """Whether an extractor reads (H, W, 3) photos, blue first, and not (H, W) grey values."""
    return extractor.kind != FeatureKind.SIFT


def algorithm_of(config: FeaturesConfig) -> str:
    """Version of all that decides about equal features beside the options.

    Raises
    ------
    DependencyError, ConfigError, CheckpointError
        If a network or its weights are missing.
    """
    if config.extractor.kind == FeatureKind.SIFT:
        from corrsfm.features import sift

        return sift.algorithm_of(config.extractor)
    from corrsfm.features import learned

    return learned.algorithm_of(config)


def create_extractor(
    config: FeaturesConfig, device: str = "cpu"
) -> Callable[[NDArray[np.uint8], NDArray[np.bool_] | None], Features]:
    """A function ``(image, mask) → Features`` with the options bound; thread-safe.

    Parameters
    ----------
    config : FeaturesConfig
    device : str
        Device of a network.

    Raises
    ------
    DependencyError, ConfigError, CheckpointError
        If a network or its weights are missing.
    """
    if config.extractor.kind == FeatureKind.SIFT:
        from corrsfm.features import sift

        return sift.create_extractor(config)
    from corrsfm.features import learned

    return learned.create_extractor(config, device)
