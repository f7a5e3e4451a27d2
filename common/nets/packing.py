"""Values of blocks that send different numbers of them, as the values of a frame's slots, and back.

The values follow each other block by block, row by row, and fill the slots in this order; a slot holds as
many as at a fixed rate. What the code of the allocation takes the place of lies behind them. So the values of
a block may be in two slots, and arrive differently well.
"""

import torch
from torch import Tensor

from semcast.common.nets.modulation import undo_analog
from semcast.common.phy.slots import LATENT_CHANNELS

#: Amplitude of what stands for the symbols of the allocation's code: power 1/2 for each real part.
_FILLER = 0.5**0.5


def sent_mask(values: Tensor, channels: int) -> Tensor:
    """Return 1 for each value that is sent and 0 for the others, ``(B, C, h, w)`` float32, channels last.

    Args:
        values: ``(B, 1, h, w)`` how many values each block sends, the first ones.
        channels: Values a block has.
    """
    of_blocks = torch.arange(channels, device=values.device) < values.permute(0, 2, 3, 1)
    return of_blocks.float().permute(0, 3, 1, 2)


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


def blocks_arrived(y_rx: Tensor, shrink: Tensor, sent: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the latent of blocks as well as it is known, with one reliability for each block.

    A decoder is told one shrink factor and SNR for a block: those of the mean share of its values' variance
    that arrived. Values that arrived better are brought to the same factor.

    Args:
        y_rx: ``(B, C, h, w)`` analog values, shrunk by ``shrink``.
        shrink: ``(B, C, h, w)`` in (0, 1), ``snr / (1 + snr)`` of each value.
        sent: 1 where a value is sent, of the same shape.

    Returns:
        The latent ``(B, C, h, w)``; the SNR in dB and the shrink factor of each block, ``(B, 1, h, w)``; the
        factor ``(B, 1, 1, 1)`` that undid the transmitter's division.
    """
    shrink = shrink.clamp(1e-3, 1.0 - 1e-4)
    latent, scale = undo_analog(y_rx * sent, shrink, sent)
    of_block = (shrink * sent).sum(dim=1, keepdim=True) / sent.sum(dim=1, keepdim=True)
    snr_db = 10.0 * torch.log10(of_block / (1.0 - of_block))
    return latent * (of_block / shrink), snr_db, of_block, scale
