"""Says when nothing arrives: a channel runs until it is ended, and its user may wait for what can't come."""

import logging
import threading
import time

logger = logging.getLogger(__name__)

#: Longer than an agent takes to load a codec and measure its machine.
SILENCE_S = 30.0
_WATCHED = ("agent", "server")


class Silence:
    """Notes who is there, told by any thread, and when a frame came; frames and ``check`` are of one.

    Args:
        agent_id: Whose frames are waited for.
        silence_s: So long without a frame is told, once until the next one.
    """

    def __init__(self, agent_id: str, silence_s: float = SILENCE_S) -> None:
        self._agent_id = agent_id
        self._silence_s = silence_s
        self._since_s = time.monotonic()
        self._is_told = self._is_cut_off = False
        self._roles: set[str] = set()
        self._lock = threading.Lock()

    def on_alive(self, role: str, alive: bool | None) -> None:
        """Take what ``Session.watch_alive`` tells, and say who came or went."""
        if role not in _WATCHED:
            return
        with self._lock:
            self._is_cut_off = alive is None  # the session says so
            is_change = bool(alive) != (role in self._roles)
            (self._roles.add if alive else self._roles.discard)(role)
        if is_change and alive is not None:
            logger.info("%s %s", role, "is there" if alive else "is gone")

    def on_frame(self) -> None:
        """Take that a frame came."""
        self._since_s, self._is_told = time.monotonic(), False

    def check(self) -> None:
        """Say that nothing came for long, and who is missing."""
        if self._is_told or time.monotonic() - self._since_s < self._silence_s:
            return
        with self._lock:
            missing = [role for role in _WATCHED if role not in self._roles]
            if self._is_cut_off:
                return
        self._is_told = True
        why = (
            f"no {' and no '.join(missing)} of this name (another --agent-id?)"
            if missing
            else "it sends none"
        )
        logger.info("no frame of agent %r has come for %g s: %s", self._agent_id, self._silence_s, why)
