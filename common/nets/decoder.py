"""The semantic decoder of 3DC-SC: the linear estimate, refined by a mirrored convolutional network."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from semcast.common.nets.blocks import Stage, Upsample, condition_vector, normalise_snr_db
from semcast.common.nets.linear import BlockSynthesis
from semcast.common.phy.slots import LATENT_CHANNELS


@dataclass(frozen=True)
class DecoderFeatures:
    """What the confidence branch is fed with, all before their resolution is raised.

    Attributes:
        received: ``(B, C, h, w)`` the received latent with its link planes.
        at16: ``(B, C16, h, w)`` features of the first stage.
        at8: ``(B, C8, 2h, 2w)``.
        at4: ``(B, C4, 4h, 4w)``.
    """

    received: Tensor
    at16: Tensor
    at8: Tensor
    at4: Tensor


def received_channels(channels: int, is_variable: bool) -> int:
    """Return how many planes are received: the latent, the normalised SNR, the shrink factor, the share."""
    return channels + (3 if is_variable else 2)


#: Planes that codecs of fixed rate receive.
RECEIVED_CHANNELS = received_channels(LATENT_CHANNELS, is_variable=False)


class Decoder(nn.Module):
    """Received latent to image.

    Args:
        widths: Channels at 1/4, 1/8 and 1/16 of the resolution.
        units: Residual units at the same three resolutions.
        channels: Values of the latent for each block.
        is_variable: Blocks send different numbers of values, and the decoder is told how many.
    """

    def __init__(
        self,
        widths: tuple[int, int, int],
        units: tuple[int, int, int],
        channels: int = LATENT_CHANNELS,
        is_variable: bool = False,
    ) -> None:
        super().__init__()
        quarter, eighth, sixteenth = widths
        self.linear = BlockSynthesis(channels)
        self.stem = nn.Conv2d(received_channels(channels, is_variable), sixteenth, 3, padding=1)
        self.stage16 = Stage(sixteenth, units[2])
        self.adapt_head = nn.Conv2d(sixteenth, 2 * channels, 1)
        self.up8 = Upsample(sixteenth, eighth)
        self.stage8 = Stage(eighth, units[1])
        self.up4 = Upsample(eighth, quarter)
        self.fold = nn.PixelUnshuffle(4)
        self.estimate = nn.Conv2d(48, quarter, 3, padding=1)
        self.stage4 = Stage(quarter, units[0])
        self.head = nn.Conv2d(quarter, 48, 3, padding=1)
        self.unfold = nn.PixelShuffle(4)
        for head in (self.head, self.adapt_head):
            nn.init.zeros_(head.weight)
            nn.init.zeros_(head.bias)  # type: ignore[arg-type]

    def forward(
        self, y: Tensor, snr_db: Tensor, shrink: Tensor, scale: Tensor, share: Tensor | None = None
    ) -> tuple[Tensor, DecoderFeatures]:
        """Map the received latent to ``(B, 3, 16 h, 16 w)``, not clipped, and the features of each stage.

        Args:
            y: ``(B, C, h, w)`` latent, each slot shrunk by ``shrink``.
            snr_db: ``(B, 1, h, w)`` SNR in dB at which the values of each slot arrived.
            shrink: ``(B, 1, h, w)``, ``snr / (1 + snr)``.
            scale: ``(B, 1, 1, 1)`` factor the frame was scaled back with.
            share: ``(B, 1, h, w)`` of ``share_plane``, where blocks send different numbers of values.
        """
        condition = condition_vector(snr_db.mean(dim=(1, 2, 3)))
        planes = (y, normalise_snr_db(snr_db), shrink)
        received = torch.cat(planes if share is None else (*planes, share), dim=1)
        at16 = self.stage16(self.stem(received).relu(), condition)
        estimate = self.linear(y, shrink, scale, self.adapt_head(at16.relu()))
        at8 = self.stage8(self.up8(at16.relu()).relu(), condition)
        folded = self.fold(estimate)
        at4 = self.stage4((self.up4(at8.relu()) + self.estimate(folded)).relu(), condition)
        x_hat = self.unfold(self.head(at4.relu()).float() + folded.float()) + 0.5
        return x_hat, DecoderFeatures(received, at16, at8, at4)
