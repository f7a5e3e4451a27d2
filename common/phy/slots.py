"""The slot grid: which channel uses a frame has and which of them carry pilots.

A frame is cut into 16x16-pixel blocks. Each block owns 48 complex channel uses per frame, so the channel
bandwidth ratio is ``48 / (16 * 16 * 3) = 1/16``. One of the 48 is a pilot, 47 carry data, and the pilots are
therefore inside the ratio, not on top of it. A *slot* is one row of blocks, a band 16 pixels high: fading,
bursts and losses act on whole slots, so damage stays local in the image.
"""

from dataclasses import dataclass

BLOCK_PX = 16
#: Values of a block's pixels, RGB.
BLOCK_VALUES = 3 * BLOCK_PX * BLOCK_PX
USES_PER_BLOCK = 48
PILOTS_PER_BLOCK = 1
DATA_PER_BLOCK = USES_PER_BLOCK - PILOTS_PER_BLOCK
#: Real latent channels per block: two per complex data symbol.
LATENT_CHANNELS = 2 * DATA_PER_BLOCK


@dataclass(frozen=True)
class SlotLayout:
    """Sizes of one frame on the air.

    Attributes:
        num_slots: Rows of blocks.
        blocks_per_slot: Blocks in a row.
    """

    num_slots: int
    blocks_per_slot: int

    @property
    def pilots_per_slot(self) -> int:
        """Known symbols at the head of each slot."""
        return PILOTS_PER_BLOCK * self.blocks_per_slot

    @property
    def data_per_slot(self) -> int:
        """Data symbols behind the pilots of each slot."""
        return DATA_PER_BLOCK * self.blocks_per_slot

    @property
    def uses_per_slot(self) -> int:
        """All channel uses of a slot."""
        return USES_PER_BLOCK * self.blocks_per_slot

    @property
    def num_uses(self) -> int:
        """All channel uses of the frame, pilots included."""
        return self.num_slots * self.uses_per_slot


def layout_for(shape_hw: tuple[int, int]) -> SlotLayout:
    """Return the slot grid of an image, padded to whole blocks.

    Raises:
        ValueError: A side is not positive.
    """
    height, width = shape_hw
    if height < 1 or width < 1:
        raise ValueError(f"shape_hw must be positive, got {shape_hw}")
    return SlotLayout(num_slots=-(-height // BLOCK_PX), blocks_per_slot=-(-width // BLOCK_PX))


def channel_bandwidth_ratio(shape_hw: tuple[int, int]) -> float:
    """Return complex channel uses, pilots included, per source value ``H * W * 3``."""
    height, width = shape_hw
    return layout_for(shape_hw).num_uses / (height * width * 3)
