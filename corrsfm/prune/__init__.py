"""Putative matches → kept matches: every prune method behind one interface, numpy in and numpy out.

::

    prune/
    ├── __init__.py          the interface and `build_pruner`; imports nothing heavy
    ├── stage.py             files to files
    ├── correspondences.py   putative matches as methods see them, shared with training
    ├── robust.py            LO-RANSAC, MAGSAC++ and the errors to a model
    ├── classical.py         none, ratio, loransac, magsac
    ├── selection.py         what the network sees, and what is kept of it
    ├── learned.py           networks: owns device, batches and memory
    └── cascade.py           the ratio test where it is enough, the network elsewhere

Modules of this folder import each other downwards in the order robust < classical < selection <
learned < cascade.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

from corrsfm.config import FeatureKind, MatchTraits, PruneConfig, PruneMethod
from corrsfm.errors import CheckpointError, ConfigError
from corrsfm.prune.correspondences import make_correspondences, missing_channels, side_information
from corrsfm.types import Correspondences, PruneResult

if TYPE_CHECKING:
    from corrsfm.prune.learned import Pruner

__all__ = [
    "Pruner",
    "PrunerProtocol",
    "build_pruner",
    "checkpoint_sha256",
    "depends_on_seed",
    "make_correspondences",
    "side_information",
]


logger = logging.getLogger("corrsfm")

SIFT_MAX_RATIO = 0.8
NO_MAX_RATIO = 1.0
_WITHOUT_RATIOS = "use --method none, which keeps them for verification, or --method loransac"


class PrunerProtocol(Protocol):
    """What every prune method offers.

    Attributes
    ----------
    name : str
        The method.
    fingerprint : str
        Options, seed and checkpoint that results depend on besides the input. Equal fingerprints mean
        that finished work may be kept.
    """

    @property
    def name(self) -> str: ...

    @property
    def fingerprint(self) -> str: ...

    def __call__(self, pairs: Sequence[Correspondences]) -> list[PruneResult]:
        """Prune pairs of any sizes.

        Parameters
        ----------
        pairs : sequence of Correspondences
            Empty pairs and coordinates that are not finite are allowed.

        Returns
        -------
        list of PruneResult
            One for each pair, in order; within it the order of the putative matches is kept. A pair's
            result does not depend on the other pairs.
        """
        ...


def build_pruner(
    config: PruneConfig,
    *,
    traits: MatchTraits | None = None,
    device: str = "auto",
    seed: int = 0,
    threads: int = 0,
) -> PrunerProtocol:
    """The prune method that a config asks for.

    Parameters
    ----------
    config : PruneConfig
    traits : MatchTraits, optional
        What the matches to prune carry; taken for SIFT's, and not compared with the network, if not given.
    device : str
        Device of the network: auto, cpu, cuda or cuda:N.
    seed : int
        Seed of the robust estimators.
    threads : int
        Threads of the robust estimators; 0 for all cores.

    Returns
    -------
    PrunerProtocol

    Raises
    ------
    CheckpointError
        If a network is needed and its checkpoint cannot be used, or reads what the matches lack.
    ConfigError
        If the method needs the ratios of descriptor distances and the matches have none; if it needs weights
        that do not come with the package.
    """
    from corrsfm.prune.classical import EstimatorPruner, KeepAll, RatioPruner

    if config.method in (PruneMethod.RATIO, PruneMethod.CASCADE) and traits and not traits.has_ratios:
        raise ConfigError(
            f"--method {config.method}: these matches have no ratio of descriptor distances; "
            f"{_WITHOUT_RATIOS}"
        )

    max_ratio = config.max_ratio
    if max_ratio is None:
        is_sift = traits is None or traits.features == FeatureKind.SIFT
        max_ratio = SIFT_MAX_RATIO if is_sift else NO_MAX_RATIO
    if config.method is PruneMethod.NONE:
        return KeepAll()
    if config.method is PruneMethod.RATIO:
        return RatioPruner(max_ratio)
    if config.method.architecture is not None:
        network = _load_network_pruner(config, traits, device, threads)
        if config.method is not PruneMethod.CASCADE:
            return network
        from corrsfm.prune.cascade import CascadePruner

        return CascadePruner(network, network_fingerprint=network.fingerprint, max_ratio=max_ratio)
    return EstimatorPruner(
        str(config.method),
        max_ratio=max_ratio,
        max_error_px=config.max_error_px,
        seed=seed,
        threads=threads,
    )


def depends_on_seed(config: PruneConfig) -> bool:
    """Whether what a config's method keeps depends on the seed: only robust estimators draw at random."""
    return config.method in (PruneMethod.LORANSAC, PruneMethod.MAGSAC)


def checkpoint_sha256(config: PruneConfig) -> str | None:
    """SHA-256 of the checkpoint that a config's method uses; None if it uses none.

    Raises
    ------
    CheckpointError
        If there is no such checkpoint.
    ConfigError
        If no weights of its network come with the package, and the config names none.
    """
    if config.method.architecture is None:
        return None
    from corrsfm.model import weights

    _require_weights(config)
    return weights.checkpoint_sha256(config.model, config.method.architecture)


def _require_weights(config: PruneConfig) -> None:
    """Check that a config names weights where none come with the package."""
    if config.model is None and config.method.bundled is None:
        raise ConfigError(
            f"--method {config.method}: no weights of this network come with corrsfm; give a checkpoint, "
            f"published or trained with `corrsfm train`, by --model FILE ({config.method}:FILE in a list of "
            "methods)"
        )


def _load_network_pruner(
    config: PruneConfig, traits: MatchTraits | None, device: str, threads: int
) -> Pruner:
    # Imported late because it loads torch.
    from corrsfm.model import weights
    from corrsfm.prune.learned import Pruner

    _require_weights(config)
    assert config.method.architecture is not None
    pruner = Pruner.load(
        config.model,
        config.method.architecture,
        device=device,
        operating_point=config.operating_point,
        max_candidates=config.max_candidates,
        max_batch_matches=config.max_batch_matches,
        precision=config.precision,
        threads=threads,
    )
    if traits is None:
        return pruner
    name = config.model or config.method.bundled
    missing = missing_channels(
        pruner.side_channels, has_shapes=traits.has_shapes, has_ratios=traits.has_ratios
    )
    if missing:
        advice = _WITHOUT_RATIOS
        if traits.has_ratios:
            fitting = [
                row.name
                for row in weights.REGISTRY.values()
                if row.architecture == config.method.architecture
                and not missing_channels(row.config.side_channels, has_shapes=False, has_ratios=True)
            ]
            advice = "use --method loransac"
            if fitting:
                advice += f", or --model {' or '.join(fitting)}"
        raise CheckpointError(
            f"{name}: this network reads {missing}, which {traits.features} features and their matches here "
            f"lack; {advice}"
        )
    if pruner.trained_on != traits.features:
        logger.warning(
            "%s: this network was trained on matches of %s, these are of %s; compare with --method loransac",
            name,
            pruner.trained_on,
            traits.features,
        )
    return pruner


def __getattr__(name: str) -> Any:
    """`Pruner`, imported on first use because torch takes seconds to load."""
    if name == "Pruner":
        from corrsfm.prune.learned import Pruner

        return Pruner
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
