"""Requests of other processes, handed from the network's threads to the one thread that may serve them."""

import logging
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from typing import Any

from semcast.common.errors import SemcastError

logger = logging.getLogger(__name__)


class RequestDesk:
    """Takes requests on any thread; those for the same thing are served together, once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: dict[str, Future[Any]] = {}
        self._closed = False

    def ask(self, what: str, wait_s: float) -> Any:
        """Return what serving gave.

        Raises:
            SemcastError: Serving failed, takes longer than ``wait_s``, in which case it goes on all the same,
                or is at its end; the message tells which.
        """
        with self._lock:
            if self._closed:
                raise _refusal(what)
            served = self._waiting.setdefault(what, Future())
        try:
            return served.result(wait_s)
        except FutureTimeoutError as err:
            raise SemcastError(f"{what} is not done yet: the server is busy, and does it next") from err

    def error_of(self, what: str, wait_s: float) -> str:
        """Ask for something that gives what went wrong, and return that; "" where it is done."""
        try:
            return self.ask(what, wait_s) or ""
        except SemcastError as err:
            return str(err)

    def close(self) -> None:
        """Refuse what waits, and all that is asked for from now on: nobody serves any more. Idempotent."""
        with self._lock:
            self._closed = True
            waiting, self._waiting = self._waiting, {}
        for what, served in waiting.items():
            served.set_exception(_refusal(what))

    def serve(self, handlers: Mapping[str, Callable[[], Any]]) -> None:
        """Serve what was asked for, in the order of the handlers; who asks must not end what serves."""
        with self._lock:
            waiting, self._waiting = self._waiting, {}
        for what, handle in handlers.items():
            if what not in waiting:
                continue
            try:
                answer = handle()
            except SemcastError as err:
                logger.warning("%s can't be served: %s", what, err)
                waiting[what].set_exception(err)
            except Exception as err:
                logger.exception("%s can't be served", what)
                waiting[what].set_exception(SemcastError(f"{what} can't be served: {err}"))
            else:
                waiting[what].set_result(answer)


def _refusal(what: str) -> SemcastError:
    return SemcastError(f"{what} can't be served: the server is at its end")
