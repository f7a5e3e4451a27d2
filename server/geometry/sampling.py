"""Values of an image at points: between its pixels, or of the nearest one."""

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Values = NDArray[np.float32]

#: OpenCV makes no picture of more than 32 766 rows, and here a set of points is a row.
_MAX_ROWS = 16_384


def bilinear(image: Values, x: Values, y: Values) -> Values:
    """Values ``(N, M)`` of an image ``(H, W)`` at pixels ``x (N, M)``, ``y (N, M)``; its border goes on."""
    if x.size == 0:
        return np.zeros(x.shape, np.float32)
    parts = [
        cv2.remap(image, x[k:end], y[k:end], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for k, end in ((k, k + _MAX_ROWS) for k in range(0, len(x), _MAX_ROWS))
    ]
    return np.asarray(parts[0] if len(parts) == 1 else np.concatenate(parts), dtype=np.float32)


def nearest_pixels(xy: Array, shape: tuple[int, ...]) -> NDArray[np.intp]:
    """Return the pixels ``(N, 2)`` nearest to points; for those outside at the border, and NaN counts as 0.

    Args:
        xy: ``(N, 2)``.
        shape: Of the image, ``(H, W)`` or ``(H, W, 3)``.
    """
    height, width = shape[:2]
    return np.clip(np.rint(np.nan_to_num(xy)), 0, (width - 1, height - 1)).astype(np.intp)


def sample_map(values: Values, keypoints_xy: Array) -> Array:
    """Value of the nearest pixel of an ``(H, W)`` map at ``(N, 2)`` pixels; NaN counts as 0."""
    x, y = nearest_pixels(keypoints_xy, values.shape).T
    return np.asarray(np.nan_to_num(values[y, x].astype(np.float64), nan=0.0, posinf=1.0, neginf=0.0))


def sample_colours(image: NDArray[np.uint8], xy: Array) -> NDArray[np.uint8]:
    """Colour ``(N, 3)`` uint8 of the pixel of an ``(H, W, 3)`` image nearest to each of ``(N, 2)`` pixels."""
    x, y = nearest_pixels(xy, image.shape).T
    return np.asarray(image[y, x])
