"""Bounded queues between threads, each with a named policy for what happens when it is full."""

import threading
from collections import deque
from typing import Generic, Literal, TypeVar

T = TypeVar("T")

Policy = Literal["newest", "all"]


class BoundedQueue(Generic[T]):
    """What every queue of this kind has: it can be closed, emptied, and knows how many items gave way."""

    def __init__(self) -> None:
        self._items: deque[T] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._dropped = 0

    @property
    def dropped(self) -> int:
        """Items that gave way to newer ones."""
        with self._changed:
            return self._dropped

    @property
    def closed(self) -> bool:
        """Whether ``close`` was called."""
        with self._changed:
            return self._closed

    def __len__(self) -> int:
        with self._changed:
            return len(self._items)

    def clear(self) -> int:
        """Throw everything away and return how many items that were; they don't count as ``dropped``."""
        with self._changed:
            count = len(self._items)
            self._items.clear()
            self._changed.notify_all()
            return count

    def close(self) -> None:
        """Refuse further items and wake all who wait; what is inside can still be taken. Idempotent."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class Mailbox(BoundedQueue[T]):
    """A queue of at most ``capacity`` items.

    Args:
        capacity: At least 1.
        policy: ``newest``: a full box throws its oldest item away and counts it; ``all``: ``put`` waits.

    Raises:
        ValueError: An argument is out of range.
    """

    def __init__(self, capacity: int, policy: Policy) -> None:
        if capacity < 1:
            raise ValueError(f"capacity must be at least 1, got {capacity}")
        if policy not in ("newest", "all"):
            raise ValueError(f"policy must be newest or all, got {policy!r}")
        super().__init__()
        self._capacity = capacity
        self._policy = policy

    def resize(self, capacity: int) -> None:
        """Change the capacity; items beyond it leave with the next ``put``.

        Raises:
            ValueError: The capacity is not at least 1.
        """
        if capacity < 1:
            raise ValueError(f"capacity must be at least 1, got {capacity}")
        with self._changed:
            self._capacity = capacity
            self._changed.notify_all()

    def put(self, item: T, timeout_s: float | None = None) -> int | None:
        """Add an item.

        Args:
            item: What to add.
            timeout_s: How long to wait for room under ``all``; None for as long as it takes.

        Returns:
            How many items gave way to it; None when the box is closed, or was full for the whole time: the
            item is not in it then.
        """
        with self._changed:
            if self._policy == "all":
                self._changed.wait_for(lambda: self._closed or len(self._items) < self._capacity, timeout_s)
            if self._closed or (self._policy == "all" and len(self._items) >= self._capacity):
                return None
            gave_way = max(0, len(self._items) + 1 - self._capacity)
            for _ in range(gave_way):
                self._items.popleft()
            self._dropped += gave_way
            self._items.append(item)
            self._changed.notify_all()
            return gave_way

    def get(self, timeout_s: float | None = None) -> T | None:
        """Take the oldest item; None when there was none in time, or the box is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._items) or self._closed, timeout_s)
            if not self._items:
                return None
            item = self._items.popleft()
            self._changed.notify_all()
            return item
