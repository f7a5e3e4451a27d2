"""The grey levels an image uses, stretched to all of them before it is encoded.

Learned encoders were trained on well exposed photos, whose details they know to be larger than what a link's
noise does to them. At night and in haze details are small: stretched first, and put back behind the decoder,
they arrive far better. The two ends of the range travel with the frame's header, like its size. Where a dark
image has lamps, what is bright is compressed to make room for the rest.
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
#: Highest knee: what uses more levels than that, lamps aside, is not dark.
_HIGHEST_KNEE = 96
#: Lamps have sharp edges, at which errors are larger: what one bright value counts, in dark ones.
_LAMP_COST = 8.0
#: Share of the noise that is left with a knee, at most; images of which more is left stay as they are.
_MOST_COST = 0.5
#: Distance of the rows and columns that are looked at.
_STEP = 2


@dataclass(frozen=True)
class Levels:
    """Range of grey levels that is stretched to 0 .. 255.

    Attributes:
        low: Level that became 0.
        high: Level that became 255.
        knee: Level up to which a dark picture with lamps is stretched; what is above it is compressed. None
            where the whole range is stretched alike.
        knee_at: Level that ``knee`` became, None without one.

    Raises:
        ValueError: They are not ``0 <= low < high <= 255``, or the knee does not lie between.
    """

    low: int = 0
    high: int = _NUM_LEVELS - 1
    knee: int | None = None
    knee_at: int | None = None

    def __post_init__(self) -> None:
        """Check the order."""
        if not 0 <= self.low < self.high < _NUM_LEVELS:
            raise ValueError(f"levels must be 0 <= low < high <= 255, got {self.low} and {self.high}")
        if self.knee is None and self.knee_at is None:
            return
        if self.knee is None or self.knee_at is None:
            raise ValueError(
                f"knee and knee_at must be given both or neither, got {self.knee}, {self.knee_at}"
            )
        if not (self.low < self.knee < self.high and 0 < self.knee_at < _NUM_LEVELS - 1):
            raise ValueError(
                f"knee must be between {self.low} and {self.high}, and knee_at between 0 and 255, "
                f"got {self.knee} and {self.knee_at}"
            )

    @property
    def are_all(self) -> bool:
        """Whether nothing is stretched."""
        return self == ALL_LEVELS

    @property
    def numbers(self) -> tuple[int, ...]:
        """What ``Levels`` is made from again: two numbers, or four with a knee."""
        return tuple(n for n in (self.low, self.high, self.knee, self.knee_at) if n is not None)

    def stretch(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return an image of any shape with ``low`` at 0 and ``high`` at 255, clipped beyond."""
        if self.are_all:
            return image
        levels = np.arange(_NUM_LEVELS, dtype=np.float32)
        if self.knee is not None and self.knee_at is not None:
            return _looked_up(
                image, np.interp(levels, (self.low, self.knee, self.high), (0, self.knee_at, 255))
            )
        return _looked_up(image, (levels - self.low) * (255.0 / (self.high - self.low)))

    def unstretch(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Undo ``stretch``, up to rounding and what was clipped."""
        if self.are_all:
            return image
        levels = np.arange(_NUM_LEVELS, dtype=np.float32)
        if self.knee is not None and self.knee_at is not None:
            return _looked_up(
                image, np.interp(levels, (0, self.knee_at, 255), (self.low, self.knee, self.high))
            )
        return _looked_up(image, self.low + levels * ((self.high - self.low) / 255.0))


ALL_LEVELS = Levels()


def levels_of(image: NDArray[np.uint8]) -> Levels:
    """Return the levels an image should be stretched from; all where it uses half of them or more.

    A dark image in which little is brighter, such as lamps, has a knee.

    Args:
        image: ``(H, W, 3)`` uint8; the channels share one range, so that colours keep their hue.
    """
    values = np.ascontiguousarray(image[::_STEP, ::_STEP]).reshape(-1, 1)
    counts = cv2.calcHist([values], [0], None, [_NUM_LEVELS], [0, _NUM_LEVELS]).ravel().astype(np.float64)
    low, high = _end(counts), _NUM_LEVELS - 1 - _end(counts[::-1])
    if high - low > _WIDEST:
        return _with_shoulder(counts, low, high)
    short = max(_NARROWEST - (high - low), 0)
    low = min(max(low - short // 2, 0), _NUM_LEVELS - 1 - _NARROWEST)
    return Levels(low, max(high, low + _NARROWEST))


def _with_shoulder(counts: NDArray[np.float64], low: int, high: int) -> Levels:
    """Return the range with the knee at which the link's noise costs least; all levels if it hardly helps.

    What a part of the range costs is the number of its values times the square of the factor by which putting
    them back enlarges the noise: ``a / share ** 2`` for dark ones that have a share of all levels, and
    ``b / (1 - share) ** 2`` for bright ones. The best share is ``cbrt(a) / (cbrt(a) + cbrt(b))``, and costs
    ``(cbrt(a) + cbrt(b)) ** 3`` in all.
    """
    knees = np.arange(low + _NARROWEST, min(_HIGHEST_KNEE + 1, high))
    if not len(knees):
        return ALL_LEVELS
    below = np.cumsum(counts)
    dark = np.cbrt(below[knees] * np.square(knees - low))
    bright = np.cbrt(_LAMP_COST * (below[-1] - below[knees]) * np.square(high - knees))
    cost = (dark + bright) ** 3 / (below[-1] * 255.0**2)
    best = int(np.argmin(cost))
    if cost[best] > _MOST_COST:
        return ALL_LEVELS
    share = dark[best] / (dark[best] + bright[best])
    return Levels(low, high, int(knees[best]), int(np.clip(np.rint(255.0 * share), 1, 254)))


def _end(counts: NDArray[np.float64]) -> int:
    """Return the last level from the front to which the levels before it can be clipped at little cost.

    Raising the end by one level takes one more from every clipped value: squared errors follow from the
    number of values below and from the sum of their distances.
    """
    below = np.cumsum(counts)  # values at or below each level
    distance = np.concatenate(([0.0], np.cumsum(below)[:-1]))  # their summed distance to each level
    squared = np.concatenate(([0.0], np.cumsum(2.0 * distance[:-1] + below[:-1])))
    return int(np.searchsorted(squared, _CLIPPED_MSE * below[-1], side="right")) - 1


def _looked_up(image: NDArray[np.uint8], values: NDArray[np.floating]) -> NDArray[np.uint8]:
    table = np.clip(np.rint(values), 0, _NUM_LEVELS - 1).astype(np.uint8)
    return np.asarray(cv2.LUT(image, table), dtype=np.uint8).reshape(image.shape)
