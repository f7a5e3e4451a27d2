"""Children that work: begun when they are needed, and behind all others where they may wait."""

import os

import pytest

from semcast.server.worker import Worker


@pytest.fixture
def make():
    made = []

    def one(work, **how):
        made.append(Worker(work, name="test", what="the test's child", given_up="it is no more", **how))
        return made[-1]

    yield one
    for worker in made:
        worker.close()


def test_a_child_begins_with_its_first_problem_where_that_is_wanted(make):
    early, late = make(abs), make(abs, start_early=False)
    assert early.pid is not None
    assert late.pid is None
    assert late.take(wait=True) is None
    assert late.submit(-3)
    assert late.take(wait=True) == 3
    assert late.pid is not None
    assert late.num_restarts == 0


@pytest.mark.skipif(not hasattr(os, "nice"), reason="the system knows no order of processes")
def test_a_child_that_stands_back_lets_others_go_first(make):
    order = []
    for stands_back in (False, True):
        worker = make(os.nice, stands_back=stands_back)
        worker.submit(0)
        order.append(worker.take(wait=True))
    assert order == [os.nice(0), 19]
