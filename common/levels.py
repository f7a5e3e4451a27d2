"""The grey levels an image uses, stretched to all of them before it is encoded.

Learned encoders were trained on well exposed photos, whose details they know to be larger than what a link's
noise does to them. At night and in haze details are small: stretched first, and put back behind the decoder,
they arrive far better. The two ends of the range travel with the frame's header, like its size.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

#: Levels of an image of 8 bits.
_NUM_LEVELS = 256
#: Mean squared error, in squared levels, that clipping may cost at either end: lamps in the night are kept.
_CLIPPED_MSE = 0.25
#: Images that use more levels than this stay as they are: little is to be won there.
_WIDEST = 128
#: Images that use fewer are not stretched further: noise of the sensor fills that many.
_NARROWEST = 24
#: Every so many rows and columns are looked at.
_STEP = 2


@dataclass(frozen=True)
class Levels:
    """Ends of the range of grey levels that is stretched to 0 .. 255.

    Attributes:
        low: Level that became 0.
        high: Level that became 255.

    Raises:
        ValueError: They are not ``0 <= low < high <= 255``.
    """

    low: int = 0
    high: int = _NUM_LEVELS - 1

    def __post_init__(self) -> None:
        """Check the order."""
        if not 0 <= self.low < self.high < _NUM_LEVELS:
            raise ValueError(f"levels must be 0 <= low < high <= 255, got {self.low} and {self.high}")

    @property
    def are_all(self) -> bool:
        """Whether nothing is stretched."""
        return self == ALL_LEVELS

    def stretch(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return an image of any shape with ``low`` at 0 and ``high`` at 255, clipped beyond."""
        if self.are_all:
            return image
        levels = np.arange(_NUM_LEVELS, dtype=np.float32)
        return _looked_up(image, (levels - self.low) * (255.0 / (self.high - self.low)))

    def unstretch(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Undo ``stretch``, up to rounding and what was clipped."""
        if self.are_all:
            return image
        levels = np.arange(_NUM_LEVELS, dtype=np.float32)
        return _looked_up(image, self.low + levels * ((self.high - self.low) / 255.0))


ALL_LEVELS = Levels()


def levels_of(image: NDArray[np.uint8]) -> Levels:
    """Return the range of levels an image should be stretched from; all where it uses half of them or more.

    Args:
        image: ``(H, W, 3)`` uint8; the channels share one range, so that colours keep their hue.
    """
    values = np.ascontiguousarray(image[::_STEP, ::_STEP]).reshape(-1, 1)
    counts = cv2.calcHist([values], [0], None, [_NUM_LEVELS], [0, _NUM_LEVELS]).ravel().astype(np.float64)
    low, high = _end(counts), _NUM_LEVELS - 1 - _end(counts[::-1])
    if high - low > _WIDEST:
        return ALL_LEVELS
    short = max(_NARROWEST - (high - low), 0)
    low = min(max(low - short // 2, 0), _NUM_LEVELS - 1 - _NARROWEST)
    return Levels(low, max(high, low + _NARROWEST))


def _end(counts: NDArray[np.float64]) -> int:
    """Return the last level from the front to which the levels before it can be clipped at little cost.

    Raising the end by one level takes one more from every clipped value: squared errors follow from the
    number of values below and from the sum of their distances.
    """
    below = np.cumsum(counts)  # values at or below each level
    distance = np.concatenate(([0.0], np.cumsum(below)[:-1]))  # their summed distance to each level
    squared = np.concatenate(([0.0], np.cumsum(2.0 * distance[:-1] + below[:-1])))
    return int(np.searchsorted(squared, _CLIPPED_MSE * below[-1], side="right")) - 1


def _looked_up(image: NDArray[np.uint8], values: NDArray[np.float32]) -> NDArray[np.uint8]:
    table = np.clip(np.rint(values), 0, _NUM_LEVELS - 1).astype(np.uint8)
    return np.asarray(cv2.LUT(image, table), dtype=np.uint8).reshape(image.shape)
