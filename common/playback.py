"""How the frames of a recording are played: the ranges that all programs share, and the pace of its own."""

import math

import numpy as np
from numpy.typing import NDArray

#: Between frames, where there is but one: that of ten a second.
_PERIOD_OF_ONE_NS = 1e8
#: Frames come in bunches, as a network lets them go, where some wait so many times as long as most do:
_WAIT_STEPS = 6.0
#: this share of them at least, which is one in a bunch of sixteen. A recording that paused has fewer.
_WAITS_SHARE = 1.0 / 16.0
#: A wait that is so many times as long as usual ones is a pause.
_PAUSE_WAITS = 3.0


def check_playback(
    *,
    resize: float | None = None,
    stride: int | None = None,
    max_frames: int | None = None,
    rate_hz: float | None = None,
) -> None:
    """Check what was given; None stands for nothing given.

    Args:
        resize: Factor on the image size.
        stride: One frame of so many is used.
        max_frames: Frames used at most.
        rate_hz: Frames a second.

    Raises:
        ValueError: A value is out of range.
    """
    if resize is not None and not 0.05 <= resize <= 1.0:
        raise ValueError(f"resize must be in [0.05, 1], got {resize:g}")
    for name, count in (("stride", stride), ("max_frames", max_frames)):
        if count is not None and count < 1:
            raise ValueError(f"{name} must be at least 1, got {count}")
    if rate_hz is not None and not 0.01 <= rate_hz <= 1000.0:
        raise ValueError(f"rate_hz must be in [0.01, 1000], got {rate_hz:g}")


def check_part(start_s: float, end_s: float | None) -> None:
    """Check which part of a recorded stream is taken, in seconds since it began; None is to its end.

    Raises:
        ValueError: It is none.
    """
    if not 0.0 <= start_s < math.inf:
        raise ValueError(f"start_s must be at least 0 and finite, got {start_s:g}")
    if end_s is not None and not end_s > start_s:
        raise ValueError(f"end_s must be later than start_s ({start_s:g}), got {end_s:g}")


def usual_period_ns(times_ns: NDArray[np.int64]) -> float:
    """Return the usual time between two frames, the median; that of ten a second where there is but one.

    Of frames that come in bunches the median is that within a bunch: their mean is the camera's period.

    Args:
        times_ns: ``(N,)``, increasing.
    """
    if len(times_ns) < 2:
        return _PERIOD_OF_ONE_NS
    steps_ns = np.diff(times_ns)
    waits_ns = steps_ns[steps_ns > _WAIT_STEPS * np.quantile(steps_ns, _WAITS_SHARE)]
    if len(waits_ns) < max(2.0, _WAITS_SHARE * len(steps_ns)):
        return float(np.median(steps_ns))
    return float(steps_ns[steps_ns <= _PAUSE_WAITS * np.median(waits_ns)].mean())
