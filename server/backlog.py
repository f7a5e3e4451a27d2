"""Frames that wait for the decoder: a busy moment is worked off, a lasting overload gets the newest frame."""

import math
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

from semcast.common.mailbox import BoundedQueue

T = TypeVar("T")

#: Longest wait: of those that wait for more, the oldest gives way to a newer one.
MAX_WAIT_S = 0.5
#: A consumer that has not caught up after so long will not: from then on only the newest waits,
CATCH_UP_S = 1.0
#: until nothing had to give way for so long,
RECOVERY_S = 2.0
#: or until all that came in that time takes the consumer no more than this share of it, so that it is not too
#: slow: on a link with jitter frames come in bursts, and some would give way for ever.
KEEPS_UP_SHARE = 0.8
#: Whatever their rate, no more are kept.
MAX_WAITING = 64


class _Waiting(NamedTuple, Generic[T]):
    item: T
    since_s: float


class Backlog(BoundedQueue[_Waiting[T]], Generic[T]):
    """A queue bounded in time, in which newer items win; those that gave way are counted.

    Beginning a map, or another process, keeps a consumer for some tenths of a second, and then it is faster
    than what comes: nothing has to be lost for that. One that is too slow for good would only be late with
    all it does, so its queue ends after ``CATCH_UP_S``.

    Args:
        clock: Returns seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._behind_since_s: float | None = None
        self._newest_only = False
        self._last_drop_s = 0.0
        self._began_s = math.inf
        self._came_s: deque[float] = deque()
        self._took_s: deque[tuple[float, float]] = deque()  # when it was done, how long it took
        self._taken_s: float | None = None

    def put(self, item: T) -> None:
        """Add an item, also where older ones give way to it; a closed queue takes none."""
        with self._changed:
            if self._closed:
                return
            now_s = self._clock()
            self._began_s = min(self._began_s, now_s)
            self._came_s.append(now_s)
            self._items.append(_Waiting(item, now_s))
            self._thin_out(now_s)
            self._changed.notify_all()

    def get(self, timeout_s: float | None = None) -> T | None:
        """Take the oldest item; None when there was none in time, or the queue is closed and empty."""
        with self._changed:
            self._note_done(self._clock())
            self._changed.wait_for(lambda: bool(self._items) or self._closed, timeout_s)
            if not self._items:
                return None
            now_s = self._clock()
            self._thin_out(now_s)
            item, self._taken_s = self._items.popleft().item, now_s
            if not self._items:
                self._behind_since_s = None
            elif self._behind_since_s is None:
                self._behind_since_s = now_s
            return item

    def _note_done(self, now_s: float) -> None:
        """The consumer is done with what it took last."""
        if self._taken_s is not None:
            self._took_s.append((now_s, now_s - self._taken_s))
            self._taken_s = None

    def _keeps_up(self, now_s: float) -> bool:
        """Whether the consumer would have got through all that came in the last ``RECOVERY_S``."""
        since_s = now_s - RECOVERY_S
        while self._came_s and self._came_s[0] < since_s:
            self._came_s.popleft()
        while self._took_s and self._took_s[0][0] < since_s:
            self._took_s.popleft()
        if not self._took_s:
            return False
        each_s = sum(took_s for _, took_s in self._took_s) / len(self._took_s)
        return each_s * len(self._came_s) <= KEEPS_UP_SHARE * (now_s - max(since_s, self._began_s))

    def _thin_out(self, now_s: float) -> None:
        """Let older items give way, as it is time; the newest stays."""
        if self._keeps_up(now_s):
            self._newest_only = False
        elif self._behind_since_s is not None and now_s - self._behind_since_s > CATCH_UP_S:
            self._newest_only, self._last_drop_s = True, now_s
        elif now_s - self._last_drop_s > RECOVERY_S:
            self._newest_only = False
        while len(self._items) > 1 and (
            self._newest_only or now_s - self._items[0].since_s > MAX_WAIT_S or len(self._items) > MAX_WAITING
        ):
            self._items.popleft()
            self._dropped += 1
            self._last_drop_s = now_s

    def clear(self) -> int:
        """Throw everything away and return how many items that were; they don't count as ``dropped``."""
        with self._changed:
            self._behind_since_s = None
            return super().clear()
