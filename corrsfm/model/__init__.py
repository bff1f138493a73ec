"""The network: tensors in, tensors out; see `network` for what it computes and `weights` for its checkpoints."""

from corrsfm.model.network import CorrAdaptor, NetworkConfig, PruningOutput

__all__ = ["CorrAdaptor", "NetworkConfig", "PruningOutput"]
