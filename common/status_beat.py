"""Sends a process's status once a second."""

import logging
import threading
from collections.abc import Callable

from semcast.common.errors import SemcastError
from semcast.common.keys import status_key
from semcast.common.metrics import STATUS_INTERVAL_S, Metrics
from semcast.common.transport import Session
from semcast.common.wire import pack
from semcast.common.worker_guard import WorkerGuard

logger = logging.getLogger(__name__)


class StatusBeat:
    """A thread that publishes ``metrics.status`` until it is closed, and once more then.

    Args:
        session: Where to.
        agent_id: Whose stream the process works on.
        role: Of the process.
        metrics: What is sent.
        agent_epoch: Returns the epoch of the stream, 0 while there is none.
    """

    def __init__(
        self, session: Session, agent_id: str, role: str, metrics: Metrics, agent_epoch: Callable[[], int]
    ) -> None:
        self._publisher = session.publisher(status_key(agent_id, role), "newest")
        self._metrics = metrics
        self._agent_epoch = agent_epoch
        self._stopping = threading.Event()
        self._guard = WorkerGuard("sending the status", metrics.error)
        self._thread = threading.Thread(target=self._run, name="semcast-status", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stopping.wait(STATUS_INTERVAL_S):
            with self._guard:
                self.send()

    def send(self) -> None:
        """Send the status now, before work that does not let go of the interpreter for seconds."""
        try:
            self._publisher.put(pack(self._metrics.status(self._agent_epoch())))
        except SemcastError as err:
            logger.debug("status not sent: %s", err)

    def close(self) -> None:
        """Send the last status and end the thread. Idempotent."""
        if not self._stopping.is_set():
            self._stopping.set()
            self._thread.join(2.0)
            self.send()
