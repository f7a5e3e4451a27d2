"""The end of a process in which a thread is still at work in a library.

As the interpreter ends, a daemon thread that comes back from OpenCV or torch is ended by unwinding its stack,
through C++ that allows none: "terminate called without an active exception", and the process aborts.
"""

import atexit
import contextlib
import os
import sys
import threading
from collections.abc import Callable


def leave_busy_threads() -> Callable[[int], int]:
    """Let this process end with its exit code also where threads of ours still work: they are left.

    To be called before libraries are imported, so that what these do in the end is done before.

    Returns:
        What takes the exit code, and gives it back; until then it is that of an unforeseen error.
    """
    exit_code = 1

    def note(code: int) -> int:
        nonlocal exit_code
        exit_code = code
        return code

    def end() -> None:
        if not any(thread.name.startswith("semcast-") for thread in threading.enumerate()):
            return
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(AttributeError, OSError, ValueError):  # none, unwritable or closed
                stream.flush()
        os._exit(exit_code)

    atexit.register(end)
    return note
