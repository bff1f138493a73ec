"""The network: tensors in, tensors out; see `network` for what it computes and `weights` for its checkpoints."""

from corrsfm.model.network import CorrAdaptor, NetworkConfig, PruningOutput
from corrsfm.model.weights import load_network, read_provenance, save_network

__all__ = ["CorrAdaptor", "NetworkConfig", "PruningOutput", "load_network", "read_provenance", "save_network"]
