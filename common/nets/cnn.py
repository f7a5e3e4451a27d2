"""The plain convolutional baseline: stride-2 convolutions with PReLU, no attention, no linear transform."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from semcast.common.nets.blocks import NUM_CONDITIONS, condition_vector, normalise_snr_db
from semcast.common.nets.confidence import ConfidenceBranch
from semcast.common.nets.decoder import RECEIVED_CHANNELS, DecoderFeatures
from semcast.common.nets.transceiver import Transceiver
from semcast.common.phy.slots import LATENT_CHANNELS


@dataclass(frozen=True)
class CnnSizes:
    """Sizes of the plain convolutional transceiver.

    Attributes:
        widths: Channels at 1/2, 1/4, 1/8 and 1/16 of the resolution.
        confidence_channels: Width of the confidence branch.
    """

    widths: tuple[int, int, int, int] = (32, 64, 128, 192)
    confidence_channels: int = 32


class CnnEncoder(nn.Module):
    """Four stride-2 convolutions and one that makes the latent."""

    def __init__(self, widths: tuple[int, int, int, int]) -> None:
        super().__init__()
        inputs = (3 + NUM_CONDITIONS, *widths[:-1])
        self.layers = nn.ModuleList(
            nn.Conv2d(before, after, 5, stride=2, padding=2)
            for before, after in zip(inputs, widths, strict=True)
        )
        self.activations = nn.ModuleList(nn.PReLU(width) for width in widths)
        self.head = nn.Conv2d(widths[-1], LATENT_CHANNELS, 5, padding=2)

    def forward(self, x: Tensor, snr_db: Tensor) -> Tensor:
        """Map ``(B, 3, H, W)`` in [0, 1] to the latent ``(B, 94, H/16, W/16)`` before modulation."""
        condition = condition_vector(snr_db)[:, :, None, None].expand(-1, -1, *x.shape[2:])
        f = torch.cat((x - 0.5, condition), dim=1)
        for layer, activation in zip(self.layers, self.activations, strict=True):
            f = activation(layer(f))
        latent: Tensor = self.head(f).float()
        return latent


class CnnDecoder(nn.Module):
    """The mirror image, with transposed convolutions."""

    def __init__(self, widths: tuple[int, int, int, int]) -> None:
        super().__init__()
        half, quarter, eighth, sixteenth = widths
        self.stem = nn.Conv2d(RECEIVED_CHANNELS, sixteenth, 5, padding=2)
        steps = ((sixteenth, eighth), (eighth, quarter), (quarter, half), (half, 3))
        self.layers = nn.ModuleList(
            nn.ConvTranspose2d(before, after, 4, stride=2, padding=1) for before, after in steps
        )
        self.activations = nn.ModuleList(nn.PReLU(width) for width in (sixteenth, eighth, quarter, half))

    def forward(
        self, y: Tensor, snr_db: Tensor, shrink: Tensor, scale: Tensor
    ) -> tuple[Tensor, DecoderFeatures]:
        """Map the received latent to ``(B, 3, 16 h, 16 w)`` and the features at 1/16, 1/8 and 1/4."""
        received = torch.cat((y, normalise_snr_db(snr_db), shrink), dim=1)
        f = self.activations[0](self.stem(received))
        stages = [f]
        for layer, activation in zip(self.layers[:3], self.activations[1:], strict=True):
            f = activation(layer(f))
            stages.append(f)
        x_hat = self.layers[3](f).float() + 0.5
        return x_hat, DecoderFeatures(received, *stages[:3])


def build_cnn(sizes: CnnSizes) -> Transceiver:
    """Build an untrained plain convolutional transceiver."""
    _, quarter, eighth, sixteenth = sizes.widths
    branch = ConfidenceBranch((quarter, eighth, sixteenth), sizes.confidence_channels)
    return Transceiver(CnnEncoder(sizes.widths), CnnDecoder(sizes.widths), branch)
