"""The network that a run starts from."""

from __future__ import annotations

from dataclasses import replace

from corrsfm.config import from_dict, to_dict
from corrsfm.errors import ConfigError
from corrsfm.model import CorrAdaptor, NetworkConfig, Rival, RivalConfig, build_network, load_network
from corrsfm.prune.correspondences import NEUTRAL_CHANNELS, SIDE_LAYOUTS
from corrsfm.training.checkpoint import without_side_channels
from corrsfm.training.config import TrainRecipe

__all__ = ["initial_network", "network_config"]


def network_config(recipe: TrainRecipe) -> NetworkConfig | RivalConfig:
    """Read the architecture that a recipe asks for: CorrAdaptor, unless it names an ``architecture``.

    Raises
    ------
    ConfigError
        If it cannot be built, or has side channels that pruning does not compute.
    """
    described: type[NetworkConfig] | type[RivalConfig]
    described = RivalConfig if "architecture" in recipe.network else NetworkConfig
    config = from_dict(described, recipe.network, "network")
    if config.side_channels not in SIDE_LAYOUTS:
        raise ConfigError(
            f"network: side_channels is {config.side_channels}, expected one of {list(SIDE_LAYOUTS)}"
        )
    return config


def initial_network(recipe: TrainRecipe) -> CorrAdaptor | Rival:
    """Build the network that a run starts from: fresh, or that of the recipe's ``initial`` checkpoint.

    It reads what the recipe says; an initial checkpoint may have read another kind of matches, and a
    CorrAdaptor more side channels.

    Raises
    ------
    CheckpointError
        If that checkpoint cannot be read.
    ConfigError
        If the recipe's ``network`` table describes another network than the checkpoint holds; without a table
        the checkpoint decides.
    """
    config = network_config(recipe)
    network: CorrAdaptor | Rival
    if recipe.train.initial:
        network = load_network(recipe.train.initial)
        if recipe.network:
            network = _as_described(network, config, recipe.train.initial)
    else:
        network = build_network(config)
    network.usage = replace(network.usage, input=recipe.train.input, features=recipe.train.features)
    return network


def _as_described(
    network: CorrAdaptor | Rival, config: NetworkConfig | RivalConfig, name: str
) -> CorrAdaptor | Rival:
    """A network as a configuration describes it, without side channels that it does not mention."""
    assert network.config is not None
    narrower = config.side_channels < network.side_channels
    same_else = config == replace(network.config, side_channels=config.side_channels)
    if isinstance(network, CorrAdaptor) and narrower and same_else:
        return without_side_channels(network, config.side_channels, NEUTRAL_CHANNELS)
    if network.config != config:
        raise ConfigError(
            f"network: differs from that of the initial checkpoint {name}, which is "
            f"{to_dict(network.config)}; leave the table out to continue with that network"
        )
    return network
