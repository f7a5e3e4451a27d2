"""An image as dense depth is sought in it: small, grey, and with the noise its confidence stands for."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.codec import LABEL_SHARPNESS
from semcast.common.image import scaled_wh

Array = NDArray[np.float64]

#: Pixels of a view at most: the time a depth map takes goes with them.
MAX_PIXELS = 60_000
#: Noise of an image without confidence, grey levels: that of a camera.
CLEAN_SIGMA = 3.0
#: Error that confidence stands for, by the inverse of its label: that has errors in shares of white.
_GREY_LEVELS_PER_ATANH = 255.0 / LABEL_SHARPNESS
#: Standard deviation over mean absolute value, of a Gaussian.
_SD_PER_MEAN = 1.2533
_LEAST_CONFIDENCE = 0.02


@dataclass(frozen=True)
class View:
    """A keyframe's image, made small.

    Attributes:
        frame_id: Of the keyframe.
        grey: ``(H, W)`` uint8.
        noise: Median standard deviation of its pixels' errors, grey levels.
        K: ``(3, 3)`` pixels of the small image.
        rgb: ``(H, W, 3)`` uint8.
        confidence: ``(H, W)`` float32 in [0, 1].
    """

    frame_id: int
    grey: NDArray[np.uint8]
    noise: float
    K: Array
    rgb: NDArray[np.uint8]
    confidence: NDArray[np.float32]

    @property
    def shape_hw(self) -> tuple[int, int]:
        """Height and width."""
        return self.grey.shape[0], self.grey.shape[1]

    def to_compare(self) -> "View":
        """Return what depth is estimated from: without colours and confidence, which only points need."""
        return replace(self, rgb=self.rgb[:0], confidence=self.confidence[:0])


def view_of(
    frame_id: int,
    image: NDArray[np.uint8],
    confidence: NDArray[np.float32] | None,
    camera: Intrinsics,
) -> View:
    """Make a view of a received image, of about ``MAX_PIXELS`` at most.

    Args:
        frame_id: Of the frame.
        image: ``(H, W, 3)`` uint8 RGB without distortion.
        confidence: ``(H, W)`` in [0, 1], the codec's pixel target, or None for a clean image.
        camera: Of the image.
    """
    height, width = image.shape[:2]
    share = min(1.0, float(np.sqrt(MAX_PIXELS / (height * width))))
    size_wh = scaled_wh(width, height, share)
    rgb = np.asarray(cv2.resize(image, size_wh, interpolation=cv2.INTER_AREA), np.uint8)
    grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    small, noise = np.ones(grey.shape, np.float32), CLEAN_SIGMA
    if confidence is not None:
        small = np.asarray(cv2.resize(confidence, size_wh, interpolation=cv2.INTER_AREA), np.float32)
        noise = float(np.hypot(noise, error_sd(float(np.median(small)))))
    return View(frame_id, grey, noise, camera.scaled_to(*size_wh).K, rgb, small)


def error_sd(confidence: float) -> float:
    """Standard deviation of a pixel's error in grey levels that a confidence stands for."""
    doubt = 1.0 - min(max(confidence, _LEAST_CONFIDENCE), 1.0)
    return _SD_PER_MEAN * _GREY_LEVELS_PER_ATANH * math.atanh(doubt)
