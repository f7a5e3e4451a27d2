"""Child processes end with their parent, also where that is killed and can ask nobody to end."""

import logging
import multiprocessing
import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

logger = logging.getLogger(__name__)

#: Environment variable with the process a role belongs to.
_VARIABLE = "SEMCAST_PARENT_PID"
_LOOK_INTERVAL_S = 0.5


def bound_to_this() -> Mapping[str, str]:
    """Return an environment for child processes that are to end with this one."""
    return {**os.environ, _VARIABLE: str(os.getpid())}


@contextmanager
def stop_with_parent(stop: threading.Event) -> Iterator[None]:
    """Set ``stop`` when the process is gone that ``bound_to_this`` was called in; else do nothing.

    The system gives an orphan another parent at once, wherever there are parents.
    """
    parent = os.environ.get(_VARIABLE)
    if parent is None:
        yield
        return
    done = threading.Event()

    def watch() -> None:
        while str(os.getppid()) == parent:
            if done.wait(_LOOK_INTERVAL_S):
                return
        logger.warning("the process that started this one is gone: it ends as well")
        stop.set()

    thread = threading.Thread(target=watch, name="semcast-parent", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def end_with_parent() -> None:
    """Let a ``multiprocessing`` child end at once when its parent is gone; called in the child.

    One that waits for work would wait for ever.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, name="semcast-parent", daemon=True).start()
