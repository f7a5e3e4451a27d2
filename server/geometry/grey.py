"""Grey images, which everything that looks for points works on."""

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]


def to_grey(image: NDArray[np.uint8]) -> Grey:
    """Return the ``(H, W)`` uint8 grey image of an ``(H, W, 3)`` RGB image."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
