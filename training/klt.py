"""Starting weights: the best linear transceiver of the training images."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from semcast.common.errors import ConfigError
from semcast.common.nets.decoder import Decoder
from semcast.common.nets.encoder import Encoder
from semcast.common.nets.linear import BlockAnalysis, BlockSynthesis
from semcast.common.nets.transceiver import Transceiver
from semcast.common.nets.vit import VitDecoder, VitEncoder
from semcast.common.phy.slots import BLOCK_PX, BLOCK_VALUES, LATENT_CHANNELS

#: Rms of the latent, against which the carrier (see ``modulation``) has its amplitude.
_LATENT_RMS = 0.9
#: Where a network has no Wiener filter of its own, the one it starts with suits this SNR.
_START_SNR_DB = 5.0

Array = NDArray[np.float64]


def block_statistics(images: list[NDArray[np.uint8]]) -> tuple[Array, Array]:
    """Return mean ``(768,)`` and covariance ``(768, 768)`` of all 16x16 RGB blocks of half-size images.

    Values are in [-0.5, 0.5]; a block is ordered like ``torch.nn.PixelUnshuffle(16)``: channel, row, column.

    Raises:
        ValueError: No image has a whole block.
    """
    total = np.zeros(BLOCK_VALUES)
    products = np.zeros((total.size, total.size))
    count = 0
    for image in images:
        half = image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2].astype(np.float32)
        half = (half[::2, ::2] + half[1::2, ::2] + half[::2, 1::2] + half[1::2, 1::2]) / 4.0 / 255.0 - 0.5
        rows, columns = half.shape[0] // BLOCK_PX, half.shape[1] // BLOCK_PX
        cut = half[: rows * BLOCK_PX, : columns * BLOCK_PX]
        blocks = cut.reshape(rows, BLOCK_PX, columns, BLOCK_PX, 3).transpose(0, 2, 4, 1, 3)
        flat = blocks.reshape(-1, total.size)
        total += flat.sum(axis=0)
        products += flat.T @ flat
        count += len(flat)
    if count == 0:
        raise ValueError("images must hold at least one whole 16x16 block at half size, got none")
    mean = total / count
    return mean, products / count - np.outer(mean, mean)


@dataclass(frozen=True)
class LinearLink:
    """The best linear transceiver of 16x16 blocks for analog symbols, in float64.

    Attributes:
        mean: ``(768,)`` of all blocks.
        analysis: ``(K, 768)``: a block around the mean to coefficients, of variance ``power``.
        power: ``(K,)``, 1 on average.
        mix: ``(94, K)``, orthogonal columns: coefficients to a latent of the rms ``_LATENT_RMS``.
        unmix: ``(K, 94)``: back.
        synthesis: ``(768, K)``: coefficients to a block around the mean.
    """

    mean: Array
    analysis: Array
    power: Array
    mix: Array
    unmix: Array
    synthesis: Array

    def wiener(self, snr_db: float) -> Array:
        """Return the ``(K,)`` gains that suit one SNR; they also undo the equaliser's shrinking."""
        snr = 10.0 ** (snr_db / 10.0)
        noise = self.power.size / LATENT_CHANNELS / snr
        return np.asarray(self.power / (self.power + noise) * (1.0 + snr) / snr)


def linear_link(
    images: list[NDArray[np.uint8]], num_coefficients: int, generator: torch.Generator | None
) -> LinearLink:
    """Return the linear transceiver of these images that sends so many coefficients of each block.

    Args:
        images: ``(H, W, 3)`` uint8.
        num_coefficients: At most 94 where they are mixed.
        generator: Draws the orthogonal mixing; None: coefficients stay apart, the largest first.
    """
    mean, covariance = block_statistics(images)
    variances, vectors = np.linalg.eigh(covariance)
    variances = np.maximum(variances[::-1][:num_coefficients], 1e-9)
    basis = vectors[:, ::-1][:, :num_coefficients].T
    power = np.sqrt(variances) / np.sqrt(variances).mean()
    gain = np.sqrt(power / variances)
    if generator is None:
        mixing, scale = np.eye(num_coefficients), _LATENT_RMS
    else:
        normal = torch.randn(LATENT_CHANNELS, LATENT_CHANNELS, generator=generator)
        mixing = torch.linalg.qr(normal)[0].numpy()[:, :num_coefficients]
        scale = _LATENT_RMS * math.sqrt(LATENT_CHANNELS / num_coefficients)
    return LinearLink(
        mean, gain[:, None] * basis, power, scale * mixing, mixing.T / scale, (basis / gain[:, None]).T
    )


def start_from_klt(model: Transceiver, images: list[NDArray[np.uint8]], generator: torch.Generator) -> None:
    """Set the linear layers of encoder and decoder to the transform of these images, in place.

    Args:
        model: A transceiver with a linear way from pixels to latent and back: 3dcsc, vit or mae.
        images: Training images, ``(H, W, 3)`` uint8.
        generator: Draws the orthogonal mixing.

    Raises:
        ConfigError: The transceiver has no linear way.
    """
    encoder, decoder = model.encoder, model.decoder
    with torch.no_grad():
        if isinstance(encoder, Encoder) and isinstance(decoder, Decoder):
            mixed = None if model.is_variable else generator
            _start_linear(encoder.linear, decoder.linear, linear_link(images, model.channels, mixed))
        elif isinstance(encoder, VitEncoder) and isinstance(decoder, VitDecoder):
            _start_vit(encoder, decoder, linear_link(images, LATENT_CHANNELS, generator))
        else:
            raise ConfigError(
                "start must be 'random' for an architecture that is not linear anywhere, got 'klt'"
            )


def _set(weight: torch.Tensor | None, values: Array) -> None:
    assert weight is not None
    weight.copy_(torch.from_numpy(values).reshape(weight.shape))


def _bias(layer: nn.Conv2d | nn.ConvTranspose2d) -> torch.Tensor:
    assert layer.bias is not None
    return layer.bias


def _start_linear(analysis: BlockAnalysis, synthesis: BlockSynthesis, link: LinearLink) -> None:
    _set(analysis.transform.weight, link.analysis)
    _set(analysis.transform.bias, -link.analysis @ link.mean)
    _set(analysis.mix.weight, link.mix)
    _set(synthesis.unmix.weight, link.unmix)
    _set(synthesis.unmix.bias, np.zeros(link.power.size))
    _set(synthesis.log_power, np.log(link.power))
    _set(synthesis.transform.weight, link.synthesis)
    _set(synthesis.transform.bias, link.mean)


def _start_vit(encoder: VitEncoder, decoder: VitDecoder, link: LinearLink) -> None:
    """The first values of a token are coefficients; the others start at random and are not read yet."""
    count = link.power.size
    _set(encoder.stem.weight[:count], link.analysis)
    _set(_bias(encoder.stem)[:count], -link.analysis @ link.mean)
    encoder.head.weight.zero_()
    _bias(encoder.head).zero_()
    _set(encoder.head.weight[:, :count], link.mix)
    decoder.stem.weight[:count].zero_()
    _bias(decoder.stem)[:count].zero_()
    _set(decoder.stem.weight[:count, :LATENT_CHANNELS], link.unmix)
    decoder.head.weight.zero_()
    _set(decoder.head.weight[:, :count], link.synthesis * link.wiener(_START_SNR_DB))
    _set(_bias(decoder.head), link.mean)
