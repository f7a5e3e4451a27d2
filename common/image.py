"""Images as numpy arrays: their PSNR, and other sizes."""

import cv2
import numpy as np
from numpy.typing import NDArray


def psnr_db(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    """Return the peak signal-to-noise ratio of two uint8 images of the same shape, over all values.

    Equal images give 100, so that means stay finite.

    Raises:
        ValueError: Shape or dtype differ.

    Example:
        >>> psnr_db(np.zeros((2, 2), np.uint8), np.full((2, 2), 255, np.uint8))
        0.0
    """
    if a.dtype != np.uint8 or b.dtype != np.uint8:
        raise ValueError(f"images must be uint8, got {a.dtype} and {b.dtype}")
    if a.shape != b.shape or a.size == 0:
        raise ValueError(f"images must have the same shape, got {a.shape} and {b.shape}")
    mse = float(cv2.norm(a, b, cv2.NORM_L2SQR)) / a.size
    return psnr_of_mse(mse, 255.0)


def psnr_of_mse(mse: float, peak: float = 1.0) -> float:
    """Return the PSNR in dB of a mean squared error, at most 100, so that means stay finite.

    Args:
        mse: Over all values; NaN comes through.
        peak: Difference of white and black.
    """
    return 100.0 if mse == 0.0 else min(float(10.0 * np.log10(peak**2 / mse)), 100.0)


def scaled_wh(width: int, height: int, factor: float) -> tuple[int, int]:
    """Return a size times a factor, in whole pixels: one at least."""
    return max(1, round(width * factor)), max(1, round(height * factor))


def resized(image: NDArray[np.uint8], size_wh: tuple[int, int]) -> NDArray[np.uint8]:
    """Resize by area averaging (bilinear where it grows); the same object when the size is right."""
    height, width = image.shape[:2]
    if (width, height) == size_wh:
        return image
    shrinks = size_wh[0] <= width and size_wh[1] <= height
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size_wh, interpolation=how), dtype=np.uint8)
