"""A transceiver as one module: encoder, modulation, decoder and confidence branch."""

from dataclasses import dataclass

from torch import Tensor, nn

from semcast.common.nets.confidence import ConfidenceBranch
from semcast.common.nets.decoder import Decoder, DecoderFeatures
from semcast.common.nets.encoder import Encoder
from semcast.common.nets.modulation import demodulate, effective_snr_db, modulate, shrink_of


@dataclass(frozen=True)
class Sizes:
    """Sizes of a 3DC-SC network.

    Attributes:
        widths: Channels at 1/4, 1/8 and 1/16 of the resolution.
        encoder_units: Residual units of the encoder at the same three resolutions.
        decoder_units: Residual units of the decoder.
        confidence_channels: Width of the confidence branch.
    """

    widths: tuple[int, int, int]
    encoder_units: tuple[int, int, int]
    decoder_units: tuple[int, int, int]
    confidence_channels: int = 32


class Transceiver(nn.Module):
    """Encoder and decoder with the modulation between them.

    Any encoder ``(x, snr_db) -> latent`` and decoder ``(y, snr_db, shrink, scale) -> (x_hat,
    DecoderFeatures)`` fit; the baselines use the same shell.
    """

    def __init__(self, encoder: nn.Module, decoder: nn.Module, confidence: nn.Module) -> None:
        super().__init__()
        self.encoder = encoder
        self.decoder = decoder
        self.confidence = confidence

    def latent(self, x: Tensor, snr_db: Tensor, is_qam: Tensor) -> Tensor:
        """Encode ``(B, 3, H, W)`` in [0, 1] to the latent ``(B, 94, H/16, W/16)`` before modulation.

        Args:
            x: Image.
            snr_db: ``(B,)`` SNR in dB that is expected of the link.
            is_qam: ``(B,)`` 1 for 16-QAM, 0 for analog.
        """
        latent: Tensor = self.encoder(x, effective_snr_db(snr_db, is_qam))
        return latent

    def transmit(self, latent: Tensor, is_qam: Tensor) -> Tensor:
        """Modulate: real and imaginary parts of unit-power symbols, so power 1/2 for each real value."""
        return modulate(latent, is_qam)

    def receive(self, y_rx: Tensor, snr_db: Tensor, is_qam: Tensor) -> tuple[Tensor, DecoderFeatures]:
        """Decode equalised symbols to an image that is not yet clipped.

        Args:
            y_rx: ``(B, 94, h, w)`` real parts and imaginary parts after the MMSE equaliser.
            snr_db: ``(B, 1, h, w)`` effective SNR of each slot in dB.
            is_qam: ``(B,)`` 1 for 16-QAM, 0 for analog.
        """
        y, snr_db, scale = demodulate(y_rx, snr_db, is_qam)
        decoded: tuple[Tensor, DecoderFeatures] = self.decoder(y, snr_db, shrink_of(snr_db), scale)
        return decoded

    def judge(self, features: DecoderFeatures, x_hat: Tensor) -> tuple[Tensor, Tensor]:
        """Return the confidence logit and the expected keypoint displacement in pixels, ``(B, 1, H, W)``."""
        judged: tuple[Tensor, Tensor] = self.confidence(features, x_hat)
        return judged


def build_3dcsc(sizes: Sizes) -> Transceiver:
    """Build an untrained 3DC-SC transceiver."""
    return Transceiver(
        Encoder(sizes.widths, sizes.encoder_units),
        Decoder(sizes.widths, sizes.decoder_units),
        ConfidenceBranch(sizes.widths, sizes.confidence_channels),
    )
