"""What blocks send in training: about what the rule of ``detail`` gives them, scattered.

The networks are to serve whatever rule chooses later, so its exponent, the budget and single blocks vary. The
blocks of some crops share one budget: a crop of a wall alone must be sent with as little as within a frame.

On the air the values of a row of blocks begin in one slot and may end in the next, which fades on its own.
"""

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semcast.common.nets.detail import demand_of, detail_of
from semcast.common.phy.allocation import LEVELS, MAX_VALUES, levels_for
from semcast.common.phy.slots import LATENT_CHANNELS
from semcast.training.channel import to_device

_VALUES = torch.tensor(LEVELS)
#: Share of rows that end in the slot they begin in.
_SHARE_WHOLE = 0.35
#: Crops that share one budget. Of the blocks of many crops there are always as many with detail as without,
#: but frames differ.
_GROUP = 16


@dataclass(frozen=True, kw_only=True)
class AllocationSettings:
    """How allocations are drawn.

    Attributes:
        exponent_min: Smallest exponent of a block's detail.
        exponent_max: Largest.
        floor: Detail of a block without any, in squared grey levels.
        block_sd: Standard deviation of single blocks' log2 of values from the rule.
        budget: Values of a block, the mean over the crops of a group.
        budget_sd: Standard deviation of the budget's log2.
    """

    exponent_min: float = field(default=0.3, metadata={"help": "smallest exponent of a block's detail"})
    exponent_max: float = field(default=0.75, metadata={"help": "largest exponent of a block's detail"})
    floor: float = field(
        default=8.0, metadata={"help": "detail added to every block's, in squared grey levels"}
    )
    block_sd: float = field(
        default=0.35, metadata={"help": "scatter of single blocks about the rule, log2 of values"}
    )
    budget: float = field(default=91.0, metadata={"help": "values of a block, mean over 16 crops"})
    budget_sd: float = field(
        default=0.3, metadata={"help": "scatter of the budget between groups of crops, log2"}
    )

    def __post_init__(self) -> None:
        if not 0.0 <= self.exponent_min <= self.exponent_max <= 2.0:
            raise ValueError(
                "exponent_min and exponent_max must be in [0, 2] and ordered, "
                f"got {self.exponent_min}, {self.exponent_max}"
            )
        if not 0.0 < self.floor < 65025.0:
            raise ValueError(f"floor must be in (0, 65025), got {self.floor}")
        for name in ("block_sd", "budget_sd"):
            if not 0.0 <= getattr(self, name) <= 4.0:
                raise ValueError(f"{name} must be in [0, 4], got {getattr(self, name)}")
        if not LEVELS[0] <= self.budget <= 2 * LATENT_CHANNELS:
            raise ValueError(f"budget must be in [{LEVELS[0]}, {2 * LATENT_CHANNELS}], got {self.budget}")


@dataclass(frozen=True)
class AllocationDraw:
    """What the blocks of a batch send, and in which slots.

    Attributes:
        values: ``(B, 1, h, w)`` int64 how many values each block sends.
        num_before: ``(B, 1, h, 1)`` int64 how many values of a row are in the row's own slot; the others are
            in the one below.
    """

    values: Tensor
    num_before: Tensor

    def to(self, device: torch.device) -> "AllocationDraw":
        """Return the draw on a device."""
        return AllocationDraw(to_device(self.values, device), to_device(self.num_before, device))

    def pin_memory(self) -> "AllocationDraw":
        """Return the draw in memory from which a GPU fetches it on its own."""
        return AllocationDraw(self.values.pin_memory(), self.num_before.pin_memory())

    def in_next_slot(self) -> Tensor:
        """Tell which values are in the slot below that of their row, ``(B, 282, h, w)``."""
        before = self.values.cumsum(dim=3) - self.values  # values of the row before each block
        channel = torch.arange(MAX_VALUES, device=self.values.device).view(1, -1, 1, 1)
        return before + channel >= self.num_before


def draw_allocation(
    crops: Tensor, settings: AllocationSettings, generator: torch.Generator
) -> AllocationDraw:
    """Draw what each block of a batch sends.

    Args:
        crops: ``(B, 3, H, W)`` uint8 on the CPU.
        settings: Of the draw.
        generator: On the CPU.
    """
    groups = [_draw_levels(group, settings, generator) for group in crops.split(_GROUP)]
    values = _VALUES[torch.from_numpy(np.concatenate(groups)).long()][:, None]
    in_row = values.sum(dim=3, keepdim=True)
    cut = torch.rand(in_row.shape, generator=generator) / (1.0 - _SHARE_WHOLE)
    return AllocationDraw(values, (cut * in_row).long())


def _draw_levels(
    crops: Tensor, settings: AllocationSettings, generator: torch.Generator
) -> NDArray[np.uint8]:
    detail = np.stack([detail_of(crop) for crop in crops.permute(0, 2, 3, 1).numpy()])
    span = settings.exponent_max - settings.exponent_min
    exponent = settings.exponent_min + span * float(torch.rand(1, generator=generator))
    scatter = torch.randn(detail.shape, generator=generator).numpy()
    demand = demand_of(detail, exponent, settings.floor) + settings.block_sd * scatter
    budget = settings.budget * 2.0 ** (settings.budget_sd * float(torch.randn(1, generator=generator)))
    return levels_for(demand, round(budget * detail.size))
