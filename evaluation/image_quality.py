"""SSIM and MS-SSIM of colour images: mean over red, green and blue, data range 1.

Wang et al. 2004 and 2003: Gaussian window of 11x11 with sigma 1.5, K1 = 0.01, K2 = 0.03, biased local
moments, only windows that lie inside the image.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

_WINDOW_PX = 11
_SIGMA_PX = 1.5
_C1 = 0.01**2
_C2 = 0.03**2
#: Exponents of the five scales, finest first.
_SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)

_Image = NDArray[np.uint8]
_Plane = NDArray[np.float64]


def _check_pair(a: _Image, b: _Image) -> None:
    if a.dtype != np.uint8 or b.dtype != np.uint8:
        raise ValueError(f"images must be uint8, got {a.dtype} and {b.dtype}")
    if a.shape != b.shape or a.ndim != 3 or a.shape[2] != 3:
        raise ValueError(f"images must have the same shape (H, W, 3), got {a.shape} and {b.shape}")


def _window_mean(x: _Plane) -> _Plane:
    blurred = cv2.GaussianBlur(x, (_WINDOW_PX, _WINDOW_PX), _SIGMA_PX)
    margin = _WINDOW_PX // 2
    return np.asarray(blurred[margin:-margin, margin:-margin])


def _similarity(x: _Plane, y: _Plane) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return ``(3,)`` means over windows of SSIM and of its contrast-structure part, per colour."""
    mean_x, mean_y = _window_mean(x), _window_mean(y)
    variance_x = _window_mean(x * x) - mean_x * mean_x
    variance_y = _window_mean(y * y) - mean_y * mean_y
    covariance = _window_mean(x * y) - mean_x * mean_y
    structure = (2.0 * covariance + _C2) / (variance_x + variance_y + _C2)
    luminance = (2.0 * mean_x * mean_y + _C1) / (mean_x**2 + mean_y**2 + _C1)
    return (luminance * structure).mean(axis=(0, 1)), structure.mean(axis=(0, 1))


def ssim(a: _Image, b: _Image) -> float | None:
    """Return the structural similarity of two ``(H, W, 3)`` uint8 images, 1 for equal ones.

    None when the smaller side is below 11 pixels, where the window doesn't fit.

    Raises:
        ValueError: Shapes differ, or an image is not uint8.
    """
    _check_pair(a, b)
    if min(a.shape[:2]) < _WINDOW_PX:
        return None
    return float(_similarity(a / 255.0, b / 255.0)[0].mean())


def ms_ssim(a: _Image, b: _Image) -> float | None:
    """Return the multi-scale structural similarity over five scales, each half the size of the one before.

    Negative similarities of a scale count as 0. None when the smaller side is below 176 pixels, where the
    window doesn't fit the coarsest scale.

    Raises:
        ValueError: See ``ssim``.
    """
    _check_pair(a, b)
    num_scales = len(_SCALE_WEIGHTS)
    if min(a.shape[:2]) < _WINDOW_PX << (num_scales - 1):
        return None
    x, y = a / 255.0, b / 255.0
    product = np.ones(3)
    for scale, weight in enumerate(_SCALE_WEIGHTS):
        whole, structure = _similarity(x, y)
        factor = whole if scale == num_scales - 1 else structure
        product *= np.maximum(factor, 0.0) ** weight
        x, y = _halve(x), _halve(y)
    return float(product.mean())


def _halve(x: _Plane) -> _Plane:
    """Return means over 2x2 pixels; an odd last row or column is left out."""
    height, width = x.shape[0] // 2 * 2, x.shape[1] // 2 * 2
    even = x[:height, :width]
    return 0.25 * (even[0::2, 0::2] + even[1::2, 0::2] + even[0::2, 1::2] + even[1::2, 1::2])
