"""Who must be there before a stream begins: roles that are alive, and a server that is ready for it."""

import contextlib
import logging
import threading
import time
from collections.abc import Collection

from semcast.common.keys import flow_key
from semcast.common.messages import FlowMessage
from semcast.common.transport import Session
from semcast.common.wire import WireError, unpack

logger = logging.getLogger(__name__)

_POLL_S = 0.1
#: Longest wait for a server that is alive but does not say it is ready.
READY_S = 5.0


def wait_for_peers(session: Session, agent_id: str, peers: Collection[str], stop: threading.Event) -> None:
    """Wait until these roles are alive, or ``stop`` is set; say later when one goes or comes back.

    Raises:
        TransportError: The session is closed.
    """
    missing = set(peers)
    all_there = threading.Event()

    def on_change(role: str, alive: bool | None) -> None:
        if role not in peers or bool(alive) == (role not in missing):
            return
        (missing.discard if alive else missing.add)(role)
        if all_there.is_set() and alive is not None:  # live frames are lost, or not even encoded
            logger.info("%s %s", role, "is there" if alive else "is gone")
        elif not missing:
            all_there.set()

    session.watch_alive(agent_id, on_change)
    if not all_there.wait(0.5):
        logger.info("waiting for %s of %r (another --agent-id?)", " and ".join(sorted(missing)), agent_id)
    while not stop.is_set() and not all_there.wait(_POLL_S):
        pass


def wait_until_ready(session: Session, agent_id: str, agent_epoch: int, stop: threading.Event) -> bool:
    """Wait until the server has its decoder, map and viewer ready for this stream, at most a while.

    Returns:
        Whether it has said so.

    Raises:
        TransportError: The session is closed.
    """
    ready = threading.Event()

    def on_flow(payload: bytes) -> None:
        with contextlib.suppress(WireError):
            if unpack(payload, FlowMessage).agent_epoch == agent_epoch:
                ready.set()

    session.subscribe(flow_key(agent_id), "newest", on_flow)
    until_s = time.monotonic() + READY_S
    while not stop.is_set() and not ready.wait(_POLL_S) and time.monotonic() < until_s:
        pass
    return ready.is_set()
