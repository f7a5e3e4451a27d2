"""The masked-autoencoder baseline: the transformer of ``vit``, which learns to fill in hidden patches first.

Patches have 16 x 16 pixels, as the paper's: 50 x 50 of them in an image of 800 x 800.
"""

import torch
from torch import nn

from semcast.common.nets.confidence import ConfidenceBranch
from semcast.common.nets.transceiver import Transceiver
from semcast.common.nets.vit import VitDecoder, VitEncoder, VitSizes


class MaeDecoder(VitDecoder):
    """A ``VitDecoder`` that knows a token for patches that were not seen."""

    def __init__(self, sizes: VitSizes) -> None:
        super().__init__(sizes)
        #: Stands for a hidden patch in pre-training.
        self.mask_token = nn.Parameter(torch.zeros(sizes.dim))


def build_mae(sizes: VitSizes) -> Transceiver:
    """Build an untrained masked-autoencoder transceiver."""
    branch = ConfidenceBranch((48, 192, sizes.dim), sizes.confidence_channels)
    return Transceiver(VitEncoder(sizes), MaeDecoder(sizes), branch)
