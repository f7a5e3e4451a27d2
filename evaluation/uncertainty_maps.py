"""Maps a confidence has to beat: made from the decoded image alone, all with 'larger is less certain'."""

import cv2
import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float32]

#: Side of the window over which gradients are summed.
WINDOW_PX = 7
#: Pixels that are graded: every third row and column, so no phase of a 2x or 4x upsampling is preferred.
GRADED = np.s_[1::3, 1::3]
#: Side of the blocks of block-wise rank correlations.
BLOCK_PX = 8


def pixel_label(decoded: NDArray[np.uint8], original: NDArray[np.uint8], alpha: float) -> Map:
    """Return the paper's pseudo-label ``1 - tanh(alpha |x_hat - x|)``, the error averaged over colour.

    Args:
        decoded: ``(H, W, 3)`` uint8.
        original: ``(H, W, 3)`` uint8.
        alpha: Sensitivity for images in [0, 1].
    """
    return np.asarray(1.0 - np.tanh(alpha * absolute_error(decoded, original)), dtype=np.float32)


def absolute_error(decoded: NDArray[np.uint8], original: NDArray[np.uint8]) -> Map:
    """Return ``(H, W)`` mean absolute error over colour of images scaled to [0, 1]."""
    return np.asarray(cv2.absdiff(decoded, original).astype(np.float32).mean(axis=2) / 255.0)


def gradient_energy(image: NDArray[np.uint8]) -> Map:
    """Return ``(H, W)`` windowed mean of the squared grey gradient: strong edges carry large pixel errors."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0
    squared = cv2.Sobel(grey, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(grey, cv2.CV_32F, 0, 1) ** 2
    return np.asarray(cv2.blur(squared, (WINDOW_PX, WINDOW_PX)), dtype=np.float32)


def lambda_min(image: NDArray[np.uint8]) -> Map:
    """Return ``(H, W)`` smaller eigenvalue of the structure tensor, floored above zero."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.maximum(cv2.cornerMinEigenVal(grey, WINDOW_PX, ksize=3), np.float32(1e-9))


def block_means(values: Map, side_px: int = BLOCK_PX) -> NDArray[np.float32]:
    """Return means over square blocks, flattened; incomplete blocks at the border are left out."""
    height, width = (side // side_px * side_px for side in values.shape)
    blocks = values[:height, :width].reshape(height // side_px, side_px, width // side_px, side_px)
    return np.asarray(blocks.mean(axis=(1, 3)).ravel())


def sample_at(values: Map, points_xy: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return ``(N,)`` bilinear samples of a map at ``(N, 2)`` pixels, the border repeated."""
    if len(points_xy) == 0:
        return np.zeros(0, dtype=np.float32)
    xy = np.asarray(points_xy, dtype=np.float32)
    # remap takes at most 32767 entries along an axis.
    samples = [
        cv2.remap(values, part[:, 0:1], part[:, 1:2], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for part in np.array_split(xy, -(-len(xy) // 30_000))
    ]
    return np.asarray(np.concatenate(samples)[:, 0])
