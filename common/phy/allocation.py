"""How many of a frame's values each block sends, and the code that tells the receiver.

A frame has a fixed number of channel uses, whatever it shows. At a fixed rate every 16x16 block has the same
share of them; a codec of variable rate gives blocks with detail more at the cost of the others. Its values
follow each other block by block, row by row, and fill the slots in this order. What each block sends has to
be known at the receiver: the code of the allocation travels with the frame's header, which is taken to
arrive, and a channel use is given up for each of its bits, as QPSK with a code of rate 1/2 would take.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from semcast.common.phy.slots import LATENT_CHANNELS

#: Values a block can send; the fourth is what all blocks send at a fixed rate.
LEVELS = (12, 24, 48, LATENT_CHANNELS, 2 * LATENT_CHANNELS, 3 * LATENT_CHANNELS)
FIXED_LEVEL = LEVELS.index(LATENT_CHANNELS)
#: Most values of a block.
MAX_VALUES = LEVELS[-1]
#: Real values that one bit of the code takes the place of: one channel use.
VALUES_PER_BIT = 2

_VALUES = np.array(LEVELS, dtype=np.int64)
_STEPS = np.diff(_VALUES)
#: Log2 of values at which a block is moved one level up.
_LOG_EDGES = (np.log2(_VALUES[1:]) + np.log2(_VALUES[:-1])) / 2.0
#: Longest code word, ``len(LEVELS) - 1`` bits.
_LONGEST = len(LEVELS) - 1
#: Frames whose code is read several times on its way.
_REMEMBERED = 8


def levels_for(demand: NDArray[np.float64], num_values: int) -> NDArray[np.uint8]:
    """Return the level of each block: nearest to its demand, raised in common until the values are used up.

    Args:
        demand: Log2 of the values blocks ask for, up to a constant that all share; of any shape.
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


def _by_likelihood() -> NDArray[np.int64]:
    """Return ``[left, above, k]``: the k-th likeliest level beside two known neighbours, nearest first."""
    levels = np.arange(len(LEVELS))
    neighbours = levels[:, None] + levels
    far = 2 * np.abs(2 * levels - neighbours[..., None]) + (levels > FIXED_LEVEL)
    return np.argsort(far, axis=-1, kind="stable")


_LIKELIEST = _by_likelihood()
#: ``[left, above, level]``: at which place a level is there.
_PLACE = np.argsort(_LIKELIEST, axis=-1)


@dataclass(frozen=True, eq=False)
class Allocation:
    """What each block of a frame sends.

    Attributes:
        levels: ``(h, w)`` uint8, indices into ``LEVELS``.
    """

    levels: NDArray[np.uint8]

    @classmethod
    def fixed(cls, grid: tuple[int, int]) -> "Allocation":
        """Return the allocation in which all blocks ``(h, w)`` send as many values as at a fixed rate."""
        return cls(np.full(grid, FIXED_LEVEL, dtype=np.uint8))

    @classmethod
    def of_demand(cls, demand: NDArray[np.float64]) -> "Allocation":
        """Return the allocation whose values, with the channel uses of its code, fill the frame.

        Args:
            demand: ``(h, w)``, see ``levels_for``.
        """
        capacity = LATENT_CHANNELS * demand.size
        spent = 0
        # A smaller budget has another map and a code of about the same length.
        while True:
            allocation = cls(levels_for(demand, capacity - spent))
            excess = allocation.num_values + allocation.num_values_of_code - capacity
            if excess <= 0 or not allocation.levels.any():
                return allocation
            spent = max(spent + excess, allocation.num_values_of_code)

    @staticmethod
    def from_code(code: bytes, grid: tuple[int, int]) -> "Allocation":
        """Return the allocation of a frame of ``(h, w)`` blocks.

        Raises:
            ValueError: The code is not one of so many blocks, or stands for more than a frame holds.
        """
        return _read(code, grid)

    @cached_property
    def values(self) -> NDArray[np.int64]:
        """``(h, w)`` values of each block."""
        return _VALUES[self.levels]

    @cached_property
    def num_values(self) -> int:
        """Values of all blocks."""
        return int(self.values.sum())

    @cached_property
    def _places(self) -> NDArray[np.int64]:
        """``(h, w)`` place of each level among those that are likely beside its neighbours."""
        levels = self.levels.astype(np.int64)
        above = np.empty_like(levels)
        above[1:] = levels[:-1]
        left = np.empty_like(levels)
        left[:, 1:] = levels[:, :-1]
        left[1:, 0] = levels[:-1, 0]
        left[0, 0] = FIXED_LEVEL
        above[0] = left[0]
        return _PLACE[left, above, levels]

    @property
    def num_values_of_code(self) -> int:
        """Real values whose channel uses the code takes."""
        return VALUES_PER_BIT * int(np.minimum(self._places + 1, _LONGEST).sum())

    @property
    def code(self) -> bytes:
        """The allocation in bytes: for each block the place of its level beside its neighbours', in unary."""
        places = self._places.ravel()
        lengths = np.minimum(places + 1, _LONGEST)
        ends = np.cumsum(lengths)
        bits = np.ones(int(ends[-1]), dtype=np.uint8)
        bits[ends[places < _LONGEST] - 1] = 0
        return np.packbits(bits).tobytes()

    def row_snr_db(self, slot_snr_db: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return one SNR in dB for each row of blocks, ``(h,)``.

        That of a link over which as large a share of its values' variance would arrive: a row of which most
        is lost counts as lost, one of which little is lost as somewhat worse than the rest.

        Args:
            slot_snr_db: ``(h,)`` SNR of each slot.
        """
        snr = 10.0 ** (slot_snr_db.astype(np.float64) / 10.0)
        slot_of_value = np.arange(self.num_values) // (LATENT_CHANNELS * self.levels.shape[1])
        per_row = self.values.sum(axis=1)
        arriving = np.add.reduceat((snr / (1.0 + snr))[slot_of_value], np.cumsum(per_row) - per_row) / per_row
        return np.asarray(10.0 * np.log10(arriving / (1.0 - arriving)), dtype=np.float32)


def _words(bits: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return what each code word stands for: its ones, which end with a zero or when there are five."""
    zeros = np.flatnonzero(bits == 0)
    ones = np.diff(zeros, prepend=-1) - 1
    ends = np.cumsum(ones // _LONGEST + 1)
    left_over = (len(bits) - 1 - int(zeros[-1]) if len(zeros) else len(bits)) // _LONGEST
    words = np.full((int(ends[-1]) if len(ends) else 0) + left_over, _LONGEST, dtype=np.int64)
    words[ends - 1] = ones % _LONGEST
    return words


@lru_cache(maxsize=_REMEMBERED)
def _read(code: bytes, grid: tuple[int, int]) -> Allocation:
    rows, columns = grid
    bits = np.unpackbits(np.frombuffer(code, dtype=np.uint8))
    places = _words(bits)[: rows * columns]
    if len(places) < rows * columns:
        raise ValueError(f"allocation must be the code of {rows}x{columns} blocks, got {len(code)} bytes")
    at = int(np.minimum(places + 1, _LONGEST).sum())
    likeliest = _LIKELIEST.tolist()
    levels = np.empty(grid, dtype=np.uint8)
    above: list[int] = []
    for row, of_row in enumerate(places.reshape(grid).tolist()):
        line: list[int] = []
        left = above[0] if above else FIXED_LEVEL
        for column, place in enumerate(of_row):
            left = likeliest[left][above[column] if above else left][place]
            line.append(left)
        levels[row] = line
        above = line
    levels.flags.writeable = False  # it may be handed out again
    allocation = Allocation(levels)
    capacity = LATENT_CHANNELS * levels.size
    taken = allocation.num_values + VALUES_PER_BIT * at
    if len(code) != (at + 7) // 8 or bits[at:].any() or taken > capacity:
        raise ValueError(
            f"allocation must be the code of {rows}x{columns} blocks that take at most {capacity} values, "
            f"got {len(code)} bytes for {taken}"
        )
    return allocation
