"""Latent values as channel symbols: analog ones, or rounded to the levels of 16-QAM; and back.

Both ways begin with analog symbols: the latent of an image divided by its own rms, which the receiver does
not know. A weak known pattern (one sign per channel, alternating over the blocks like a chessboard) is
therefore added before the division; the receiver correlates with it and learns the divisor from the air,
never from the transmitter.

With 16-QAM the values of a slot are then spread evenly over its symbols by a fixed orthonormal mixing and
rounded. Loud and quiet blocks may differ as they may in analog symbols, every symbol is about Gaussian, and
what rounding takes is noise like that of the link: a network need not know how its symbols travel, only how
well.
"""

from functools import cache, lru_cache
from typing import Any

import torch
from torch import Tensor

from semcast.common.nets.modulation_numpy import CARRIER_AMPLITUDE
from semcast.common.nets.rounding import (
    CLIP,
    LEVEL_STEP,
    LOADING,
    MEAN_INNER,
    MEAN_OUTER,
    SNR_GRID_DB,
    mixing,
    share_known,
)
from semcast.common.phy.qam import SHAPED_OUTER_SHARE

_MAX_SCALE = 6.0
#: From an analog value, of power 1/2, to one that is rounded.
_TO_ROUNDED = 2.0**0.5 * LOADING


class _NearestLevel(torch.autograd.Function):
    """Round to the nearest level; pass the gradient straight through inside the clipping range."""

    @staticmethod
    def forward(ctx: Any, y: Tensor) -> Tensor:
        ctx.save_for_backward(y)
        return (torch.floor(y / LEVEL_STEP).clamp(-2.0, 1.0) + 0.5) * LEVEL_STEP

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:  # type: ignore[override]
        (y,) = ctx.saved_tensors
        pulls_inward = (y * grad) > 0
        return torch.where((y.abs() < CLIP) | pulls_inward, grad, torch.zeros_like(grad))


def nearest_level(y: Tensor) -> Tensor:
    """Round every value to the nearest 4-PAM level; the gradient is the identity inside ``+-CLIP``."""
    rounded: Tensor = _NearestLevel.apply(y)  # type: ignore[no-untyped-call]
    return rounded


def carrier_pattern(like: Tensor) -> Tensor:
    """Return the known ``(1, C, h, w)`` pattern of +-1 for a latent of the shape of ``like``."""
    _, channels, rows, columns = like.shape
    return _pattern(channels, rows, columns, like.dtype, like.device)


@lru_cache(maxsize=8)
def _pattern(channels: int, rows: int, columns: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        channel = torch.arange(channels, device=device)
        # Signs + - - + over and over: what changes little from channel to channel does not look like it.
        sign_c = 1.0 - 2.0 * ((channel * (channel + 1) // 2) % 2).to(dtype)
        row = torch.arange(rows, device=device).view(-1, 1)
        column = torch.arange(columns, device=device).view(1, -1)
        board = 1.0 - 2.0 * ((row + column) % 2).to(dtype)
        # Channels last, as the latents: tensors laid out differently take three times as long to multiply.
        return (board.view(1, rows, columns, 1) * sign_c).permute(0, 3, 1, 2)


def _mean(values: Tensor, sent: Tensor | None) -> Tensor:
    """Mean of each image, ``(B, 1, 1, 1)``, over what is sent; ``values`` are 0 where nothing is."""
    if sent is None:
        return values.mean(dim=(1, 2, 3), keepdim=True)
    total = values.sum(dim=(1, 2, 3), keepdim=True)
    return total / sent.sum(dim=(1, 2, 3), keepdim=True)


def analog_symbols(y: Tensor, sent: Tensor | None = None) -> Tensor:
    """Add the carrier and scale each image to average power 1/2 for each real value that is sent.

    Args:
        y: ``(B, C, h, w)`` latent.
        sent: 1 where a value is sent, 0 where not, of the same shape; None: all are.

    Returns:
        Of the shape of ``y``, 0 where nothing is sent.
    """
    pattern = carrier_pattern(y)
    if sent is not None:
        y, pattern = y * sent, pattern * sent
    y = y - _mean(y * pattern, sent) * pattern
    y = y + CARRIER_AMPLITUDE * pattern
    return y * torch.rsqrt(2.0 * _mean(y.square(), sent) + 1e-12)


def spread(symbols: Tensor) -> Tensor:
    """Mix the values of every slot, so that each symbol has a part of all.

    Args:
        symbols: ``(B, C, h, w)``; a slot is a row of blocks.
    """
    order, _, signs, columns, channels = _mixing_on(symbols.shape[1], symbols.shape[3], symbols.device)
    with torch.autocast(symbols.device.type, enabled=False):
        slots = symbols.float().permute(0, 2, 1, 3)  # (B, h, C, w)
        shuffled = slots.flatten(2)[..., order].view(slots.shape) * signs
        return (channels @ (shuffled @ columns.mT)).permute(0, 2, 1, 3)


def unspread(symbols: Tensor) -> Tensor:
    """Invert ``spread``."""
    _, inverse, signs, columns, channels = _mixing_on(symbols.shape[1], symbols.shape[3], symbols.device)
    with torch.autocast(symbols.device.type, enabled=False):
        slots = symbols.float().permute(0, 2, 1, 3)
        shuffled = (channels.mT @ slots @ columns * signs).flatten(2)
        back = shuffled[..., inverse].view(slots.shape)
        return back.permute(0, 2, 1, 3)


# Constants are brought to a device once: for every copy, a GPU and the program wait for each other. They must
# not be inference tensors, which gradients can't pass.
@cache
def _mixing_on(num_channels: int, num_columns: int, device: torch.device) -> tuple[Tensor, ...]:
    of = mixing(num_channels, num_columns)
    with torch.inference_mode(False):
        arrays = (of.order, of.inverse, of.signs, of.columns, of.channels)
        return tuple(torch.from_numpy(array).to(device) for array in arrays)


@cache
def _share_known_on(device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.from_numpy(share_known()).to(device)


def _may_hold(flags: Tensor) -> bool:
    """Tell whether any flag is set; always true of a GPU's, which would have to be waited for."""
    return flags.device.type != "cpu" or bool(flags.any())


def effective_snr_db(snr_db: Tensor, is_qam: Tensor) -> Tensor:
    """Return the SNR in dB at which values arrive behind the link and, with 16-QAM, the rounding.

    Computes ``rounding.rounded_snr_db`` where the tensors are.

    Args:
        snr_db: ``(B, ...)`` of the link.
        is_qam: ``(B,)`` 1 for 16-QAM, 0 for analog.
    """
    table = _share_known_on(snr_db.device)
    place = (snr_db.detach().double() - SNR_GRID_DB[0]) / (SNR_GRID_DB[1] - SNR_GRID_DB[0])
    place = place.clamp(0.0, len(table) - 1.0)
    below = place.long().clamp_max(len(table) - 2)
    known = torch.lerp(table[below], table[below + 1], place - below)
    rounded = 10.0 * torch.log10(known / (1.0 - known))
    flag = is_qam.view(-1, *(1,) * (snr_db.ndim - 1))
    return torch.where(flag > 0, rounded.to(snr_db.dtype), snr_db)


def shrink_of(snr_db: Tensor) -> Tensor:
    """Return ``snr / (1 + snr)``: the share of a value that its mean given what arrived has."""
    linear = 10.0 ** (snr_db / 10.0)
    return linear / (1.0 + linear)


def modulate(latent: Tensor, is_qam: Tensor) -> Tensor:
    """Modulate: real and imaginary parts of unit-power symbols, so power 1/2 for each real value.

    Args:
        latent: ``(B, C, h, w)``.
        is_qam: ``(B,)`` 1 for 16-QAM, 0 for analog.
    """
    return rounded_symbols(analog_symbols(latent), is_qam)


def rounded_symbols(analog: Tensor, is_qam: Tensor) -> Tensor:
    """Return the analog symbols ``(B, C, h, w)`` as they travel: mixed and rounded with 16-QAM."""
    if not _may_hold(is_qam > 0):
        return analog
    rounded = nearest_level(_TO_ROUNDED * spread(analog))
    return torch.where(is_qam.view(-1, 1, 1, 1) > 0, rounded, analog)


def demodulate(y_rx: Tensor, snr_db: Tensor, is_qam: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the latent as well as it is known, with what is known about it.

    Args:
        y_rx: ``(B, C, h, w)`` MMSE-equalised values.
        snr_db: ``(B, 1, h, w)`` effective SNR of each slot on the link.
        is_qam: ``(B,)`` 1 for 16-QAM, 0 for analog.

    Returns:
        The latent, shrunk as far as it is uncertain; the SNR ``(B, 1, h, w)`` in dB at which its values
        arrived, rounding included; and the ``(B, 1, 1, 1)`` factor that undid the transmitter's division.
    """
    analog = analog_values(y_rx, snr_db, is_qam)
    snr_db = effective_snr_db(snr_db, is_qam)
    latent, scale = undo_analog(analog, shrink_of(snr_db))
    return latent, snr_db, scale


def analog_values(y_rx: Tensor, snr_db: Tensor, is_qam: Tensor) -> Tensor:
    """Return the analog values behind the link: as they arrived, or their means before they were rounded.

    Args:
        y_rx: ``(B, C, h, w)`` MMSE-equalised values.
        snr_db: ``(B, 1, h, w)`` effective SNR of each slot on the link.
        is_qam: ``(B,)`` 1 for 16-QAM, 0 for analog.
    """
    if not _may_hold(is_qam > 0):
        return y_rx
    means = unspread(mean_before_rounding(y_rx, shrink_of(snr_db))) / _TO_ROUNDED
    return torch.where(is_qam.view(-1, 1, 1, 1) > 0, means.to(y_rx.dtype), y_rx)


def mean_before_rounding(y_rx: Tensor, shrink: Tensor) -> Tensor:
    """Mean of a Gaussian value that was rounded and sent, given what was received.

    The MMSE equaliser treats a symbol as Gaussian; that it can only be one of four levels, the outer ones as
    often as the Gaussian has them, leaves a quarter less squared error at 10 dB. Where nothing arrived the
    mean is 0.

    Args:
        y_rx: ``(B, C, h, w)`` MMSE-equalised values.
        shrink: ``(B, 1, h, w)`` in [0, 1], ``snr / (1 + snr)`` of each slot.
    """
    # With u = y / shrink and noise variance v = (1 - shrink) / (2 shrink) the likelihood of a level l is
    # exp((u l - l^2 / 2) / v) or so, (2 y l - shrink l^2) / (1 - shrink) in the exponent: finite in any case.
    # Levels come in pairs, +-inner and +-3 inner; e are the odds against the negative inner level, g those of
    # the inner pair against the outer one.
    inner = 0.5 * LEVEL_STEP
    outer = 3.0 * inner
    odds = (1.0 - SHAPED_OUTER_SHARE) / SHAPED_OUTER_SHARE
    y, shrink = y_rx.float(), shrink.float().clamp_max(1.0 - 1e-4)
    certainty = 1.0 / (1.0 - shrink)
    exponent = y.abs() * (-4.0 * inner * certainty)
    e = torch.exp(exponent)
    g = odds * torch.exp((exponent + (outer**2 - inner**2) * shrink * certainty).clamp_max_(60.0))
    e3 = e * e * e
    mean = (MEAN_OUTER * (1.0 - e3) + MEAN_INNER * g * (1.0 - e)) / (g * (1.0 + e) + 1.0 + e3)
    return torch.copysign(mean, y).to(y_rx.dtype)


def undo_analog(y_rx: Tensor, shrink: Tensor, sent: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Estimate the transmitter's divisor from the carrier, undo it and take the carrier away.

    Args:
        y_rx: ``(B, C, h, w)`` MMSE-equalised values, each slot shrunk by ``shrink``.
        shrink: ``(B, 1, h, w)`` in [0, 1], ``snr / (1 + snr)`` of each slot; or ``(B, C, h, w)`` of values.
        sent: See ``analog_symbols``; ``y_rx`` is 0 where it is 0.

    Returns:
        The latent, still shrunk by ``shrink``, and the ``(B, 1, 1, 1)`` factor that was applied.
    """
    pattern = carrier_pattern(y_rx)
    if sent is not None:
        pattern = pattern * sent
    amplitude = _mean(y_rx * pattern, sent)
    amplitude = amplitude / _mean(shrink if sent is None else shrink * sent, sent).clamp_min(1e-3)
    scale = CARRIER_AMPLITUDE / amplitude.clamp_min(CARRIER_AMPLITUDE / _MAX_SCALE)
    return y_rx * scale - CARRIER_AMPLITUDE * pattern * shrink, scale
