"""The way to a live viewer, which may be missing, frozen, killed or late: who comes gets the whole scene."""

import logging
from collections.abc import Callable

from semcast.server.view.process import is_listening
from semcast.server.view.rerun_viewer import Delivery, RerunStream
from semcast.server.view.scene import Changes, Cursor

logger = logging.getLogger(__name__)

FLUSH_TIMEOUT_S = 1.0
#: After so many connections in a row that took nothing, or could not be served, what listens is left alone
#: until it no longer does.
MAX_REFUSALS = 5


class LiveStream:
    """Connects to whatever viewer listens, and sends it what it lacks. Used from one thread.

    Args:
        open_stream: Connects to the viewer.
        changes_since: Returns what a viewer lacks and moves its cursor on.
        port: Where a viewer listens, on loopback.

    Attributes:
        num_connections: Viewers that were connected to.
    """

    def __init__(
        self, open_stream: Callable[[], RerunStream], changes_since: Callable[[Cursor], Changes], port: int
    ) -> None:
        self._open_stream = open_stream
        self._changes_since = changes_since
        self._port = port
        self._stream: RerunStream | None = None
        self._cursor = Cursor()
        self._is_stalled = False
        self._num_refusals = 0
        self.num_connections = 0

    @property
    def is_connected(self) -> bool:
        """Whether there is a viewer, as far as is known."""
        return self._stream is not None

    @property
    def is_stalled(self) -> bool:
        """Whether the viewer does not answer; what it lacks waits until it does."""
        return self._is_stalled

    def serve(self, *, may_connect: bool) -> None:
        """Send the viewer what it lacks, after connecting where there is none yet and one listens."""
        if self._stream is None:
            listening = may_connect and is_listening(self._port)
            if not listening:
                self._num_refusals = 0
            elif self._num_refusals < MAX_REFUSALS:
                self._stream, self._cursor = self._open_stream(), Cursor()
                self.num_connections += 1
                logger.info("viewer connected on port %d", self._port)
        if self._stream is None:
            return
        if not self._is_stalled:
            changes = self._changes_since(self._cursor)
            if not changes.empty or self._stream.is_holding:
                self._stream.write(changes)
        delivery = self._stream.flush(FLUSH_TIMEOUT_S)
        if delivery is Delivery.DONE:
            self._num_refusals = 0
        if delivery is Delivery.SEVERED:
            logger.info("viewer is gone, the stream goes on")
            self._end(f"what listens on port {self._port} is no viewer, nothing is shown: see --viewer-port")
        elif (delivery is Delivery.STALLED) != self._is_stalled:
            self._is_stalled = not self._is_stalled
            logger.info(
                "viewer %s", "does not answer, sending waits" if self._is_stalled else "answers again"
            )

    def let_go(self) -> None:
        """End a connection that could not be served; the next one gets the whole scene again."""
        self._end(f"showing the run failed {MAX_REFUSALS} times in a row, nothing more is shown")

    def _end(self, why_no_more: str) -> None:
        stream, self._stream = self._stream, None
        self._is_stalled = False
        self._num_refusals += 1
        if self._num_refusals == MAX_REFUSALS:
            logger.warning("%s", why_no_more)
        if stream is not None:
            stream.close()

    def close(self) -> None:
        """End the connection for good. Idempotent."""
        stream, self._stream = self._stream, None
        if stream is not None and not stream.close():
            logger.warning("the viewer is frozen and was left as it is")
