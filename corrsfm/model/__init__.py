"""Networks, tensors in and out: `network` is CorrAdaptor, `rivals` are others, `weights` reads files."""

from corrsfm.model.network import CorrAdaptor, NetworkConfig, PruningOutput
from corrsfm.model.weights import load_network, read_provenance, save_network

__all__ = ["CorrAdaptor", "NetworkConfig", "PruningOutput", "load_network", "read_provenance", "save_network"]
