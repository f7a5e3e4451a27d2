"""Former starts of an agent, of which frames may still come when it was started again."""

import time

#: How long after a restart of the agent its former start's frames may still come: above any channel's delay.
STRAGGLER_NS = 20_000_000_000


class FormerStarts:
    """Tells stragglers of a former start from the frames of one that lives. Used from one thread."""

    def __init__(self) -> None:
        self._epochs: set[int] = set()
        self._begun_ns = 0

    def begin(self, agent_epoch: int) -> None:
        """Note that a start is the present one from now on."""
        self._epochs.discard(agent_epoch)
        self._begun_ns = time.perf_counter_ns()

    def end(self, agent_epoch: int, *, had_frames: bool) -> None:
        """Note that a start is the present one no longer; if it had frames, none before it lives."""
        if had_frames:
            self._epochs.clear()
        self._epochs.add(agent_epoch)

    def is_straggler(self, agent_epoch: int, t_arrival_ns: int) -> bool:
        """Tell whether a frame is of a former start, while there is none of the present one yet.

        Such a frame was decoded, or on its way, when the present start was announced. If frames of the former
        one keep coming, it is the one that lives.

        Args:
            agent_epoch: Of the frame.
            t_arrival_ns: When it came, by ``perf_counter_ns``.
        """
        return agent_epoch in self._epochs and t_arrival_ns - self._begun_ns < STRAGGLER_NS
