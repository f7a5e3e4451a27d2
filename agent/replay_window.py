"""Lossless sending: keep what is not confirmed, send no more than is asked for, repeat what got lost."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from semcast.common.messages import FlowMessage, SymbolFrame

RESEND_AFTER_S = 1.0
_MOST_PATIENCE = 8


class ReplayWindow:
    """Go-back-N over frames. Not synchronised; no network, no clock of its own.

    The receiver says how far it is (``FlowMessage``). Frames its consumer is done with are forgotten, frames
    that arrived are not sent again unless the receiver was restarted, the others are repeated when nothing
    arrived for a while: so channel and server may be restarted and no frame is missing afterwards.

    Args:
        agent_epoch: Flow about other epochs only tells that a receiver is there.
        clock_s: Monotonic clock.
        resend_after_s: Patience before unconfirmed frames are sent again; it doubles each time in vain.
    """

    def __init__(
        self,
        agent_epoch: int,
        clock_s: Callable[[], float] = time.monotonic,
        resend_after_s: float = RESEND_AFTER_S,
    ) -> None:
        self._agent_epoch = agent_epoch
        self._clock_s = clock_s
        self._resend_after_s = resend_after_s
        self._kept: deque[SymbolFrame] = deque()
        self._base_seq = 0
        self._arrived_seq = 0
        self._sent_seq = 0
        self._next_seq = 0
        self._window = 0
        self._progress_s = clock_s()
        self._patience = 1

    @property
    def has_room(self) -> bool:
        """Whether the receiver wants another frame."""
        return self._next_seq < self._base_seq + self._window

    @property
    def is_wanted(self) -> bool:
        """Whether a receiver has asked for frames yet."""
        return self._window > 0

    @property
    def all_taken(self) -> bool:
        """Whether the receiver's consumer is done with every frame."""
        return not self._kept

    def on_flow(self, flow: FlowMessage) -> None:
        """Take the receiver's word."""
        self._window = flow.window
        if flow.agent_epoch != self._agent_epoch:
            if self._arrived_seq > self._base_seq:
                # A receiver that knows nothing of us is a new one: what the old one had is gone.
                self._arrived_seq = self._base_seq
                self._sent_seq = self._base_seq
            return
        if flow.arrived_seq > self._arrived_seq:
            self._progress_s, self._patience = self._clock_s(), 1
        if flow.next_seq > self._base_seq:
            self._base_seq = min(flow.next_seq, self._next_seq)
            while self._kept and self._kept[0].seq < self._base_seq:
                self._kept.popleft()
        self._arrived_seq = max(self._base_seq, min(flow.arrived_seq, self._next_seq))

    def add(self, frame: SymbolFrame) -> None:
        """Take the next frame to send.

        Raises:
            ValueError: Its ``seq`` does not follow the last one.
        """
        if frame.seq != self._next_seq:
            raise ValueError(f"seq must be {self._next_seq}, got {frame.seq}")
        self._kept.append(frame)
        self._next_seq += 1

    def due(self) -> list[SymbolFrame]:
        """Return what must be sent now, oldest first: new frames, and all that got lost."""
        now_s = self._clock_s()
        waiting = self._sent_seq > self._arrived_seq
        if waiting and now_s - self._progress_s >= self._resend_after_s * self._patience:
            self._sent_seq = self._arrived_seq
            self._patience = min(2 * self._patience, _MOST_PATIENCE)
        frames = [f for f in self._kept if f.seq >= max(self._sent_seq, self._arrived_seq)]
        if frames:
            if self._sent_seq <= self._arrived_seq:
                self._progress_s = now_s
            self._sent_seq = frames[-1].seq + 1
        return [replace(f, base_seq=self._base_seq) for f in frames]
