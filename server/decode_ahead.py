"""Decodes one frame ahead of the tracker on a thread of its own, so that two cores work; order is kept."""

import logging
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from semcast.common.errors import SemcastError
from semcast.common.worker_guard import WorkerGuard

logger = logging.getLogger(__name__)

In = TypeVar("In")
Out = TypeVar("Out")

POLL_S = 0.1
#: How long the end waits for the frame that is being decoded, which nobody takes any more. Large images take
#: tens of seconds.
CLOSE_S = 1.0


class DecodeAhead(Generic[In, Out]):
    """One slot between decoder and tracker.

    The next message is taken only when the slot is free: while the tracker is busy, frames wait (or are
    superseded) where they arrive, and a decoded one never waits longer than the tracker's last frame took. In
    an overload that is long.

    Args:
        take: Waits up to the given seconds for a message; None when there was none. Where it fails, that is
            logged and the stream goes on.
        decode: Turns a message into what the tracker takes.
        on_failure: Is told the message and ``codec`` (the sender uses another codec or a message makes no
            sense) or ``decode`` (the decoder failed); the stream goes on.
        is_stale: Tells of a decoded one that waited, when the tracker comes for it, that it is not wanted any
            more, and counts it. One that the tracker waited for is as new as can be, and not asked about.
    """

    def __init__(
        self,
        take: Callable[[float], In | None],
        decode: Callable[[In], Out],
        on_failure: Callable[[In, str], None],
        is_stale: Callable[[Out], bool] = lambda decoded: False,
    ) -> None:
        self._take = take
        self._decode = decode
        self._on_failure = on_failure
        self._is_stale = is_stale
        self._slot: Out | None = None
        self._is_decoding = False
        self._condition = threading.Condition()
        self._stopping = threading.Event()
        self._reported: set[str] = set()
        self._taking = WorkerGuard("taking a frame", self._pause)
        self._decoding = WorkerGuard("decoding a frame")
        self._leaving_out = WorkerGuard("leaving a frame out")
        self._thread = threading.Thread(target=self._run, name="semcast-decode", daemon=True)
        self._thread.start()

    @property
    def is_busy(self) -> bool:
        """Whether a message was taken that the tracker has not got yet."""
        with self._condition:
            return self._is_decoding or self._slot is not None

    def _run(self) -> None:
        while not self._stopping.is_set():
            with self._condition:
                if not self._condition.wait_for(lambda: self._slot is None, POLL_S):
                    continue
            message = None
            with self._taking:
                message = self._take(POLL_S)
            if message is None:
                continue
            self._is_decoding = True
            decoded, is_decoded, is_refused = None, False, False
            with self._decoding:
                try:
                    decoded, is_decoded = self._decode(message), True
                except SemcastError as err:
                    is_refused = True
                    if str(err) not in self._reported and len(self._reported) < 100:
                        self._reported.add(str(err))
                        logger.warning("%s", err)
            if not is_decoded:
                with self._leaving_out:
                    self._on_failure(message, "codec" if is_refused else "decode")
            with self._condition:  # at once, or nobody had the frame for a moment
                self._slot, self._is_decoding = decoded, False
                self._condition.notify_all()

    def _pause(self, _text: str) -> None:
        """Wait a little after what may fail again at once."""
        self._stopping.wait(POLL_S)

    def get(self, timeout_s: float) -> Out | None:
        """Return the next decoded frame, None when there was none in time."""
        with self._condition:
            if self._slot is not None and self._is_stale(self._slot):
                self._slot = None
                self._condition.notify_all()
            self._condition.wait_for(lambda: self._slot is not None, timeout_s)
            decoded, self._slot = self._slot, None
            self._condition.notify_all()
        return decoded

    def close(self) -> None:
        """End the thread; a decoded frame still in the slot is dropped. Idempotent.

        One that is being decoded is not waited for beyond ``CLOSE_S``: the thread ends by itself behind it,
        or is left when the process ends.
        """
        self._stopping.set()
        with self._condition:
            self._slot = None
            self._condition.notify_all()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            logger.warning("the frame that is being decoded is left: its image is not waited for")
