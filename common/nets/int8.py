"""Convolutions of eight-bit integers, faster than float32 where that is the alternative.

Weights are rounded to seven bits, with a scale for each output channel: on processors without VNNI a sum of
two products of eight bits would overflow. Activations have eight bits, their range is that of the frame at
hand, so nothing has to be learned from images beforehand and no frame falls out of a range.
"""

import platform
from functools import cache

import cv2
import numpy as np
import torch
from torch import Tensor

_MAX_WEIGHT, _MAX_ACTIVATION = 63, 255
#: Of activations that are all zero.
_LEAST_RANGE = 1e-6


class Int8Conv:
    """A convolution of one frame in integers; its input and output are float32.

    Args:
        weight: ``(C_out, C_in, kh, kw)`` float32.
        bias: ``(C_out,)`` or None.
        stride: Of rows and columns.
        padding: Zeros on each side, of rows and columns.
    """

    def __init__(
        self, weight: Tensor, bias: Tensor | None, stride: tuple[int, ...], padding: tuple[int, ...]
    ) -> None:
        # A channel without weights has a scale all the same.
        self._scale = (weight.abs().amax((1, 2, 3)) / _MAX_WEIGHT).clamp_min(1e-12)
        rounded = torch.round(weight / self._scale[:, None, None, None]).to(torch.int8)
        self._no_shift = torch.zeros(weight.shape[0], dtype=torch.long)
        self._bias, self._stride, self._padding = bias, list(stride), list(padding)
        # The scale of activations plays no part in the layout; that they have a zero point does.
        self._weight = torch.ops.onednn.qconv_prepack(
            rounded, self._scale, 1.0, 1, self._stride, self._padding, [1, 1], 1, None
        )

    def __call__(self, x: Tensor) -> Tensor:
        """Convolve ``(1, C, h, w)`` channels_last, float32."""
        _, channels, height, width = x.shape
        rows = x[0].permute(1, 2, 0).contiguous()
        least, most = (value.item() for value in torch.aminmax(rows))
        least = min(least, 0.0)  # zero, of which padding is made, must be among the values
        scale = max(most - least, _LEAST_RANGE) / _MAX_ACTIVATION
        zero = round(-least / scale)
        values = np.empty((height * width, channels), dtype=np.uint8)
        # One pass: scaled, shifted, rounded and clipped.
        cv2.convertScaleAbs(rows.view(-1, channels).numpy(), dst=values, alpha=1.0 / scale, beta=zero)
        quantised = torch.from_numpy(values).view(1, height, width, channels).permute(0, 3, 1, 2)
        y: Tensor = torch.ops.onednn.qconv_pointwise(
            quantised,
            scale,
            zero,
            self._weight,
            self._scale,
            self._no_shift,
            self._bias,
            self._stride,
            self._padding,
            [1, 1],
            1,
            1.0,
            0,
            torch.float32,
            "none",
            [],
            "",
        )
        return y


@cache
def has_int8() -> bool:
    """Tell whether convolutions of eight bits are fast on this CPU, and right with the installed torch.

    They are not part of what torch promises to keep, so what they compute is compared once.
    """
    if platform.machine().lower() not in ("x86_64", "amd64") or not torch.cpu._is_avx2_supported():
        return False
    generator = torch.Generator().manual_seed(0)
    weight = torch.randn(8, 16, 3, 3, generator=generator)
    x = torch.randn(1, 16, 9, 12, generator=generator).contiguous(memory_format=torch.channels_last)
    exact = torch.conv2d(x, weight, None, 1, 1)
    try:
        error = Int8Conv(weight, None, (1, 1), (1, 1))(x) - exact
    except (AttributeError, RuntimeError, TypeError):
        return False
    return bool(error.std() < 0.05 * exact.std())
