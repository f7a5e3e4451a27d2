"""Waiting for what other threads and processes do, with a deadline."""

import threading
import time
from collections.abc import Callable


def came_true(condition: Callable[[], object], deadline_s: float) -> bool:
    """Tell whether a condition comes true in time; the interval only bounds how late it is noticed."""
    end_s = time.monotonic() + deadline_s
    tick = threading.Event()
    while not condition():
        if time.monotonic() > end_s:
            return False
        tick.wait(0.005)
    return True


def until(condition: Callable[[], object], what: str = "the condition", deadline_s: float = 60.0) -> None:
    """Wait for a condition.

    Raises:
        AssertionError: It does not come true in time.
    """
    assert came_true(condition, deadline_s), f"{what} did not come true within {deadline_s:g} s"
