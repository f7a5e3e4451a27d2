"""An image as dense depth is sought in it: small, grey, and with the noise its confidence stands for."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics

Array = NDArray[np.float64]

#: Pixels of a view at most: the time a depth map takes goes with them.
MAX_PIXELS = 60_000
#: Noise of an image without confidence, grey levels: that of a camera.
CLEAN_SIGMA = 3.0
#: The pixel target is ``1 - tanh(30 |error|)``, error in shares of white (paper, ``training/losses.py``).
_GREY_LEVELS_PER_ATANH = 255.0 / 30.0
#: Standard deviation over mean absolute value, of a Gaussian.
_SD_PER_MEAN = 1.2533
_LEAST_CONFIDENCE = 0.02


@dataclass(frozen=True)
class View:
    """A keyframe's image, made small.

    Attributes:
        frame_id: Of the keyframe.
        grey: ``(H, W)`` float32 grey levels.
        sigma: ``(H, W)`` float32, standard deviation of its error in grey levels.
        rgb: ``(H, W, 3)`` uint8.
        K: ``(3, 3)`` pixels of the small image.
    """

    frame_id: int
    grey: NDArray[np.float32]
    sigma: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    K: Array

    @property
    def shape_hw(self) -> tuple[int, int]:
        """Height and width."""
        return self.grey.shape[0], self.grey.shape[1]


def view_of(
    frame_id: int,
    image: NDArray[np.uint8],
    confidence: NDArray[np.float32] | None,
    camera: Intrinsics,
    max_pixels: int = MAX_PIXELS,
) -> View:
    """Make a view of a received image.

    Args:
        frame_id: Of the frame.
        image: ``(H, W, 3)`` uint8 RGB without distortion.
        confidence: ``(H, W)`` in [0, 1], the codec's pixel target, or None for a clean image.
        camera: Of the image.
        max_pixels: The view has about so many at most.
    """
    height, width = image.shape[:2]
    share = min(1.0, float(np.sqrt(max_pixels / (height * width))))
    size_wh = (max(1, round(width * share)), max(1, round(height * share)))
    rgb = np.asarray(cv2.resize(image, size_wh, interpolation=cv2.INTER_AREA), np.uint8)
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    sigma = np.full(grey.shape, CLEAN_SIGMA, np.float32)
    if confidence is not None:
        small = np.asarray(cv2.resize(confidence, size_wh, interpolation=cv2.INTER_AREA), np.float32)
        sigma = np.hypot(sigma, error_sd(small)).astype(np.float32)
    x_share, y_share = size_wh[0] / width, size_wh[1] / height
    K = np.array(
        [
            [camera.fx * x_share, 0.0, (camera.cx + 0.5) * x_share - 0.5],
            [0.0, camera.fy * y_share, (camera.cy + 0.5) * y_share - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )
    return View(frame_id, grey, sigma, rgb, K)


def error_sd(confidence: NDArray[np.float32]) -> NDArray[np.float32]:
    """Standard deviation of a pixel's error in grey levels that a confidence stands for."""
    doubt = 1.0 - np.clip(confidence, _LEAST_CONFIDENCE, 1.0)
    return np.asarray(_SD_PER_MEAN * _GREY_LEVELS_PER_ATANH * np.arctanh(doubt), np.float32)
