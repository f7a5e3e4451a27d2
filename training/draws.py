"""What a step is made of that is random: crops, their links, what their blocks send.

All of it is a function of seed, step and rank, so it is drawn ahead beside the training: of a large batch it
would cost a GPU more time than the network.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.data import Dataset

from semcast.common.phy.slots import BLOCK_PX
from semcast.training.allocations import AllocationDraw, AllocationSettings, draw_allocation
from semcast.training.channel import LinkDraw, LinkDrawSettings, draw_links
from semcast.training.data import Crops


@dataclass(frozen=True)
class StepDraw:
    """What one step is made of, on the CPU.

    Attributes:
        pixels: ``(B, 3, size, size)`` uint8.
        links: Of the batch.
        sent: What each block sends, where the rate is variable.
    """

    pixels: Tensor
    links: LinkDraw
    sent: AllocationDraw | None

    def pin_memory(self) -> "StepDraw":
        """Return the draw in memory from which a GPU fetches it on its own."""
        sent = None if self.sent is None else self.sent.pin_memory()
        return StepDraw(self.pixels.pin_memory(), self.links.pin_memory(), sent)


class Draws(Dataset[StepDraw]):
    """The draws of every step.

    Args:
        crops: The batch of every step.
        channel: How links are drawn.
        allocation: How allocations are drawn; None for a network of fixed rate.
        seed: Of the whole run.
        rank: Of this process.
    """

    def __init__(
        self,
        crops: Crops,
        channel: LinkDrawSettings,
        allocation: AllocationSettings | None,
        seed: int,
        rank: int = 0,
    ) -> None:
        self._crops = crops
        self._channel = channel
        self._allocation = allocation
        self._key = (seed, rank)

    def __getitem__(self, step: int) -> StepDraw:
        """Return the draw of a step."""
        pixels = self._crops[step]
        generator = torch.Generator().manual_seed(seed_of_step(*self._key, step))
        links = draw_links(self._channel, len(pixels), pixels.shape[2] // BLOCK_PX, generator)
        sent = None
        if self._allocation is not None:
            sent = draw_allocation(pixels, self._allocation, generator)
        return StepDraw(pixels, links, sent)


def seed_of_step(seed: int, rank: int, step: int) -> int:
    """Return a seed of 63 bits for one step of one process."""
    # Every 64 processes begin where the steps of those before can't get to.
    return (seed * 1_000_003 + step + (rank // 64 << 52)) * 64 + rank % 64
