"""The linear part of the transceiver: a block transform, mixing, and a Wiener filter at the receiver.

Optimal linear analog transmission gives coefficient i of a Karhunen-Loeve transform a power proportional to
the square root of its variance; an orthogonal mixing then spreads the coefficients so that every channel use
carries the same power (SoftCast, Jakubczak & Katabi 2011). Training starts from this solution
(``semcast.training.klt``) and the convolutional networks learn what has to be added to it. All layers stay
trainable.
"""

import math

import torch
from torch import Tensor, nn

from semcast.common.phy.slots import BLOCK_PX, BLOCK_VALUES, LATENT_CHANNELS

#: Local gains stay within a factor of about 20.
MAX_LOG_GAIN = 3.0


class BlockAnalysis(nn.Module):
    """Transform every 16x16 RGB block, scale its coefficients by local gains, mix them into the latent.

    Args:
        channels: Values of the latent for each block.
    """

    def __init__(self, channels: int = LATENT_CHANNELS) -> None:
        super().__init__()
        self.fold = nn.PixelUnshuffle(BLOCK_PX)
        self.transform = nn.Conv2d(BLOCK_VALUES, channels, 1)
        self.mix = nn.Conv2d(channels, channels, 1, bias=False)

    def forward(self, x: Tensor, log_gain: Tensor) -> Tensor:
        """Map an image ``(B, 3, H, W)`` to ``(B, C, H/16, W/16)``.

        Args:
            x: Image around zero.
            log_gain: ``(B, C, H/16, W/16)`` from the network: flat blocks may be sent louder than busy ones.
        """
        gain = torch.exp(log_gain.float().clamp(-MAX_LOG_GAIN, MAX_LOG_GAIN))
        mixed: Tensor = self.mix(self.transform(self.fold(x)) * gain)
        return mixed


class BlockSynthesis(nn.Module):
    """Unmix the received latent, weight each coefficient by its Wiener gain, and return to pixels.

    Args:
        channels: Values of the latent for each block.
    """

    def __init__(self, channels: int = LATENT_CHANNELS) -> None:
        super().__init__()
        self.unmix = nn.Conv2d(channels, channels, 1)
        self.log_power = nn.Parameter(torch.zeros(channels))
        #: Log variance of what the receiver can't undo.
        self.log_distortion = nn.Parameter(torch.tensor(math.log(0.01)))
        self.transform = nn.Conv2d(channels, BLOCK_VALUES, 1)
        self.unfold = nn.PixelShuffle(BLOCK_PX)

    def forward(self, y: Tensor, shrink: Tensor, scale: Tensor, adapt: Tensor) -> Tensor:
        """Estimate the image linearly.

        Args:
            y: ``(B, C, h, w)`` latent, each slot still shrunk by ``shrink``.
            shrink: ``(B, 1, h, w)``, ``snr / (1 + snr)``.
            scale: ``(B, 1, 1, 1)`` factor by which the frame was scaled back; it scales the noise too.
            adapt: ``(B, 2 C, h, w)`` from the network: what to add to the log prior power of each
                coefficient, and the log gain that undoes the transmitter's local one.

        Returns:
            ``(B, 3, 16 h, 16 w)``.
        """
        coefficients = self.unmix(y).float() * self.gain(shrink, scale, adapt)
        x: Tensor = self.unfold(self.transform(coefficients))
        return x

    def gain(self, shrink: Tensor, scale: Tensor, adapt: Tensor) -> Tensor:
        """Wiener gain of each coefficient, ``(B, C, h, w)``, which also undoes ``shrink``."""
        shrink = shrink.clamp_min(1e-2)
        noise = (1.0 - shrink) / shrink * scale.square()  # noise variance for unit power
        more_power, log_gain = adapt.float().chunk(2, dim=1)
        log_noise = torch.log(noise + torch.exp(self.log_distortion))
        wiener = torch.sigmoid(self.log_power.view(1, -1, 1, 1) + more_power - log_noise)
        return wiener * torch.exp(log_gain.clamp(-MAX_LOG_GAIN, MAX_LOG_GAIN)) / shrink
