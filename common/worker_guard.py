"""What the top of a worker thread does with an exception nobody expected: the thread goes on without it."""

import logging
from collections.abc import Callable
from types import TracebackType
from typing import Self

from semcast.common.errors import tell_nobody

logger = logging.getLogger(__name__)

#: Different exceptions that are logged of one worker; an endless stream of them must not fill the disk.
MAX_LOGGED = 20


class WorkerGuard:
    """Goes around one round of a worker's loop, and around one at a time.

    An exception ends the round and not the thread: it is logged with its traceback, once where it comes again
    and again. Without that the thread would be dead, and who waits for it wait for ever.

    Args:
        what: What a round does, for the log: "sending the status".
        on_failure: Is told in a line what failed, each time: it counts, and brings the worker into a state
            from which it goes on.

    Example:
        >>> guard = WorkerGuard("dividing", on_failure=print)
        >>> for divisor in (1, 0, 2):
        ...     with guard:
        ...         print(2 // divisor)
        2
        dividing failed: integer division or modulo by zero
        1
    """

    def __init__(self, what: str, on_failure: Callable[[str], None] = tell_nobody) -> None:
        self._what = what
        self._on_failure = on_failure
        self._logged: set[str] = set()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if not isinstance(error, Exception):
            return False
        text = f"{self._what} failed: {str(error) or type(error).__name__}"
        if text not in self._logged and len(self._logged) < MAX_LOGGED:
            self._logged.add(text)
            logger.error("%s", text, exc_info=error)
        self._on_failure(text)
        return True
