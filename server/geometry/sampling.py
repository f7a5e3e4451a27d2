"""Values of an image between its pixels."""

import cv2
import numpy as np
from numpy.typing import NDArray

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
