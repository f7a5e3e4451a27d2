import logging

import pytest

from semcast.common.worker_guard import MAX_LOGGED, WorkerGuard


def fail(guard, *errors):
    for error in errors:
        with guard:
            raise error


def test_a_round_that_fails_is_logged_once_counted_each_time_and_told(caplog):
    told = []
    guard = WorkerGuard("sending", told.append)
    fail(guard, KeyError("x"), KeyError("x"), MemoryError())
    with guard:
        told.append("went on")
    assert guard.num_failed == 3
    assert told == [*["sending failed: 'x'"] * 2, "sending failed: MemoryError", "went on"]
    assert [(r.levelno, r.getMessage()) for r in caplog.records] == [
        (logging.ERROR, "sending failed: 'x'"),
        (logging.ERROR, "sending failed: MemoryError"),
    ]
    assert all(record.exc_info for record in caplog.records)


def test_different_failures_without_end_do_not_fill_the_log(caplog):
    guard = WorkerGuard("sending")
    fail(guard, *(ValueError(str(k)) for k in range(100)))
    assert (guard.num_failed, len(caplog.records)) == (100, MAX_LOGGED)


@pytest.mark.parametrize("end", [KeyboardInterrupt, SystemExit])
def test_what_ends_the_process_is_let_through(end):
    guard = WorkerGuard("sending")
    with pytest.raises(end):
        fail(guard, end())
    assert guard.num_failed == 0
