"""When nothing more of a stream is to come."""

import contextlib

from semcast.common.keys import status_key
from semcast.common.messages import CameraInfo, StatusMessage, SymbolFrame
from semcast.common.transport import Session
from semcast.common.wire import WireError, unpack
from semcast.server.arrival import SILENCE_NS
from semcast.server.stream_identity import is_nearly_final

#: How long stragglers are waited for after the source's last frame.
FINAL_IDLE_S = 0.5
#: The last frames may be lost on the air: so long after an agent is gone, or said that it sent all.
AGENT_GONE_S = 2.0
#: How long another agent of the same name is waited for that is still there: its frames count again after a
#: silence of the one that has ended.
ANOTHER_AGENT_S = SILENCE_NS * 1e-9 + 1.0
#: Starts of an agent that are remembered.
_REMEMBERED = 16


class StreamEnd:
    """Notes what tells the end of a stream. Used from one thread, but for what the agent says itself.

    Attributes:
        has_begun: A frame of the stream came.
        complete: The source came to its end.
    """

    def __init__(self, session: Session, agent_id: str) -> None:
        self.has_begun = self.complete = self._is_near = False
        self._num_sent: dict[int, int] = {}
        session.subscribe(status_key(agent_id, "agent"), "newest", self._on_status)

    def _on_status(self, payload: bytes) -> None:
        with contextlib.suppress(WireError):  # of no use to anybody, and counted nowhere
            status = unpack(payload, StatusMessage)
            if status.ended:
                self._num_sent[status.agent_epoch] = status.counts.get("sent", 0)
                if len(self._num_sent) > _REMEMBERED:
                    # Not the lowest one: that of an agent whose clock was set back is the newest.
                    del self._num_sent[next(iter(self._num_sent))]

    def begin(self) -> None:
        """Begin on another stream."""
        self.has_begun = self.complete = self._is_near = False

    def note(self, message: SymbolFrame, camera: CameraInfo) -> None:
        """Take a frame that was decoded."""
        self.has_begun, self.complete = True, message.final
        self._is_near = is_nearly_final(message.frame_id, camera)

    def num_sent(self, agent_epoch: int) -> int | None:
        """Return how many frames an agent sent whose source came to its end; None as long as it did not."""
        return self._num_sent.get(agent_epoch)

    def has_come(self, agent_epoch: int, idle_s: float, *, agent_is_there: bool, is_busy: bool) -> bool:
        """Tell whether the stream has ended.

        Args:
            agent_epoch: Of the stream.
            idle_s: Since its last frame arrived, or came to the tracker if that was later.
            agent_is_there: An agent of this name is alive.
            is_busy: A frame is being decoded, or waits to be tracked.
        """
        if self.complete:
            return idle_s >= (ANOTHER_AGENT_S if agent_is_there else FINAL_IDLE_S)
        is_left = self._is_near and not agent_is_there
        if idle_s >= AGENT_GONE_S and not is_busy and (is_left or agent_epoch in self._num_sent):
            self.complete = True
        return self.complete
