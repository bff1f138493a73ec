"""Networks, tensors in and out.

::

    model/
    ├── network.py      CorrAdaptor, read from its layers to the whole
    ├── plain.py        the published network written down plainly, to test and time against
    ├── weights.py      checkpoints: load, save, verify
    ├── published.py    names of the published checkpoints in ours
    ├── rivals/         other networks of the literature, over shared layers
    └── checkpoints/    bundled weights with their model cards
"""

from corrsfm.model.network import CorrAdaptor, NetworkConfig, PruningOutput
from corrsfm.model.rivals import Rival, RivalConfig, RivalOutput
from corrsfm.model.weights import build_network, load_network, read_provenance, save_network

__all__ = [
    "CorrAdaptor",
    "NetworkConfig",
    "PruningOutput",
    "Rival",
    "RivalConfig",
    "RivalOutput",
    "build_network",
    "load_network",
    "read_provenance",
    "save_network",
]
