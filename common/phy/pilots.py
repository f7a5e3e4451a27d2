"""Known symbols at the head of every slot, by which the receiver learns the channel.

A pilot is one of the four unit-power points (+-1 +-1j) / sqrt(2), chosen by a hash of slot and position, so
both ends agree without exchanging anything and the result does not depend on a library's random generator.
"""

import numpy as np
from numpy.typing import NDArray

from semcast.common.phy.hashing import INCREMENT, hashed_qpsk, mix
from semcast.common.phy.slots import DATA_PER_BLOCK, PILOTS_PER_BLOCK, USES_PER_BLOCK, SlotLayout


def pilot_symbols(layout: SlotLayout) -> NDArray[np.complex64]:
    """Return the ``(num_slots, pilots_per_slot)`` pilots; pilot k of slot s is the same in every layout."""
    slot = np.arange(layout.num_slots, dtype=np.uint64)[:, None]
    position = np.arange(layout.pilots_per_slot, dtype=np.uint64)[None, :]
    return hashed_qpsk(mix(((slot << np.uint64(32)) | position) + INCREMENT))


def _layout_of(num_slots: int, width: int, per_block: int, what: str) -> SlotLayout:
    if num_slots < 1 or width < per_block or width % per_block:
        raise ValueError(
            f"{what} must have shape (slots >= 1, multiple of {per_block}), got {(num_slots, width)}"
        )
    return SlotLayout(num_slots=num_slots, blocks_per_slot=width // per_block)


def insert_pilots(data: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """Put the pilots in front of the data symbols of each slot.

    Args:
        data: ``(num_slots, data_per_slot)``.

    Returns:
        ``(num_slots, uses_per_slot)`` complex64.

    Raises:
        ValueError: The width is not a whole number of blocks.
    """
    if data.ndim != 2:
        raise ValueError(f"data must have shape (slots, symbols), got {data.shape}")
    layout = _layout_of(data.shape[0], data.shape[1], DATA_PER_BLOCK, "data")
    slots = np.empty((layout.num_slots, layout.uses_per_slot), dtype=np.complex64)
    slots[:, : layout.pilots_per_slot] = pilot_symbols(layout)
    slots[:, layout.pilots_per_slot :] = data
    return slots


def split(slots: NDArray[np.complex64]) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
    """Return views ``(pilots, data)`` of slots ``(num_slots, uses_per_slot)``.

    Raises:
        ValueError: The width is not a whole number of blocks.
    """
    if slots.ndim != 2:
        raise ValueError(f"slots must have shape (slots, uses), got {slots.shape}")
    layout = _layout_of(slots.shape[0], slots.shape[1], USES_PER_BLOCK, "slots")
    num_pilots = PILOTS_PER_BLOCK * layout.blocks_per_slot
    return slots[:, :num_pilots], slots[:, num_pilots:]
