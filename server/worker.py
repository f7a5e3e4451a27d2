"""Work one problem at a time: in a child process, started again when it dies, or in the caller's thread."""

import atexit
import contextlib
import logging
import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from multiprocessing.reduction import ForkingPickler
from typing import Generic, Protocol, TypeVar

from semcast.common.errors import tell_nobody
from semcast.common.heap import keep_freed_memory
from semcast.common.interrupts import deaf_children, ending_signals

logger = logging.getLogger(__name__)

Problem = TypeVar("Problem")
Result = TypeVar("Result")
_Given = TypeVar("_Given", contravariant=True)
_Found = TypeVar("_Found", covariant=True)

#: Longest wait for a result where nothing else is said.
DEADLINE_S = 30.0
_CLOSE_DEADLINE_S = 3.0
#: Failures in a row, with no result between them, after which the worker gives up for good.
MAX_FAILURES = 5


class Runner(Protocol[_Given, _Found]):
    """Works on one problem at a time, as ``Inline`` or ``Worker``."""

    @property
    def busy(self) -> bool:
        """A problem was submitted and its result not taken yet."""

    def submit(self, problem: _Given) -> bool:
        """Start on a problem; False (and nothing happens) while another one is under way."""

    def take(self, wait: bool = False) -> _Found | None:
        """Return the result if it is there.

        Args:
            wait: Wait for it, within a deadline, also where the runner would not.
        """

    def close(self) -> None:
        """Free everything. Idempotent."""


@dataclass(frozen=True)
class Answer(Generic[Result]):
    """What came of one problem.

    Attributes:
        result: Of the work, where it was done.
        failure: Why it was not, in a line.
        trace: Where it was not, for who looks for the cause.
    """

    result: Result | None = None
    failure: str | None = None
    trace: str = ""

    @classmethod
    def failed(cls, err: Exception) -> "Answer[Result]":
        """Return the answer of work that raised."""
        said = f"{type(err).__name__}: {' '.join(str(err).split())}".removesuffix(": ")
        return cls(failure=said, trace=traceback.format_exc())


class Inline(Generic[Problem, Result]):
    """Works in the caller's thread, with the interface of ``Worker``: the same input gives the same result.

    Args:
        work: What is done with a problem.
    """

    def __init__(self, work: Callable[[Problem], Result]) -> None:
        self._work = work
        self._result: Result | None = None

    @property
    def busy(self) -> bool:
        """A result waits to be taken."""
        return self._result is not None

    def submit(self, problem: Problem) -> bool:
        """Work on a problem now; False (and nothing happens) while a result waits to be taken."""
        if self._result is not None:
            return False
        self._result = self._work(problem)
        return True

    def take(self, wait: bool = False) -> Result | None:
        """Return the result of the last ``submit``, once."""
        result, self._result = self._result, None
        return result

    def close(self) -> None:
        """Forget a result that was not taken."""
        self._result = None


def serve(connection: Connection, work: Callable[[Problem], Result], stands_back: bool) -> None:
    """Answer problems until the other end closes; the body of the child process.

    Work that raises, or whose result can't be sent, is answered with why; the next one is another matter.
    """
    # Signals that end a run go to the whole group of processes, and what this one is at is still wanted then.
    for number in (signal.SIGINT, *ending_signals()):
        signal.signal(number, signal.SIG_IGN)
    keep_freed_memory()
    if stands_back:
        _stand_back()
    while True:
        try:
            received = connection.recv_bytes()
        except (EOFError, OSError):
            return
        try:
            problem = ForkingPickler.loads(received)
            if problem is None:
                return
            answer = ForkingPickler.dumps(Answer(work(problem)))
        except Exception as err:
            answer = ForkingPickler.dumps(Answer.failed(err))
        try:
            connection.send_bytes(answer)
        except OSError:
            return


def _stand_back() -> None:
    """Let every other process go first, as far as the system knows how."""
    if hasattr(os, "nice"):  # not the class of idle processes: on a busy machine that has no time at all
        os.nice(19)


class _Exchange(threading.Thread, Generic[Problem, Result]):
    """Hands a problem to the child and waits for the result, so that nobody else has to.

    A child that is still starting, stuck, or behind all other processes does not read what it is sent, and is
    slow to write what it has found; both may be larger than what a pipe holds.
    """

    def __init__(self, connection: Connection, problem: Problem, name: str) -> None:
        super().__init__(name=name, daemon=True)
        self.problem = problem
        #: None where the child has gone.
        self.answer: Answer[Result] | None = None
        self.since_s = time.monotonic()
        self._connection = connection
        self.start()

    def run(self) -> None:
        """Send and receive; without an answer the child is gone."""
        try:
            self._connection.send(self.problem)
            self.answer = self._connection.recv()
        except (EOFError, OSError):
            return
        except Exception as err:  # it can't be packed or unpacked: nothing is left in the pipe
            self.answer = Answer.failed(err)


class Worker(Generic[Problem, Result]):
    """Works in a child process that is started again when it dies.

    Work that raises is told in a line of the log and has no result; the child goes on with the next.

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
        deadline_s: Longest wait for one result, the start of the process included.
    """

    def __init__(
        self,
        work: Callable[[Problem], Result],
        *,
        name: str,
        what: str,
        given_up: str,
        lossless: bool = False,
        on_give_up: Callable[[str], None] = tell_nobody,
        stands_back: bool = False,
        start_early: bool = True,
        deadline_s: float = DEADLINE_S,
    ) -> None:
        self._work = work
        self._name = name
        self._what = what
        self._given_up = given_up
        self._stands_back = stands_back
        self._lossless = lossless
        self._deadline_s = deadline_s
        self._on_give_up = on_give_up
        self._context = multiprocessing.get_context("spawn")
        self._process: SpawnProcess | None = None
        self._connection: Connection | None = None
        self._exchange: _Exchange[Problem, Result] | None = None
        self._closed = False
        self._failures = 0
        self._is_due = not start_early
        atexit.register(self._kill)
        if start_early:
            self._start()

    @property
    def busy(self) -> bool:
        """A problem is under way."""
        return self._exchange is not None

    @property
    def given_up(self) -> bool:
        """The child died too often: there are no results any more."""
        return self._failures >= MAX_FAILURES

    @property
    def pid(self) -> int | None:
        """Process id of the child, None where there is none."""
        return self._process.pid if self._process is not None else None

    def _start(self) -> None:
        self._is_due = False
        self._stop()
        ours, theirs = self._context.Pipe()
        process = self._context.Process(
            target=serve,
            args=(theirs, self._work, self._stands_back),
            name=f"semcast-{self._name}",
            daemon=True,
        )
        with contextlib.ExitStack() as on_failure:
            on_failure.callback(ours.close)
            with theirs, deaf_children():  # Ctrl-C is the parent's business
                process.start()
            on_failure.pop_all()
        self._process, self._connection = process, ours

    def _restart(self) -> None:
        self._failures += 1
        if self.given_up:
            self._give_up()
            return
        logger.warning("%s ended and is started again", self._what)
        self._start_if_possible()

    def _start_if_possible(self) -> None:
        """Start the child; where the system has no room for it, the next problem is another occasion."""
        try:
            self._start()
        except OSError as err:
            logger.warning("%s can't be started: %s", self._what, err)

    def _give_up(self) -> None:
        self._stop()
        logger.error("%s", self._given_up)
        self._on_give_up(self._given_up)

    def submit(self, problem: Problem) -> bool:
        """Give a problem to the child; False while it works on another or has failed for good."""
        if self._closed or self._exchange is not None:
            return False
        if self._is_due:
            self._start_if_possible()
        for _ in range(2):
            if self.given_up:
                return False
            if self._process is not None and self._process.is_alive():
                assert self._connection is not None
                name = f"semcast-{self._name}-exchange"
                self._exchange = _Exchange(self._connection, problem, name)
                return True
            self._restart()
        return False

    def take(self, wait: bool = False) -> Result | None:
        """Return the result, or None when it is not there yet, the work raised or the child died over it.

        A child that has had a problem for longer than its deadline is ended. A problem whose child died is
        sent once more when the result is waited for.
        """
        wait = wait or self._lossless
        for is_last in (False, True):
            exchange = self._exchange
            if exchange is None or self._closed:
                return None
            left_s = exchange.since_s + self._deadline_s - time.monotonic()
            exchange.join(max(0.0, left_s) if wait else 0.0)
            if exchange.is_alive():
                if not wait and left_s > 0.0:
                    return None
                self._end_exchange()
            self._exchange = None
            if exchange.answer is not None:
                self._failures = 0
                return self._result_of(exchange.answer)
            self._restart()
            if not wait or is_last or not self.submit(exchange.problem):
                return None
        return None

    def _result_of(self, answer: Answer[Result]) -> Result | None:
        if answer.failure is not None:
            logger.error("%s could not do a piece of its work: %s", self._what, answer.failure)
            logger.debug("%s", answer.trace)
        return answer.result

    def _kill(self) -> None:
        """End the child at once; at exit, if nobody has closed this.

        ``multiprocessing`` would then ask the child to end, which it is deaf to, and wait for it.
        """
        if self._process is not None:
            self._process.kill()

    def _end_exchange(self) -> None:
        """End what the child is at, and with it the child."""
        if self._exchange is not None and self._exchange.is_alive():
            self._kill()
            self._exchange.join(_CLOSE_DEADLINE_S)

    def _stop(self) -> None:
        self._end_exchange()
        connection, self._connection = self._connection, None
        process, self._process = self._process, None
        if connection is not None:
            with contextlib.suppress(OSError):
                connection.send(None)
            connection.close()
        if process is not None:
            process.join(_CLOSE_DEADLINE_S)
            if process.is_alive():
                process.kill()
                process.join(_CLOSE_DEADLINE_S)
            with contextlib.suppress(ValueError):  # the system does not let go of it
                process.close()

    def close(self) -> None:
        """End the child. Idempotent."""
        if not self._closed:
            self._closed = True
            atexit.unregister(self._kill)
            self._stop()
            self._exchange = None
