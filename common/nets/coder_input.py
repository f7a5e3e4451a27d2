"""What an encoder is given, with torch or without: the image stretched and padded, and the SNR it knows."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semcast.common.levels import Levels, levels_of
from semcast.common.phy.slots import BLOCK_PX, layout_for
from semcast.common.shapes import check_shape


class CoderInput(NamedTuple):
    """Input of an encoder.

    Attributes:
        image: ``(H', W', 3)`` uint8, stretched over all levels; sides are multiples of 16.
        shape_hw: Of the image before it was padded.
        levels: What the stretching takes to be undone.
        snr_db: Within what the encoder was trained for; its lower end where the SNR is not finite.
    """

    image: NDArray[np.uint8]
    shape_hw: tuple[int, int]
    levels: Levels
    snr_db: float


def coder_input(image: NDArray[np.uint8], snr_db: float, snr_range_db: tuple[float, float]) -> CoderInput:
    """Prepare an image for an encoder.

    Args:
        image: ``(H, W, 3)`` uint8 RGB.
        snr_db: Expected SNR.
        snr_range_db: What the encoder was trained for.

    Raises:
        ValueError: The image is not of that shape and type, or has no pixel.
    """
    sizes = check_shape(image, "H W 3", "image")
    if image.dtype != np.uint8:
        raise ValueError(f"image must be uint8, got {image.dtype}")
    shape_hw = sizes["H"], sizes["W"]
    layout_for(shape_hw)  # refuses images without a pixel
    low, high = snr_range_db
    expected_db = float(np.clip(snr_db, low, high)) if np.isfinite(snr_db) else low
    levels = levels_of(image)
    image = levels.stretch(image)
    bottom, right = -shape_hw[0] % BLOCK_PX, -shape_hw[1] % BLOCK_PX
    if bottom or right:
        image = np.pad(image, ((0, bottom), (0, right), (0, 0)), mode="edge")
    return CoderInput(np.ascontiguousarray(image), shape_hw, levels, expected_db)
