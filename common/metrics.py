"""What a process counts about itself: rates, stage times, drops by reason, the last error."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from semcast.common.message_fields import MAX_COUNT, sendable
from semcast.common.messages import StatusMessage

#: Times kept per stage, and so what percentiles are over.
WINDOW = 512
RATE_WINDOW_S = 5.0
STATUS_INTERVAL_S = 1.0


#: The reason of drops by which nothing is lost: the frame had come before.
DUPLICATE = "duplicate"


def drops_in_words(drops: Mapping[str, int]) -> str:
    """Say how many frames were dropped for which reason, and apart from those how many came twice."""
    lost = ", ".join(
        f"{number} {reason}" for reason, number in sorted(drops.items()) if number and reason != DUPLICATE
    )
    repeated = drops.get(DUPLICATE, 0)
    return f"dropped: {lost or 'none'}" + (f"; came twice: {repeated}" if repeated else "")


def frames_in_words(event: str, count: int, drops: Mapping[str, int]) -> str:
    """Say to how many frames something happened, and how many were dropped for which reason."""
    return f"{count} {'frame' if count == 1 else 'frames'} {event}; {drops_in_words(drops)}"


def duration_percentiles(values_ms: Iterable[float]) -> dict[str, float] | None:
    """Return ``p50``, ``p95`` and ``max``, without values that are not finite; None where there are none."""
    values = np.fromiter(values_ms, dtype=np.float64)
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return None
    p50, p95, most = np.percentile(values, (50, 95, 100)).tolist()
    return {"p50": p50, "p95": p95, "max": most}


class Metrics:
    """Counters of one process. Safe to use from several threads.

    Args:
        role: ``agent``, ``channel`` or ``server``.
        clock_ns: Monotonic clock, for tests.
    """

    def __init__(self, role: str, clock_ns: Callable[[], int] = time.perf_counter_ns) -> None:
        self._role = role
        self._clock_ns = clock_ns
        self._start_ns = clock_ns()
        self._lock = threading.Lock()
        self._counts: dict[str, int] = {}
        self._drops: dict[str, int] = {}
        self._events_ns: dict[str, deque[int]] = {}
        self._stages_ms: dict[str, deque[float]] = {}
        self._last_error = ""
        self._activity = ""
        self._ended = False

    def count(self, event: str) -> None:
        """Count an event; its rate is reported too."""
        now_ns = self._clock_ns()
        with self._lock:
            self._counts[event] = self._counts.get(event, 0) + 1
            times_ns = self._events_ns.setdefault(event, deque())
            times_ns.append(now_ns)
            self._forget(times_ns, now_ns)

    def drop(self, reason: str, by: int = 1) -> None:
        """Count dropped frames; ``by`` 0 is allowed and counts nothing."""
        if by:
            with self._lock:
                self._drops[reason] = min(self._drops.get(reason, 0) + by, MAX_COUNT)

    def observe(self, stage: str, duration_ms: float) -> None:
        """Add the duration of one run of a stage."""
        with self._lock:
            self._stages_ms.setdefault(stage, deque(maxlen=WINDOW)).append(duration_ms)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the body of a ``with`` as one run of a stage, also when it raises."""
        started_ns = self._clock_ns()
        try:
            yield
        finally:
            self.observe(name, (self._clock_ns() - started_ns) * 1e-6)

    def error(self, text: str) -> None:
        """Remember one line on what went wrong, be it an error or only warned of, as the last error."""
        with self._lock:
            self._last_error = sendable(text, 1000)
            self._counts["errors"] = self._counts.get("errors", 0) + 1

    def end(self) -> None:
        """Let the status say from now on that there is no more to do."""
        with self._lock:
            self._ended = True

    def be_at(self, activity: str) -> None:
        """Note what the process is at besides frames, in a few words; empty when it is done with that."""
        with self._lock:
            self._activity = sendable(activity, 200)

    @property
    def drops(self) -> dict[str, int]:
        """Dropped frames by reason, since the start."""
        with self._lock:
            return dict(self._drops)

    @property
    def counts(self) -> dict[str, int]:
        """Events since the start."""
        with self._lock:
            return dict(self._counts)

    def closing_line(self, event: str) -> str:
        """Say how often something happened and what was dropped, for the end of a process."""
        return frames_in_words(event, self.counts.get(event, 0), self.drops)

    @staticmethod
    def _forget(times_ns: deque[int], now_ns: int) -> None:
        while times_ns and now_ns - times_ns[0] > RATE_WINDOW_S * 1e9:
            times_ns.popleft()

    def rates_hz(self) -> dict[str, float]:
        """Events per second over the last five seconds, or since the start where that is shorter."""
        now_ns = self._clock_ns()
        over_s = max(min(RATE_WINDOW_S, (now_ns - self._start_ns) * 1e-9), 1e-3)
        with self._lock:
            for times_ns in self._events_ns.values():
                self._forget(times_ns, now_ns)
            return {event: len(times_ns) / over_s for event, times_ns in self._events_ns.items()}

    def stages_ms(self) -> dict[str, dict[str, float]]:
        """Stage to ``duration_percentiles`` of its last runs."""
        with self._lock:
            kept = {stage: list(values) for stage, values in self._stages_ms.items()}
        found = {stage: duration_percentiles(values) for stage, values in kept.items()}
        return {stage: figures for stage, figures in found.items() if figures is not None}

    def status(self, agent_epoch: int) -> StatusMessage:
        """Return the message that is sent once a second."""
        with self._lock:
            last_error, activity, ended = self._last_error, self._activity, self._ended
        return StatusMessage(
            role=self._role,
            agent_epoch=agent_epoch,
            uptime_s=(self._clock_ns() - self._start_ns) * 1e-9,
            rates_hz=self.rates_hz(),
            counts=self.counts,
            drops=self.drops,
            stages_ms={stage: (f["p50"], f["p95"], f["max"]) for stage, f in self.stages_ms().items()},
            last_error=last_error,
            activity=activity,
            ended=ended,
        )

    def summary(self) -> dict[str, Any]:
        """Return counts, drops and stage times as plain values, for a run's summary."""
        return {
            "counts": self.counts,
            "drops": self.drops,
            "stage_ms": self.stages_ms(),
        }
