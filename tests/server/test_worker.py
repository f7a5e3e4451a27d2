"""Children that work: begun when needed, behind all others where they may wait, and not easily upset."""

import logging
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from semcast.common.interrupts import ending_signals
from semcast.server.worker import Worker

WHAT = "the test's child"
DEADLINE_S = 30.0


@pytest.fixture
def make():
    made = []

    def one(work, **how):
        made.append(Worker(work, name="test", what=WHAT, given_up="it is no more", **how))
        return made[-1]

    yield one
    for worker in made:
        worker.close()


def answer(worker, problem):
    assert worker.submit(problem)
    return worker.take(wait=True)


def raise_on_odd(problem):
    """Keep a note of each time it is asked; what it is asked is a number and the file for the notes."""
    number, notes = problem
    with Path(notes).open("a") as file:
        file.write(f"{number} ")
    if number % 2:
        raise ArithmeticError(f"{number} is odd,\nas it happens")
    return os.getpid()


def return_what_cannot_be_sent(problem):
    return threading.Lock() if problem else "sent"


def end_at_once(problem):
    os._exit(3)


@pytest.mark.parametrize("number", [signal.SIGINT, *ending_signals()])
def test_what_asks_a_group_of_processes_to_end_leaves_the_child_at_work(make, number, caplog):
    worker = make(abs)
    assert answer(worker, -1) == 1
    pid = worker.pid
    os.kill(pid, number)
    assert answer(worker, -2) == 2
    assert worker.pid == pid
    assert not [r for r in caplog.records if r.name == "semcast.server.worker"]


def test_a_child_that_nobody_closes_keeps_no_script_from_its_end(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from semcast.server.worker import Worker\n"
        "if __name__ == '__main__':\n"
        "    kept = Worker(abs, name='test', what='the child', given_up='it is no more')\n"
        "    assert kept.submit(-3) and kept.take(wait=True) == 3\n"
        "    print(kept.pid)\n"
    )
    ended = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=30)
    assert (ended.returncode, ended.stderr) == (0, "")
    with pytest.raises(ProcessLookupError):
        os.kill(int(ended.stdout), 0)


def test_a_child_begins_with_its_first_problem_where_that_is_wanted(make):
    early, late = make(abs), make(abs, start_early=False)
    assert early.pid is not None
    assert late.pid is None
    assert late.take(wait=True) is None
    assert late.submit(-3)
    begun = late.pid
    assert late.take(wait=True) == 3
    assert begun is not None
    assert late.pid == begun


@pytest.mark.skipif(not hasattr(os, "nice"), reason="the system knows no order of processes")
def test_a_child_that_stands_back_lets_others_go_first(make):
    order = []
    for stands_back in (False, True):
        worker = make(os.nice, stands_back=stands_back)
        worker.submit(0)
        order.append(worker.take(wait=True))
    assert order == [os.nice(0), 19]


@pytest.mark.parametrize("lossless", [False, True])
def test_work_that_raises_is_told_once_and_the_same_child_does_the_next(make, tmp_path, caplog, lossless):
    worker, notes = make(raise_on_odd, lossless=lossless), str(tmp_path / "notes")
    asked = [answer(worker, (number, notes)) for number in (2, 3, 5, 4)]
    assert asked == [worker.pid, None, None, worker.pid]
    assert Path(notes).read_text() == "2 3 5 4 ", "nothing is asked twice"
    told = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert told == [
        f"{WHAT} could not do a piece of its work: ArithmeticError: {n} is odd, as it happens" for n in (3, 5)
    ]


def test_work_that_always_raises_is_no_dying_child(make, tmp_path):
    worker = make(raise_on_odd)
    child = worker.pid
    for _ in range(8):
        assert answer(worker, (1, str(tmp_path / "notes"))) is None
    assert not worker.given_up
    assert worker.pid == child


def test_what_cannot_be_sent_either_way_is_told(make, caplog):
    worker = make(return_what_cannot_be_sent)
    child = worker.pid
    assert answer(worker, 1) is None
    assert answer(worker, threading.Lock()) is None
    assert answer(worker, 0) == "sent"
    assert worker.pid == child
    assert caplog.text.count("cannot pickle '_thread.lock' object") == 2


def test_a_child_that_ends_over_its_work_is_started_again_and_given_up_in_the_end(make, caplog):
    worker = make(end_at_once)
    for _ in range(3):
        if worker.submit(0):
            assert worker.take(wait=True) is None
    assert worker.given_up
    assert caplog.text.count("is started again") == 4
    assert caplog.text.count("it is no more") == 1


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="the system does not list open files")
def test_nothing_is_left_of_children_that_were_killed_stopped_or_could_not_start(make, monkeypatch):
    def num_open():
        return len(os.listdir("/proc/self/fd"))

    first = make(abs)
    assert answer(first, -1) == 1
    first.close()  # what multiprocessing itself keeps is there now
    before = num_open()

    worker = make(abs)
    pids = []
    for number in (signal.SIGKILL, signal.SIGSTOP, signal.SIGABRT):
        assert answer(worker, -1) == 1
        pids.append(worker.pid)
        os.kill(worker.pid, number)
        assert worker.submit(-1)
        if number == signal.SIGSTOP:
            worker._exchange.since_s -= 2 * DEADLINE_S
        assert worker.take(wait=True) == 1
    pids.append(worker.pid)
    worker.close()

    def fail(self):
        raise OSError("no more processes")

    monkeypatch.setattr(worker._context.Process, "start", fail)
    with pytest.raises(OSError, match="no more processes"):
        make(abs)
    assert not make(abs, start_early=False).submit(-1)
    assert num_open() == before
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    assert not any("exchange" in thread.name for thread in threading.enumerate())
