"""What a receiver tells the agent: how good the link was for each frame, and how far the server is."""

import logging
import threading
from collections.abc import Callable

import numpy as np

from semcast.common.errors import TransportError
from semcast.common.keys import flow_key, link_key
from semcast.common.link_report import LinkReporter
from semcast.common.messages import FlowMessage, LinkReport, SymbolFrame
from semcast.common.metrics import Metrics
from semcast.common.phy.equaliser import Equalised
from semcast.common.transport import Session
from semcast.common.wire import pack
from semcast.common.worker_guard import WorkerGuard

logger = logging.getLogger(__name__)

#: Frames under way at most in replay: enough to keep agent, channel, decoder and tracker busy at once.
WINDOW = 6
FLOW_INTERVAL_S = 0.2


class Feedback:
    """Sends link reports, and the flow of a lossless stream: at once when it changes, and from time to time.

    What can't be sent is left out: the next one says it too.

    Args:
        session: An open session.
        agent_id: Who is told.
        metrics: Takes errors.
        how_far: Returns the epoch, its first frame the consumer is not done with, and its first that has not
            arrived; None for a live stream, whose agent is told only to begin.
    """

    def __init__(
        self,
        session: Session,
        agent_id: str,
        metrics: Metrics,
        how_far: Callable[[], tuple[int, int, int]] | None,
    ) -> None:
        self._metrics = metrics
        self._how_far = how_far
        self._reporter: tuple[tuple[int, str], LinkReporter] | None = None
        self._link = session.publisher(link_key(agent_id), "newest")
        self._flow = session.publisher(flow_key(agent_id), "newest")
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def begin(self) -> None:
        """Say from time to time how far a lossless stream is, until ``close``."""
        if self._how_far is not None:
            self._thread = threading.Thread(target=self._beat, name="semcast-flow", daemon=True)
            self._thread.start()

    def _beat(self) -> None:
        guard = WorkerGuard("sending how far the server is", self._metrics.error)
        while not self._stopping.wait(FLOW_INTERVAL_S):
            with guard:
                self.send_flow()

    def send_flow(self) -> None:
        """Say how far a lossless stream is."""
        if self._how_far is not None:
            self._put_flow(*self._how_far())

    def announce_ready(self, agent_epoch: int) -> None:
        """Tell a live agent that everything is set up for its first frame; it waits for this."""
        self._put_flow(agent_epoch, 0, 0)

    def _put_flow(self, agent_epoch: int, next_seq: int, arrived_seq: int) -> None:
        flow = FlowMessage(agent_epoch=agent_epoch, next_seq=next_seq, arrived_seq=arrived_seq, window=WINDOW)
        try:
            self._flow.put(pack(flow))
        except TransportError as err:
            logger.debug("flow not sent: %s", err)

    def report(self, message: SymbolFrame, equalised: Equalised, num_superseded: int) -> None:
        """Say how good the link was for a frame, and how many were passed over so far."""
        stream = (message.agent_epoch, message.codec)
        if self._reporter is None or self._reporter[0] != stream:
            self._reporter = (stream, LinkReporter(message.codec))
        snr_db = self._reporter[1].snr_db(equalised)
        report = LinkReport(
            agent_epoch=message.agent_epoch,
            frame_id=message.frame_id,
            snr_db_estimate=float(np.clip(snr_db, -100.0, 100.0)),
            t_capture_ns=message.t_capture_ns,
            num_superseded=num_superseded,
        )
        try:
            self._link.put(pack(report))
        except TransportError as err:
            logger.debug("link report not sent: %s", err)

    def close(self) -> None:
        """Send nothing more by itself. Idempotent."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(2.0)
