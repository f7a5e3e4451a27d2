"""Streams that agents announce, handed from the network's threads to the one that begins on them."""

import contextlib
import threading

from semcast.common.errors import TransportError
from semcast.common.keys import CAMERA_TIMEOUT_S, camera_key
from semcast.common.messages import CameraInfo
from semcast.common.transport import Session
from semcast.common.wire import WireError, unpack

#: How long an agent may take to say again what it announced, over a slow network; no other thread waits.
_STAND_BY_S = 2.0


def _unpack_or_none(payload: bytes) -> CameraInfo | None:
    """Return what is announced, None where that is not valid."""
    try:
        return unpack(payload, CameraInfo)
    except WireError:
        return None


def answered_camera(
    session: Session, agent_id: str, agent_epoch: int | None = None, timeout_s: float = CAMERA_TIMEOUT_S
) -> CameraInfo | None:
    """Ask for the camera of a start of an agent; None where nobody answers: two may have one name.

    Args:
        session: Where they are asked.
        agent_id: Their name.
        agent_epoch: Of the start; None for the first that answers.
        timeout_s: How long they have for it.

    Raises:
        TransportError: The session is closed.
    """

    def is_wanted(answer: bytes) -> bool:
        camera = _unpack_or_none(answer)
        return camera is not None and agent_epoch in (None, camera.agent_epoch)

    answer = session.request(camera_key(agent_id), b"", timeout_s, is_wanted)
    return _unpack_or_none(answer) if answer is not None else None


class Announcement:
    """The newest stream that was announced and not begun on yet.

    Args:
        session: Where agents announce themselves; one that is there already, or comes, is asked.
        agent_id: Whose streams.
    """

    def __init__(self, session: Session, agent_id: str) -> None:
        self._session = session
        self._agent_id = agent_id
        self._lock = threading.Lock()
        self._newest: CameraInfo | None = None
        session.subscribe(camera_key(agent_id), "every", self._hear)
        # One that announced itself a moment before this was subscribed, and is there a moment after.
        session.watch_alive(agent_id, self._on_alive)

    def _hear(self, payload: bytes) -> None:
        """Note an announced stream; the receiver counts and reports what is not valid.

        A map ends with it, so the agent must be there and say the same. One that can't is begun on with its
        first frame.
        """
        camera = _unpack_or_none(payload)
        if camera is not None:
            self._ask(camera.agent_epoch)

    def _on_alive(self, role: str, alive: bool | None) -> None:
        if role == "agent" and alive:
            self._ask(None)

    def _ask(self, agent_epoch: int | None) -> None:
        camera = None
        with contextlib.suppress(TransportError):
            camera = answered_camera(self._session, self._agent_id, agent_epoch, _STAND_BY_S)
        with self._lock:
            if camera is not None and (self._newest is None or camera.agent_epoch > self._newest.agent_epoch):
                self._newest = camera

    def is_newer(self, agent_epoch: int) -> bool:
        """Tell whether a stream was announced that began after this one."""
        with self._lock:
            return self._newest is not None and self._newest.agent_epoch > agent_epoch

    def take(self) -> CameraInfo | None:
        """Return the stream and forget it; None where none was announced since."""
        with self._lock:
            camera, self._newest = self._newest, None
        return camera
