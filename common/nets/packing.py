"""Values of blocks that send different numbers of them, as the values of a frame's slots, and back.

The values follow each other block by block, row by row, and fill the slots in this order; a slot holds as
many as at a fixed rate. What the code of the allocation takes the place of lies behind them.
"""

import torch
from torch import Tensor

from semcast.common.phy.slots import LATENT_CHANNELS

#: Amplitude of what stands for the symbols of the allocation's code: power 1/2 for each real part.
_FILLER = 0.5**0.5


def sent_mask(values: Tensor, channels: int) -> Tensor:
    """Return 1 for each value that is sent and 0 for the others, ``(B, C, h, w)`` float32.

    Args:
        values: ``(B, 1, h, w)`` how many values each block sends, the first ones.
        channels: Values a block has.
    """
    return (torch.arange(channels, device=values.device).view(1, -1, 1, 1) < values).float()


def share_plane(values: Tensor) -> Tensor:
    """Return what networks are told of ``(B, 1, h, w)`` numbers of values: about -1.5 .. 0.8, 0 is usual."""
    return torch.log2(values.float() / LATENT_CHANNELS) / 2.0


def pack(symbols: Tensor, sent: Tensor) -> Tensor:
    """Put the values of one frame's blocks into its slots.

    Args:
        symbols: ``(1, C, h, w)``.
        sent: 1 where a value is sent, of the same shape; at most 94 for each block on average.

    Returns:
        ``(1, 94, h, w)``: row ``r`` is what slot ``r`` carries, as at a fixed rate.
    """
    rows, columns = symbols.shape[2:]
    chosen = symbols[0].permute(1, 2, 0)[sent[0].permute(1, 2, 0) > 0]
    whole = rows * columns * LATENT_CHANNELS
    place = torch.arange(whole - len(chosen), device=symbols.device)
    filler = _FILLER * (1.0 - 2.0 * (place * (place + 1) // 2 % 2)).to(symbols.dtype)
    stream = torch.cat((chosen, filler))
    return stream.view(1, rows, columns, LATENT_CHANNELS).permute(0, 3, 1, 2)


def unpack(packed: Tensor, sent: Tensor) -> Tensor:
    """Invert ``pack``; 0 where nothing was sent."""
    stream = packed[0].permute(1, 2, 0).reshape(-1)
    mask = sent[0].permute(1, 2, 0) > 0
    blocks = torch.zeros(mask.shape, dtype=packed.dtype, device=packed.device)
    blocks.masked_scatter_(mask, stream)
    return blocks.permute(2, 0, 1)[None]
