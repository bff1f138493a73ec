"""From the name of a rival and its size to the network."""

from __future__ import annotations

import inspect
from dataclasses import dataclass

from corrsfm.errors import ConfigError
from corrsfm.model.rivals.clnet import CLNet
from corrsfm.model.rivals.convmatch import ConvMatch
from corrsfm.model.rivals.inputs import Rival
from corrsfm.model.rivals.lmcnet import LMCNet
from corrsfm.model.rivals.mgnet import MGNet
from corrsfm.model.rivals.ms2dgnet import MS2DGNet
from corrsfm.model.rivals.ncmnet import NCMNet
from corrsfm.model.rivals.oanet import OANet
from corrsfm.model.rivals.pgfnet import PGFNet
from corrsfm.model.rivals.pointcn import PointCN
from corrsfm.model.rivals.umatch import UMatch

__all__ = ["ARCHITECTURES", "RivalConfig", "build_rival"]

ARCHITECTURES: dict[str, type[Rival]] = {
    "pointcn": PointCN,
    "oanet": OANet,
    "lmcnet": LMCNet,
    "ms2dgnet": MS2DGNet,
    "clnet": CLNet,
    "pgfnet": PGFNet,
    "convmatch": ConvMatch,
    "ncmnet": NCMNet,
    "mgnet": MGNet,
    "umatch": UMatch,
}
"""Rival networks by name."""

# Widths have to divide evenly into heads, groups and squeezed layers.
WIDTH_STEP = {"ms2dgnet": 2, "pgfnet": 2, "ncmnet": 4, "umatch": 4, "convmatch": 32}


@dataclass(frozen=True, kw_only=True)
class RivalConfig:
    """Architecture and size of a rival; the defaults are the published network."""

    architecture: str
    """One of `ARCHITECTURES`."""
    channels: int = 128
    """Width of its features."""
    clusters: int | None = None
    """Clusters of its order-aware filters, where it has them; None for the published number."""
    side_channels: int = 0
    """Columns of side information beside the coordinates."""

    def __post_init__(self) -> None:
        if self.architecture not in ARCHITECTURES:
            raise ConfigError(
                f"architecture is {self.architecture!r}, expected one of {', '.join(ARCHITECTURES)}"
            )
        problems = []
        step = WIDTH_STEP.get(self.architecture, 1)
        if self.channels < 1 or self.channels % step:
            problems.append(f"channels is {self.channels}, expected a positive multiple of {step}")
        if self.clusters is not None:
            if "clusters" not in inspect.signature(ARCHITECTURES[self.architecture]).parameters:
                problems.append(f"clusters is {self.clusters}, but this network has none")
            elif self.clusters < 1:
                problems.append(f"clusters is {self.clusters}, expected at least 1")
        if self.side_channels < 0:
            problems.append(f"side_channels is {self.side_channels}, expected at least 0")
        if problems:
            raise ConfigError(f"{self.architecture}: " + "; ".join(problems))


def build_rival(config: RivalConfig) -> Rival:
    """The network that a configuration describes, with fresh weights; it keeps it as ``config``."""
    sizes = {"channels": config.channels, "side_channels": config.side_channels}
    if config.clusters is not None:
        sizes["clusters"] = config.clusters
    network = ARCHITECTURES[config.architecture](**sizes)
    network.config = config
    return network
