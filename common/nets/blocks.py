"""Building blocks of the 3DC-SC networks: channel attention, residual units, resampling.

There is no batch normalisation: with residual branches that start at zero training is stable without it, and
running statistics would differ between a 128-pixel crop and a whole frame.
"""

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu

#: Values a network is told besides features: the normalised SNR.
NUM_CONDITIONS = 1
#: Slope of the hidden activation of residual units below zero.
HIDDEN_SLOPE = 0.1


def normalise_snr_db(snr_db: Tensor) -> Tensor:
    """Map the useful range of SNR, about -20..30 dB, to about -2.5..2.5."""
    return (snr_db.clamp(-20.0, 30.0) - 6.0) / 10.0


def condition_vector(snr_db: Tensor) -> Tensor:
    """Return what the network is told about the link, ``(B, 1)``, of the SNR ``(B,)`` in dB."""
    return normalise_snr_db(snr_db)[:, None]


class ChannelAttention(nn.Module):
    """Squeeze-and-excitation over the global mean and the link state; starts as the identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        hidden = max(8, channels // 4)
        self.squeeze = nn.Linear(channels + NUM_CONDITIONS, hidden)
        self.excite = nn.Linear(hidden, channels)
        nn.init.zeros_(self.excite.weight)
        nn.init.zeros_(self.excite.bias)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """Scale each channel of ``(B, C, H, W)`` by a factor in (0, 2)."""
        pooled = torch.cat((x.mean(dim=(2, 3)), condition.to(x.dtype)), dim=1)
        gate = 2.0 * torch.sigmoid(self.excite(torch.relu(self.squeeze(pooled))))
        return x * gate.to(x.dtype)[:, :, None, None]


class ResidualUnit(nn.Module):
    """conv-leaky ReLU-conv on a skip connection whose last layer starts at zero.

    With a plain ReLU most of the hidden units fell silent within some thousand steps, for good.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)
        nn.init.zeros_(self.conv2.weight)
        nn.init.zeros_(self.conv2.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        """Refine ``(B, C, H, W)``."""
        refined: Tensor = x + self.conv2(leaky_relu(self.conv1(x), HIDDEN_SLOPE))
        return refined


class Stage(nn.Module):
    """Encoding or decoding module of the paper: channel attention, then residual units at one resolution."""

    def __init__(self, channels: int, num_units: int) -> None:
        super().__init__()
        self.attention = ChannelAttention(channels)
        self.units = nn.ModuleList(ResidualUnit(channels) for _ in range(num_units))

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """Refine ``(B, C, H, W)`` under a ``(B, 1)`` link state."""
        x = self.attention(x, condition)
        for unit in self.units:
            x = unit(x)
        return x


class Upsample(nn.Module):
    """Double the resolution: 1x1 convolution and pixel shuffle (no chessboard overlap, fast on a CPU)."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels_in, 4 * channels_out, 1)
        self.shuffle = nn.PixelShuffle(2)

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, C, H, W)`` to ``(B, C', 2H, 2W)``."""
        doubled: Tensor = self.shuffle(self.conv(x))
        return doubled
