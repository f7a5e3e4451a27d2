"""Holds packets back for the delay and jitter of a link; they leave in the order they came."""

import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from semcast.common.errors import tell_nobody
from semcast.common.worker_guard import WorkerGuard

#: Ten seconds of delay at 50 frames per second,
CAPACITY = 512
#: and at 30 of 1920x1080; a packet of the largest frames has 16 MiB.
CAPACITY_BYTES = 512 * 1024**2
_JITTER_STREAM = 0x717


def extra_delay_ms(mean_ms: float, seed: int, frame_id: int) -> float:
    """Draw the jitter of a frame in ms, exponential: by its number, whatever became of the others.

    Args:
        mean_ms: At least 0.
        seed: Of the channel.
        frame_id: Number of the frame.
    """
    rng = np.random.default_rng((seed, _JITTER_STREAM, frame_id))
    return mean_ms * float(rng.standard_exponential())


class DelayLine:
    """Calls ``send`` for each packet when its time has come, on a thread of its own when it must wait.

    A radio link doesn't reorder: a packet leaves no sooner than the one before it.

    Args:
        send: Gets the packet. Where it fails on the line's thread, that packet is lost and the next one sent.
        on_failure: Is told in a line what failed there.
        capacity_bytes: How much may wait.
    """

    def __init__(
        self,
        send: Callable[[bytes, bool], None],
        on_failure: Callable[[str], None] = tell_nobody,
        capacity_bytes: int = CAPACITY_BYTES,
    ) -> None:
        self._send = send
        self._capacity_bytes = capacity_bytes
        self._waiting: deque[tuple[float, bytes, bool]] = deque()
        self._waiting_bytes = 0
        self._changed = threading.Condition()
        self._sending = False
        self._last_due_s = 0.0
        self._closed = False
        self._guard = WorkerGuard("sending a delayed packet", on_failure)
        self._thread = threading.Thread(target=self._run, name="semcast-delay", daemon=True)
        self._thread.start()

    def put(self, packet: bytes, lossless: bool, delay_ms: float) -> bool:
        """Take a packet; without any delay it is sent at once, by the caller.

        Returns:
            False when too many or too large packets wait already, or the line is closed; it is dropped then.
        """
        due_s = time.monotonic() + 1e-3 * delay_ms
        with self._changed:
            if self._closed:
                return False
            at_once = delay_ms == 0.0 and not self._waiting and not self._sending
            if not at_once:
                is_full = self._waiting_bytes + len(packet) > self._capacity_bytes
                if len(self._waiting) >= CAPACITY or is_full:
                    return False
                self._last_due_s = max(self._last_due_s, due_s)
                self._waiting.append((self._last_due_s, packet, lossless))
                self._waiting_bytes += len(packet)
                self._changed.notify_all()
        if at_once:
            self._send(packet, lossless)
        return True

    def _run(self) -> None:
        while True:
            with self._changed:
                self._sending = False
                self._changed.wait_for(lambda: bool(self._waiting) or self._closed)
                if self._closed:
                    return
                due_s, packet, lossless = self._waiting[0]
                remaining_s = due_s - time.monotonic()
                if remaining_s > 0:
                    self._changed.wait(remaining_s)
                    continue
                self._waiting.popleft()
                self._waiting_bytes -= len(packet)
                self._sending = True
            with self._guard:
                self._send(packet, lossless)

    def close(self) -> None:
        """Drop what still waits and end the thread. Idempotent."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(2.0)
