"""How many latent values each block of a frame sends: many where there is detail, few for a wall or the sky.

A frame has a fixed number of channel uses, whatever it shows. A codec of fixed rate gives every 16x16 block
the same share of them; one of variable rate lets blocks with detail have more at the cost of the others. What
each block got is known before encoding, from the image alone, and the receiver has to be told: the code of
the allocation travels with the frame's header, and a channel use is given up for each of its bits, as QPSK
with a code of rate 1/2 would take. Values are ordered, so that the first ones of a block matter most.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.phy.slots import BLOCK_PX, LATENT_CHANNELS

#: Values a block can send; the fourth is what all blocks send at a fixed rate.
LEVELS = (12, 24, 48, LATENT_CHANNELS, 2 * LATENT_CHANNELS, 3 * LATENT_CHANNELS)
FIXED_LEVEL = LEVELS.index(LATENT_CHANNELS)
#: Most values of a block.
MAX_VALUES = LEVELS[-1]
#: A block gets values in proportion to its detail plus the second number, to the power of the first.
EXPONENT, DETAIL_FLOOR = 0.55, 8.0

_VALUES = np.array(LEVELS, dtype=np.int64)
_STEPS = np.diff(_VALUES)
#: Log2 of values at which a block is moved one level up.
_LOG_EDGES = (np.log2(_VALUES[1:]) + np.log2(_VALUES[:-1])) / 2.0
#: Real values that one bit of the code takes the place of: one channel use.
_VALUES_PER_BIT = 2
#: Longest code word, ``len(LEVELS) - 1`` bits.
_LONGEST = len(LEVELS) - 1


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


def levels_for(demand: NDArray[np.float64], num_values: int) -> NDArray[np.uint8]:
    """Return the level of each block: nearest to its demand, raised in common until the values are used up.

    Args:
        demand: Log2 of what blocks ask for, of any shape.
        num_values: What all blocks may send together; fewer than the lowest level gives that level to all.

    Returns:
        Indices into ``LEVELS``, of the shape of ``demand``.
    """
    # Raising what all ask for moves blocks up one after another; within a block the steps come in order.
    missing = _LOG_EDGES - demand.reshape(-1, 1)
    order = np.argsort(missing, axis=None, kind="stable")
    used = _VALUES[0] * demand.size + np.cumsum(_STEPS[order % len(_STEPS)])
    num_steps = int(np.searchsorted(used, num_values, side="right"))
    taken = np.bincount(order[:num_steps] // len(_STEPS), minlength=demand.size)
    return taken.astype(np.uint8).reshape(demand.shape)


def _ranks(left: NDArray[np.int64], above: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the levels ``(..., 6)`` from the likeliest to the least likely beside two known neighbours."""
    levels = np.arange(len(LEVELS))
    far = 2 * np.abs(2 * levels - (left + above)[..., None]) + (levels > FIXED_LEVEL)
    return np.argsort(far, axis=-1, kind="stable")


#: ``_RANKED[left, above, k]``: the k-th likeliest level.
_RANKED = _ranks(*np.meshgrid(np.arange(len(LEVELS)), np.arange(len(LEVELS)), indexing="ij"))
#: ``_RANK_OF[left, above, level]``: its rank.
_RANK_OF = np.argsort(_RANKED, axis=-1)


@dataclass(frozen=True, eq=False)
class Allocation:
    """What each block of a frame sends.

    Attributes:
        levels: ``(h, w)`` uint8, indices into ``LEVELS``.
    """

    levels: NDArray[np.uint8]

    @classmethod
    def fixed(cls, grid: tuple[int, int]) -> "Allocation":
        """Return the allocation in which all blocks ``(h, w)`` send alike."""
        return cls(np.full(grid, FIXED_LEVEL, dtype=np.uint8))

    @classmethod
    def of_image(cls, image: NDArray[np.uint8]) -> "Allocation":
        """Return the allocation for an image ``(H, W, 3)`` uint8, sides multiples of 16.

        Its values and the channel uses its code takes fit the frame.
        """
        demand = demand_of(detail_of(image))
        capacity = LATENT_CHANNELS * demand.size
        spent = 0
        # A smaller budget has another map and a code of about the same length.
        while True:
            allocation = cls(levels_for(demand, capacity - spent))
            excess = allocation.num_values + allocation.num_values_of_code - capacity
            if excess <= 0 or not allocation.levels.any():
                return allocation
            spent = max(spent + excess, allocation.num_values_of_code)

    @classmethod
    def from_code(cls, code: bytes, grid: tuple[int, int]) -> "Allocation":
        """Return the allocation of a frame of ``(h, w)`` blocks; an empty code stands for ``fixed``.

        Raises:
            ValueError: The code is not one of so many blocks, or stands for more values than a frame holds.
        """
        if not code:
            return cls.fixed(grid)
        rows, columns = grid
        bits = np.unpackbits(np.frombuffer(code, dtype=np.uint8)).tolist()
        ranked = _RANKED.tolist()
        levels = np.empty(grid, dtype=np.uint8)
        above: list[int] = []
        at = 0
        try:
            for row in range(rows):
                line: list[int] = []
                left = above[0] if above else FIXED_LEVEL
                for column in range(columns):
                    rank = 0
                    while rank < _LONGEST and bits[at]:
                        rank += 1
                        at += 1
                    at += rank < _LONGEST
                    left = ranked[left][above[column] if above else left][rank]
                    line.append(left)
                levels[row] = line
                above = line
        except IndexError:
            raise ValueError(
                f"allocation must be the code of {rows}x{columns} blocks, got {len(code)} bytes"
            ) from None
        allocation = cls(levels)
        if len(code) != (at + 7) // 8 or allocation.num_values > LATENT_CHANNELS * levels.size:
            raise ValueError(
                f"allocation must be the code of {rows}x{columns} blocks with at most "
                f"{LATENT_CHANNELS * levels.size} values, got {len(code)} bytes for {allocation.num_values}"
            )
        return allocation

    @cached_property
    def values(self) -> NDArray[np.int64]:
        """``(h, w)`` values of each block."""
        return _VALUES[self.levels]

    @cached_property
    def num_values(self) -> int:
        """Values of all blocks."""
        return int(self.values.sum())

    @cached_property
    def _ranks(self) -> NDArray[np.int64]:
        levels = self.levels.astype(np.int64)
        above = np.empty_like(levels)
        above[1:] = levels[:-1]
        left = np.empty_like(levels)
        left[:, 1:] = levels[:, :-1]
        left[1:, 0] = levels[:-1, 0]
        left[0, 0] = FIXED_LEVEL
        above[0] = left[0]
        return _RANK_OF[left, above, levels]

    @property
    def num_values_of_code(self) -> int:
        """Real values whose channel uses the code takes."""
        return _VALUES_PER_BIT * int(np.minimum(self._ranks + 1, _LONGEST).sum())

    @property
    def code(self) -> bytes:
        """The allocation in bytes: for each block the rank of its level beside its neighbours', in unary."""
        ranks = self._ranks.ravel()
        lengths = np.minimum(ranks + 1, _LONGEST)
        ends = np.cumsum(lengths)
        bits = np.ones(int(ends[-1]), dtype=np.uint8)
        bits[ends[ranks < _LONGEST] - 1] = 0
        return np.packbits(bits).tobytes()

    def block_snr_db(self, slot_snr_db: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the SNR ``(h, w)`` of each block: the lowest of the slots its values are in.

        Args:
            slot_snr_db: ``(h,)`` SNR of each slot.
        """
        values = self.values.ravel()
        starts = np.cumsum(values) - values
        slot_of_value = np.arange(self.num_values) // (LATENT_CHANNELS * self.levels.shape[1])
        lowest = np.minimum.reduceat(slot_snr_db[slot_of_value], starts)
        return np.asarray(lowest, dtype=np.float32).reshape(self.levels.shape)

    def row_snr_db(self, slot_snr_db: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the SNR ``(h,)`` of each row of blocks: that of its worst block."""
        return np.asarray(self.block_snr_db(slot_snr_db).min(axis=1))
