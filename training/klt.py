"""Starting weights: the best linear transceiver of the training images."""

import numpy as np
import torch
from numpy.typing import NDArray

from semcast.common.errors import ConfigError
from semcast.common.nets.linear import BlockAnalysis, BlockSynthesis
from semcast.common.nets.transceiver import Transceiver
from semcast.common.phy.slots import BLOCK_PX, LATENT_CHANNELS

#: Rms of the latent, against which the carrier (see ``modulation``) has its amplitude.
_LATENT_RMS = 0.9


def block_statistics(images: list[NDArray[np.uint8]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean ``(768,)`` and covariance ``(768, 768)`` of all 16x16 RGB blocks of half-size images.

    Values are in [-0.5, 0.5]; a block is ordered like ``torch.nn.PixelUnshuffle(16)``: channel, row, column.

    Raises:
        ValueError: No image has a whole block.
    """
    total = np.zeros(3 * BLOCK_PX**2)
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


def start_from_klt(model: Transceiver, images: list[NDArray[np.uint8]], generator: torch.Generator) -> None:
    """Set the linear layers of encoder and decoder to the transform of these images, in place.

    Args:
        model: A transceiver whose encoder and decoder have a linear heart.
        images: Training images, ``(H, W, 3)`` uint8.
        generator: Draws the orthogonal mixing.

    Raises:
        ConfigError: The transceiver has no linear heart.
    """
    heart_in, heart_out = getattr(model.encoder, "linear", None), getattr(model.decoder, "linear", None)
    if not isinstance(heart_in, BlockAnalysis) or not isinstance(heart_out, BlockSynthesis):
        raise ConfigError("start must be 'random' for an architecture without a linear heart, got 'klt'")
    mean, covariance = block_statistics(images)
    variances, vectors = np.linalg.eigh(covariance)
    variances = np.maximum(variances[::-1][:LATENT_CHANNELS], 1e-9)
    basis = vectors[:, ::-1][:, :LATENT_CHANNELS].T  # (94, 768)
    power = np.sqrt(variances) / np.sqrt(variances).mean()
    gain = np.sqrt(power / variances)
    mixing = torch.linalg.qr(torch.randn(LATENT_CHANNELS, LATENT_CHANNELS, generator=generator))[0].numpy()
    analysis = gain[:, None] * basis
    synthesis = (basis / gain[:, None]).T  # (768, 94)
    start = {
        heart_in.transform.weight: analysis[:, :, None, None],
        heart_in.transform.bias: -analysis @ mean,
        heart_in.mix.weight: _LATENT_RMS * mixing[:, :, None, None],
        heart_out.unmix.weight: mixing.T[:, :, None, None] / _LATENT_RMS,
        heart_out.unmix.bias: np.zeros(LATENT_CHANNELS),
        heart_out.log_power: np.log(power),
        heart_out.transform.weight: synthesis[:, :, None, None],
        heart_out.transform.bias: mean,
    }
    with torch.no_grad():
        for weight, values in start.items():
            if weight is not None:
                weight.copy_(torch.from_numpy(values))
