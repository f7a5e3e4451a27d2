"""Sends a process's status once a second, and hears those of others."""

import logging
import threading
from collections.abc import Callable, Collection

from semcast.common.errors import SemcastError
from semcast.common.keys import status_key
from semcast.common.messages import StatusMessage
from semcast.common.metrics import STATUS_INTERVAL_S, Metrics
from semcast.common.transport import Publisher, Session
from semcast.common.wire import WireError, pack, unpack
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
        # No other comes after the last one, which may be all that says that a stream has ended.
        self._last_publisher = session.publisher(status_key(agent_id, role), "every")
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
        self._send(self._publisher)

    def _send(self, publisher: Publisher) -> None:
        try:
            publisher.put(pack(self._metrics.status(self._agent_epoch())))
        except SemcastError as err:
            logger.debug("status not sent: %s", err)

    def close(self) -> None:
        """Send the last status, which a busy link delays but does not drop, and end. Idempotent."""
        if not self._stopping.is_set():
            self._stopping.set()
            self._thread.join(2.0)
            self._send(self._last_publisher)


def hear_statuses(session: Session, agent_id: str, roles: Collection[str]) -> dict[str, StatusMessage]:
    """Return the next status of each of some roles; those that send none in time are not in it.

    Raises:
        TransportError: The session is closed.
    """
    heard: dict[str, StatusMessage] = {}
    changed = threading.Condition()

    def hear(payload: bytes) -> None:
        try:
            status = unpack(payload, StatusMessage)
        except WireError as err:
            logger.debug("a status can't be read: %s", err)
            return
        with changed:
            heard[status.role] = status
            changed.notify_all()

    for role in roles:
        session.subscribe(status_key(agent_id, role), "newest", hear)
    with changed:
        changed.wait_for(lambda: set(roles) <= heard.keys(), 2.5 * STATUS_INTERVAL_S)
        return {role: heard[role] for role in roles if role in heard}
