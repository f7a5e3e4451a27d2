"""A transceiver as one module: encoder, modulation, decoder and confidence branch."""

from dataclasses import dataclass

from torch import Tensor, nn

from semcast.common.nets.confidence import ConfidenceBranch
from semcast.common.nets.decoder import Decoder, DecoderFeatures, received_channels
from semcast.common.nets.encoder import Encoder
from semcast.common.nets.modulation import (
    analog_symbols,
    analog_values,
    demodulate,
    effective_snr_db,
    modulate,
    rounded_symbols,
    shrink_of,
)
from semcast.common.nets.packing import blocks_arrived, pack, sent_mask, share_plane, unpack
from semcast.common.phy.allocation import MAX_VALUES
from semcast.common.phy.slots import LATENT_CHANNELS


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
    DecoderFeatures)`` fit; the baselines use the same shell. Those of variable rate take the plane of
    ``share_plane`` as well, and the methods here the ``values`` ``(B, 1, h, w)`` each block sends.
    """

    def __init__(
        self, encoder: nn.Module, decoder: nn.Module, confidence: nn.Module, is_variable: bool = False
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.decoder = decoder
        self.confidence = confidence
        self.is_variable = is_variable

    @property
    def channels(self) -> int:
        """Values of the latent for each block, sent or not."""
        return MAX_VALUES if self.is_variable else LATENT_CHANNELS

    def latent(self, x: Tensor, snr_db: Tensor, is_qam: Tensor, values: Tensor | None = None) -> Tensor:
        """Encode ``(B, 3, H, W)`` in [0, 1] to the latent ``(B, C, H/16, W/16)`` before modulation.

        Args:
            x: Image.
            snr_db: ``(B,)`` SNR in dB that is expected of the link.
            is_qam: ``(B,)`` 1 for 16-QAM, 0 for analog.
            values: Where the rate is variable.
        """
        arriving_db = effective_snr_db(snr_db, is_qam)
        told = (x, arriving_db) if values is None else (x, arriving_db, share_plane(values))
        latent: Tensor = self.encoder(*told)
        return latent

    def transmit(self, latent: Tensor, is_qam: Tensor, values: Tensor | None = None) -> Tensor:
        """Modulate: real and imaginary parts of unit-power symbols, so power 1/2 for each real value.

        Args:
            latent: Of ``latent``; of one frame where the rate is variable.
            is_qam: ``(B,)`` 1 for 16-QAM, 0 for analog.
            values: Where the rate is variable.

        Returns:
            ``(B, 94, h, w)``.
        """
        if values is None:
            return modulate(latent, is_qam)
        sent = sent_mask(values, self.channels)
        return rounded_symbols(pack(analog_symbols(latent, sent), sent), is_qam)

    def receive(
        self,
        y_rx: Tensor,
        snr_db: Tensor,
        is_qam: Tensor,
        values: Tensor | None = None,
    ) -> tuple[Tensor, DecoderFeatures]:
        """Decode equalised symbols to an image that is not yet clipped.

        Args:
            y_rx: ``(B, 94, h, w)`` real parts and imaginary parts after the MMSE equaliser.
            snr_db: ``(B, 1, h, w)`` effective SNR of each slot in dB.
            is_qam: ``(B,)`` 1 for 16-QAM, 0 for analog.
            values: Where the rate is variable; B is 1 then.
        """
        if values is None:
            y, snr_db, scale = demodulate(y_rx, snr_db, is_qam)
            decoded: tuple[Tensor, DecoderFeatures] = self.decoder(y, snr_db, shrink_of(snr_db), scale)
            return decoded
        sent = sent_mask(values, self.channels)
        y = unpack(analog_values(y_rx, snr_db, is_qam), sent)
        shrink = shrink_of(effective_snr_db(snr_db, is_qam))
        return self.receive_blocks(y, unpack(shrink.expand(-1, LATENT_CHANNELS, -1, -1), sent), values)

    def send_blocks(self, latent: Tensor, values: Tensor) -> Tensor:
        """Return analog symbols of blocks, ``(B, C, h, w)`` and 0 where nothing is sent, outside of slots.

        This and ``receive_blocks`` are the link of training: batches need not fill frames, and rounding is
        noise like the link's.
        """
        return analog_symbols(latent, sent_mask(values, self.channels))

    def receive_blocks(self, y_rx: Tensor, shrink: Tensor, values: Tensor) -> tuple[Tensor, DecoderFeatures]:
        """Decode what arrived of ``send_blocks``.

        Args:
            y_rx: ``(B, C, h, w)`` behind an MMSE equaliser.
            shrink: ``(B, C, h, w)``, ``snr / (1 + snr)`` of each value.
            values: ``(B, 1, h, w)``.
        """
        y, snr_db, of_block, scale = blocks_arrived(y_rx, shrink, sent_mask(values, self.channels))
        decoded: tuple[Tensor, DecoderFeatures] = self.decoder(
            y, snr_db, of_block, scale, share_plane(values)
        )
        return decoded

    def judge(self, features: DecoderFeatures, x_hat: Tensor) -> tuple[Tensor, Tensor]:
        """Return the confidence logit and the expected keypoint displacement in pixels, ``(B, 1, H, W)``."""
        judged: tuple[Tensor, Tensor] = self.confidence(features, x_hat)
        return judged


def build_3dcsc(sizes: Sizes) -> Transceiver:
    """Build an untrained 3DC-SC transceiver."""
    return _build(sizes, LATENT_CHANNELS, is_variable=False)


def build_variable_3dcsc(sizes: Sizes) -> Transceiver:
    """Build an untrained 3DC-SC transceiver whose blocks send different numbers of values."""
    return _build(sizes, MAX_VALUES, is_variable=True)


def _build(sizes: Sizes, channels: int, is_variable: bool) -> Transceiver:
    received = received_channels(channels, is_variable)
    return Transceiver(
        Encoder(sizes.widths, sizes.encoder_units, channels, is_variable),
        Decoder(sizes.widths, sizes.decoder_units, channels, is_variable),
        ConfidenceBranch(sizes.widths, sizes.confidence_channels, received),
        is_variable,
    )
