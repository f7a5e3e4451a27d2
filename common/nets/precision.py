"""What the convolutions of a learned codec are computed in, by what the hardware is fast in."""

import os

import torch

from semcast.common.codec import Precision
from semcast.common.errors import ConfigError
from semcast.common.nets.int8 import has_int8

#: Parts of the names of oneDNN's instruction sets that multiply bfloat16.
_ISA_WITH_BFLOAT16 = ("BF16", "AMX", "FP16", "AVX10")


def has_fast_bfloat16() -> bool:
    """Tell whether this CPU multiplies bfloat16 in hardware (AVX512-BF16 or AMX), and oneDNN may use it.

    Held to less by ``ONEDNN_MAX_CPU_ISA``, oneDNN would emulate it, far slower than float32.
    """
    allowed = os.environ.get("ONEDNN_MAX_CPU_ISA", os.environ.get("DNNL_MAX_CPU_ISA", "")).upper()
    if allowed not in ("", "ALL", "DEFAULT") and not any(word in allowed for word in _ISA_WITH_BFLOAT16):
        return False
    probe = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return bool(probe()) if probe is not None else False


def dtype_for(precision: Precision, device: torch.device, can_be_int8: bool) -> torch.dtype:
    """Return what convolutions are computed in.

    Args:
        precision: ``auto``: bfloat16 where it is in hardware, otherwise int8 where there is that, otherwise
            float32.
        device: Where they are computed.
        can_be_int8: The network can be arranged for it.

    Raises:
        ConfigError: This network can't be computed in that precision here.
    """
    usable = {}
    if device.type == "cuda" or has_fast_bfloat16():
        usable["bfloat16"] = torch.bfloat16
    if device.type == "cpu" and can_be_int8 and has_int8():
        usable["int8"] = torch.int8
    usable["float32"] = torch.float32
    if precision == "auto":
        return next(iter(usable.values()))
    if precision not in usable:
        names = ", ".join(["auto", *usable])
        raise ConfigError(f"precision must be one of {names} for this codec and machine, got {precision!r}")
    return usable[precision]
