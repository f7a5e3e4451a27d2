"""Signals that end a run: what they do for a while, and Ctrl-C kept away from where it would do harm."""

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager


def ending_signals() -> list[signal.Signals]:
    """Return SIGTERM, a request to end, and SIGHUP, which comes when the terminal or its connection is gone.

    Under nohup, which has it ignored, a hang-up is to do nothing, and is left out.
    """
    hang_up = getattr(signal, "SIGHUP", None)  # Windows has none
    if hang_up is None or signal.getsignal(hang_up) is signal.SIG_IGN:
        return [signal.SIGTERM]
    return [signal.SIGTERM, hang_up]


@contextmanager
def signals_handled(
    numbers: Sequence[signal.Signals], handle: Callable[[int, object], None]
) -> Iterator[None]:
    """Have a function handle signals in this context, and then what handled them before.

    Only the main thread may set handlers: in others nothing changes.

    Args:
        numbers: The signals.
        handle: Is given the number of the one that came, and the frame it came in.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def ctrl_c_held() -> Iterator[None]:
    """Hold Ctrl-C back until the block ends; it then does what it would have done."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def deaf_children() -> Iterator[None]:
    """Do as ``ctrl_c_held``, and let it never reach the ``multiprocessing`` children started in the block.

    A terminal sends Ctrl-C to them as well, also in their first moments, when they can't yet ignore it.
    """
    if hasattr(signal, "pthread_sigmask"):
        from multiprocessing import resource_tracker  # takes as long to import as all the rest

        # Started with the first child, it would let the signal through again.
        resource_tracker.ensure_running()
    with ctrl_c_held():
        yield
