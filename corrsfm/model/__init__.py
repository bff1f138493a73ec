"""The network, tensors in and out: `network` says what it computes, `weights` reads its checkpoints."""

from corrsfm.model.network import CorrAdaptor, NetworkConfig, PruningOutput
from corrsfm.model.weights import load_network, read_provenance, save_network

__all__ = ["CorrAdaptor", "NetworkConfig", "PruningOutput", "load_network", "read_provenance", "save_network"]
