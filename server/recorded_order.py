"""The frames of a recorded stream in order, without those whose ids later frames refute."""

import logging
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

logger = logging.getLogger(__name__)

T = TypeVar("T")

#: Frames with other ids that are looked at behind each frame.
_AHEAD = 4
#: How many of their ids must be lower for the frame to be out of order.
_AGAINST = 3


def in_order(frames: Iterable[T], id_of: Callable[[T], int]) -> Iterator[T]:
    """Yield frames whose ids rise, each once; what was sent again, or came late, is passed over.

    A frame with an id from far ahead would make all others late: one is left out, with a warning, if most of
    those that follow are below it and above what came before.

    Args:
        frames: As recorded.
        id_of: Returns a frame's id.
    """
    source = iter(frames)
    waiting: dict[int, T] = {}
    last_id = -1
    while True:
        for frame in source:
            if id_of(frame) > last_id:
                waiting.setdefault(id_of(frame), frame)
            if len(waiting) > _AHEAD:
                break
        if not waiting:
            return
        frame_id = next(iter(waiting))
        first = waiting.pop(frame_id)
        if sum(later_id < frame_id for later_id in waiting) >= _AGAINST:
            logger.warning("frame %d is left out: those that follow are below it", frame_id)
            continue
        last_id = frame_id
        waiting = {later_id: later for later_id, later in waiting.items() if later_id > last_id}
        yield first
