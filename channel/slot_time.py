"""Slots in time: whether a frame is over before the next one begins."""

import logging

logger = logging.getLogger(__name__)


class SlotTime:
    """Warns where frames of one link overlap, since slots at the same time have the same fading.

    It does so once for each number of slots and duration.
    """

    def __init__(self) -> None:
        self._start_s: float | None = None
        self._end_s = 0.0
        self._told: set[tuple[int, float]] = set()

    def restart(self) -> None:
        """Take the next frame for the first one; what was warned of is not warned of again."""
        self._start_s = None

    def check(self, num_slots: int, slot_ms: float, t_s: float) -> None:
        """Take the next frame into account.

        Args:
            num_slots: Of the frame.
            slot_ms: Duration of each.
            t_s: When it begins; what is sent again, or before the last frame, says nothing.
        """
        before_s, slots = self._start_s, (num_slots, slot_ms)
        if before_s is not None and before_s < t_s < self._end_s - 1e-6 and slots not in self._told:
            self._told.add(slots)
            logger.warning(
                "a frame lasts %.3g ms (%d slots of slot_ms %g) and the next began %.3g ms after it: where "
                "they overlap they have the same fading",
                *(1e3 * (self._end_s - before_s), num_slots, slot_ms, 1e3 * (t_s - before_s)),
            )
        if before_s is None or t_s > before_s:
            self._start_s, self._end_s = t_s, t_s + 1e-3 * slot_ms * num_slots
