"""The semantic encoder of 3DC-SC: channel attention and residual units over four 2x reductions."""

from torch import Tensor, nn

from semcast.common.nets.blocks import Stage, condition_vector
from semcast.common.nets.linear import BlockAnalysis
from semcast.common.phy.slots import LATENT_CHANNELS


class Encoder(nn.Module):
    """Image to latent: a locally scaled block transform plus what the network adds to it.

    The first two of the four reductions are one lossless pixel-unshuffle: convolutions at half resolution are
    bound by memory on a CPU and bring little.

    Args:
        widths: Channels at 1/4, 1/8 and 1/16 of the resolution.
        units: Residual units at the same three resolutions.
        channels: Values of the latent for each block.
        is_variable: Blocks send different numbers of values, and the encoder is told how many.
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
        self.linear = BlockAnalysis(channels)
        self.fold = nn.PixelUnshuffle(4)
        self.stem = nn.Conv2d(48, quarter, 3, padding=1)
        self.stage4 = Stage(quarter, units[0])
        self.down8 = nn.Conv2d(quarter, eighth, 3, stride=2, padding=1)
        self.stage8 = Stage(eighth, units[1])
        self.down16 = nn.Conv2d(eighth, sixteenth, 3, stride=2, padding=1)
        self.share: nn.Conv2d | None = None
        if is_variable:
            self.share = nn.Conv2d(1, sixteenth, 1)
            nn.init.zeros_(self.share.weight)
            nn.init.zeros_(self.share.bias)  # type: ignore[arg-type]
        self.stage16 = Stage(sixteenth, units[2])
        #: What is added to the linear latent, and the log gains of the linear coefficients.
        self.head = nn.Conv2d(sixteenth, 2 * channels, 1)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor, snr_db: Tensor, share: Tensor | None = None) -> Tensor:
        """Map ``(B, 3, H, W)`` in [0, 1] to the latent ``(B, C, H/16, W/16)`` before modulation.

        Args:
            x: Image, sides multiples of 16.
            snr_db: ``(B,)`` SNR in dB at which the transmitter expects its values to arrive.
            share: ``(B, 1, H/16, W/16)`` of ``share_plane``, where blocks send different numbers of values.
        """
        condition = condition_vector(snr_db)
        x = x - 0.5
        f = self.stem(self.fold(x)).relu()  # (B, C4, H/4, W/4)
        f = self.down8(self.stage4(f, condition)).relu()
        f = self.down16(self.stage8(f, condition))
        if self.share is not None:
            f = f + self.share(share)
        f = self.stage16(f.relu(), condition)
        added, log_gain = self.head(f.relu()).chunk(2, dim=1)
        latent: Tensor = self.linear(x, log_gain).float() + added.float()
        return latent
