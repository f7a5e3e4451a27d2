"""Keeps Ctrl-C away from where it would do harm: what is being imported, and children of this process."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager


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
