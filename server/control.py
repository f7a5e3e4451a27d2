"""What other processes may ask of a server: to begin a new map, to write what there is, and for its map."""

import contextlib
from collections.abc import Callable

from semcast.common.errors import SemcastError
from semcast.common.keys import control_key, map_key
from semcast.common.message_fields import sendable
from semcast.common.messages import ControlReply, ControlRequest
from semcast.common.transport import Session
from semcast.common.wire import WireError, pack, unpack
from semcast.server.requests import RequestDesk
from semcast.server.settings import ServerSettings

#: How long a request waits to be served; a busy server answers that it is not done yet.
SERVE_WAIT_S = 2.0


class Control:
    """Answers requests on a session; those that change the map wait for the one thread that may do it.

    Args:
        session: Open.
        settings: Of the server.
    """

    def __init__(self, session: Session, settings: ServerSettings) -> None:
        self._settings = settings
        self._desk = RequestDesk()
        session.answer(control_key(settings.agent_id, "server"), self._answer)
        session.answer(map_key(settings.agent_id), self._answer_map)

    def _answer(self, payload: bytes) -> bytes:
        """Answer a control request: ``reset`` begins a new map, ``save`` writes what there is."""
        try:
            request = unpack(payload, ControlRequest)
        except WireError as err:
            return pack(ControlReply(ok=False, error=sendable(str(err), 1000)))
        if request.op not in ("get", "reset", "save"):
            return pack(ControlReply(ok=False, error=f"op must be get, reset or save, got {request.op}"))
        error = self._desk.error_of(request.op, SERVE_WAIT_S) if request.op != "get" else ""
        values = {"mode": self._settings.mode, "view": self._settings.view.view}
        return pack(ControlReply(ok=not error, error=sendable(error, 1000), settings=values))

    def _answer_map(self, _payload: bytes) -> bytes | None:
        """Give the whole map to who comes late; who gets none asks again when the map has changed."""
        with contextlib.suppress(SemcastError):
            whole: bytes | None = self._desk.ask("map", SERVE_WAIT_S)
            return whole
        return None

    def serve(
        self, *, reset: Callable[[], str], save: Callable[[], str], whole_map: Callable[[], bytes | None]
    ) -> None:
        """Serve what was asked for, on the calling thread.

        Args:
            reset: Begins a new map, and returns what went wrong.
            save: Writes what there is, and returns what went wrong.
            whole_map: Returns the map as a message, None where there is none.
        """
        self._desk.serve({"reset": reset, "save": save, "map": whole_map})

    def close(self) -> None:
        """Refuse what waits, and all that is asked for from now on. Idempotent."""
        self._desk.close()
