"""Work in a child process, one problem at a time, that is started again when it dies."""

import contextlib
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Generic, TypeVar

from semcast.common.interrupts import deaf_children

logger = logging.getLogger(__name__)

Problem = TypeVar("Problem")
Result = TypeVar("Result")

#: Longest wait for one result, the start of the process included.
DEADLINE_S = 30.0
_CLOSE_DEADLINE_S = 3.0
#: Failures in a row, with no result between them, after which the worker gives up for good.
MAX_FAILURES = 5


def serve(connection: Connection, work: Callable[[Problem], Result], stands_back: bool) -> None:
    """Answer problems until the other end closes; the body of the child process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # on Windows nothing else keeps Ctrl-C away
    if stands_back:
        _stand_back()
    while True:
        try:
            problem = connection.recv()
        except (EOFError, OSError):
            return
        if problem is None:
            return
        try:
            connection.send(work(problem))
        except (BrokenPipeError, OSError):
            return


def _stand_back() -> None:
    """Let every other process go first, as far as the system knows how."""
    with contextlib.suppress(OSError):  # some containers don't allow it
        if hasattr(os, "SCHED_IDLE"):
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        elif hasattr(os, "nice"):
            os.nice(19)


def _send(connection: Connection, problem: object) -> None:
    with contextlib.suppress(OSError):  # who waits for the result sees that the child is gone
        connection.send(problem)


class Worker(Generic[Problem, Result]):
    """Works in a child process that is started again when it dies.

    The child imports the program's main module: a script needs ``if __name__ == "__main__":`` around what it
    does.

    Args:
        work: What the child does with a problem; a function of a module.
        name: Of the child, its threads and the messages about it, in a word.
        what: The same in the words of a user.
        given_up: Is said when the child dies so often that it is not started again.
        lossless: ``take`` always waits for the result, so the same input gives the same outcome; otherwise
            it returns at once.
        on_give_up: Is told ``given_up``, once.
        stands_back: The child lets every other process go first.
        start_early: Start the child now; otherwise with the first problem.
    """

    def __init__(
        self,
        work: Callable[[Problem], Result],
        *,
        name: str,
        what: str,
        given_up: str,
        lossless: bool = False,
        on_give_up: Callable[[str], None] | None = None,
        stands_back: bool = False,
        start_early: bool = True,
    ) -> None:
        self._work = work
        self._name = name
        self._what = what
        self._given_up = given_up
        self._stands_back = stands_back
        self._lossless = lossless
        self._on_give_up = on_give_up
        self._context = multiprocessing.get_context("spawn")
        self._process: SpawnProcess | None = None
        self._connection: Connection | None = None
        self._pending: Problem | None = None
        self._sender: threading.Thread | None = None
        self._since_s = 0.0
        self._closed = False
        self._failures = 0
        self.num_restarts = 0
        self._is_due = not start_early
        if start_early:
            self._start()

    @property
    def busy(self) -> bool:
        """A problem is under way."""
        return self._pending is not None

    @property
    def given_up(self) -> bool:
        """The child died too often: there are no results any more."""
        return self._failures >= MAX_FAILURES

    @property
    def pid(self) -> int | None:
        """Process id of the child, None where there is none any more."""
        return self._process.pid if self._process is not None else None

    def _start(self) -> None:
        self._is_due = False
        self._stop()
        ours, theirs = self._context.Pipe()
        self._process = self._context.Process(
            target=serve,
            args=(theirs, self._work, self._stands_back),
            name=f"semcast-{self._name}",
            daemon=True,
        )
        with deaf_children():  # Ctrl-C is the parent's business
            self._process.start()
        theirs.close()
        self._connection = ours

    def _restart(self) -> None:
        self._failures += 1
        if self.given_up:
            self._give_up()
            return
        self.num_restarts += 1
        logger.warning("%s ended and is started again", self._what)
        self._start()

    def _give_up(self) -> None:
        self._stop()
        logger.error("%s", self._given_up)
        if self._on_give_up is not None:
            self._on_give_up(self._given_up)

    def submit(self, problem: Problem) -> bool:
        """Give a problem to the child; False while it works on another or has failed for good.

        Sending is done by a thread: a child that is still starting, or stuck, does not read what it is sent,
        and a problem may be larger than what a pipe holds.
        """
        if self._closed or self._pending is not None:
            return False
        if self._is_due:
            self._start()
        for _ in range(2):
            if self.given_up:
                return False
            if self._process is not None and self._process.is_alive():
                self._pending, self._since_s = problem, time.monotonic()
                self._sender = threading.Thread(
                    target=_send,
                    args=(self._connection, problem),
                    name=f"semcast-{self._name}-send",
                    daemon=True,
                )
                self._sender.start()
                return True
            self._restart()
        return False

    def take(self, wait: bool = False) -> Result | None:
        """Return the result, or None when it is not there yet or the child died over it.

        A child that has had a problem for longer than ``DEADLINE_S`` is ended. A problem whose child died is
        sent once more when the result is waited for.
        """
        if self._pending is None or self._closed:
            return None
        wait = wait or self._lossless
        retries = 1
        while True:
            assert self._connection is not None
            try:
                left_s = self._since_s + DEADLINE_S - time.monotonic()
                if not self._connection.poll(max(0.0, left_s) if wait else 0.0):
                    if not wait and left_s > 0.0:
                        return None
                    if self._process is not None:
                        self._process.kill()
                    raise TimeoutError
                result = self._connection.recv()
                self._pending, self._failures = None, 0
                return result  # type: ignore[no-any-return]
            except (EOFError, OSError):  # TimeoutError is an OSError
                problem, self._pending = self._pending, None
                self._restart()
                if not wait or retries == 0 or problem is None or not self.submit(problem):
                    self._pending = None
                    return None
                retries -= 1

    def _stop(self) -> None:
        connection, self._connection = self._connection, None
        process, self._process = self._process, None
        sender, self._sender = self._sender, None
        if sender is not None and sender.is_alive() and process is not None:
            process.kill()  # else it might never be done
        if sender is not None:
            sender.join(_CLOSE_DEADLINE_S)
        if connection is not None:
            if self._pending is None:
                _send(connection, None)
            connection.close()
        if process is not None:
            process.join(_CLOSE_DEADLINE_S if self._pending is None else 0.1)
            if process.is_alive():
                process.kill()
                process.join(_CLOSE_DEADLINE_S)
            process.close()

    def close(self) -> None:
        """End the child. Idempotent."""
        if not self._closed:
            self._closed = True
            self._stop()
            self._pending = None
