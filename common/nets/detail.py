"""Which blocks of an image ask for many values: those with detail."""

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.phy.allocation import Allocation
from semcast.common.phy.slots import BLOCK_PX

#: A block asks for values in proportion to a power of its detail plus a floor.
EXPONENT = 0.65
#: The floor, in squared grey levels; of smooth pictures no more than this share of their mean detail, or all
#: of their blocks would ask for the same.
DETAIL_FLOOR, _FLOOR_SHARE = 16.0, 0.3
#: The floor of a picture of one grey.
_LEAST_FLOOR = 0.25


def detail_of(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return how much detail each block has: its mean squared Laplacian, in squared grey levels, over 16.

    Args:
        image: ``(H, W, 3)`` uint8 RGB, sides multiples of 16.

    Returns:
        ``(H/16, W/16)``.
    """
    grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    squared = np.square(cv2.Laplacian(grey, cv2.CV_32F, ksize=1))
    size_wh = (grey.shape[1] // BLOCK_PX, grey.shape[0] // BLOCK_PX)
    mean = cv2.resize(squared, size_wh, interpolation=cv2.INTER_AREA)
    return np.asarray(mean * np.float32(1.0 / 16.0), dtype=np.float32)


def demand_of(
    detail: NDArray[np.float32], exponent: float = EXPONENT, floor: float = DETAIL_FLOOR
) -> NDArray[np.float64]:
    """Return log2 of the values blocks ask for, up to a constant that all share."""
    return np.asarray(exponent * np.log2(detail.astype(np.float64) + floor))


def allocation_for(image: NDArray[np.uint8]) -> Allocation:
    """Return what each block of an image sends: ``(H, W, 3)`` uint8 RGB, sides multiples of 16."""
    detail = detail_of(image)
    floor = min(DETAIL_FLOOR, max(_LEAST_FLOOR, _FLOOR_SHARE * float(detail.mean())))
    return Allocation.of_demand(demand_of(detail, floor=floor))
