"""The networks that CorrAdaptor is compared with, one file each over shared layers."""

from corrsfm.model.rivals.build import ARCHITECTURES, RivalConfig, build_rival
from corrsfm.model.rivals.inputs import Rival, RivalOutput

__all__ = ["ARCHITECTURES", "Rival", "RivalConfig", "RivalOutput", "build_rival"]
