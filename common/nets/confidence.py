"""The confidence branch (paper Sec. IV-B): received features, fused with every decoder stage."""

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from semcast.common.nets.blocks import Upsample
from semcast.common.nets.decoder import RECEIVED_CHANNELS, DecoderFeatures


class ConfidenceBranch(nn.Module):
    """Two maps for every pixel: the paper's pixel confidence and the expected keypoint displacement.

    It also sees the decoded image, as the symbols of the paper's Eq. (4) ask; where texture is, errors are.

    Args:
        widths: Decoder channels at 1/4, 1/8 and 1/16 of the resolution.
        channels: Width of the branch.
        received: Planes that are received.
    """

    def __init__(
        self, widths: tuple[int, int, int], channels: int, received: int = RECEIVED_CHANNELS
    ) -> None:
        super().__init__()
        quarter, eighth, sixteenth = widths
        self.start = nn.Conv2d(received, channels, 3, padding=1)
        self.fuse16 = nn.Conv2d(channels + sixteenth, channels, 1)
        self.up8 = Upsample(channels, channels)
        self.fuse8 = nn.Conv2d(channels + eighth, channels, 3, padding=1)
        self.up4 = Upsample(channels, channels)
        self.fold = nn.PixelUnshuffle(4)
        self.fuse4 = nn.Conv2d(channels + quarter + 48, channels, 3, padding=1)
        self.head = nn.Conv2d(channels, 2 * 16, 3, padding=1)
        self.unfold = nn.PixelShuffle(4)

    def forward(self, features: DecoderFeatures, x_hat: Tensor) -> tuple[Tensor, Tensor]:
        """Return the confidence logit and the displacement in pixels, both ``(B, 1, H, W)``.

        Args:
            features: Stages of the decoder.
            x_hat: ``(B, 3, H, W)`` decoded image.
        """
        f = self.start(features.received).relu()
        f = self.fuse16(torch.cat((f, features.at16.to(f.dtype)), dim=1)).relu()
        f = self.up8(f)
        f = self.fuse8(torch.cat((f, features.at8.to(f.dtype)), dim=1)).relu()
        f = self.up4(f)
        folded = self.fold(x_hat - 0.5).to(f.dtype)
        f = self.fuse4(torch.cat((f, features.at4.to(f.dtype), folded), dim=1)).relu()
        maps = self.unfold(self.head(f)).float()
        return maps[:, :1], softplus(maps[:, 1:])
