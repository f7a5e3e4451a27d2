import logging

import pytest

from semcast.common.worker_guard import MAX_LOGGED, WorkerGuard


def fail(guard, *errors):
    for error in errors:
        with guard:
            raise error


def test_a_round_that_fails_is_logged_once_and_told_each_time(caplog):
    told = []
    guard = WorkerGuard("sending", told.append)
    fail(guard, KeyError("x"), KeyError("x"), MemoryError())
    with guard:
        told.append("went on")
    assert told == [*["sending failed: 'x'"] * 2, "sending failed: MemoryError", "went on"]
    assert [(r.levelno, r.getMessage()) for r in caplog.records] == [
        (logging.ERROR, "sending failed: 'x'"),
        (logging.ERROR, "sending failed: MemoryError"),
    ]
    assert all(record.exc_info for record in caplog.records)


def test_different_failures_without_end_do_not_fill_the_log(caplog):
    told = []
    guard = WorkerGuard("sending", told.append)
    fail(guard, *(ValueError(str(k)) for k in range(100)))
    assert (len(told), len(caplog.records)) == (100, MAX_LOGGED)


@pytest.mark.parametrize("end", [KeyboardInterrupt, SystemExit])
def test_what_ends_the_process_is_let_through(end):
    told = []
    guard = WorkerGuard("sending", told.append)
    with pytest.raises(end):
        fail(guard, end())
    assert not told
