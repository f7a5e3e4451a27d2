"""Times of images: nanoseconds inside, decimal seconds in files."""

from decimal import Decimal, InvalidOperation

import numpy as np
from numpy.typing import NDArray

#: The year 2255; nanoseconds beyond 2262 are no 64-bit number.
MAX_TIME_S = 9_000_000_000
MAX_TIME_NS = MAX_TIME_S * 10**9
#: Times since 1970 in milliseconds stay below this for as long.
_MAX_TIME_MS = MAX_TIME_S * 10**3


def seconds_to_ns(text: str) -> int:
    """Convert decimal seconds to nanoseconds without passing through a float.

    Raises:
        ValueError: Not a finite number, or too large for seconds since 1970.
    """
    try:
        time_s = Decimal(text)
    except InvalidOperation as err:
        raise ValueError(f"time must be a number of seconds, got {text!r}") from err
    if not time_s.is_finite():
        raise ValueError(f"time must be a number of seconds, got {text!r}")
    # Not abs(), which overflows at exponents that Decimal itself takes.
    if time_s.copy_abs() > MAX_TIME_S:
        raise ValueError(not_seconds(text, float(time_s)))
    return int((time_s * 1_000_000_000).to_integral_value())


def not_seconds(text: str, time_s: float) -> str:
    """Say what is wrong with a time that is too large for seconds since 1970."""
    unit = "milliseconds" if abs(time_s) <= _MAX_TIME_MS else "micro- or nanoseconds"
    return f"times must be in seconds, got {text}: looks like {unit}"


def ns_to_seconds(times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return ``times_ns * 1e-9``: the one conversion, so that equal frames have equal times."""
    return np.asarray(times_ns * 1e-9, dtype=np.float64)
