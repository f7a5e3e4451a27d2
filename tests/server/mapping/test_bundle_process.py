"""The child process of bundle adjustment when it keeps dying."""

import os
import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.server import worker
from semcast.server.mapping.bundle_problem import BundleProblem
from semcast.server.mapping.bundle_process import GIVEN_UP, ProcessBundle

#: Nothing of it is looked at: the child is killed before it has read it.
PROBLEM = BundleProblem(
    camera=Intrinsics(fx=1.0, fy=1.0, cx=0.0, cy=0.0, width=1, height=1),
    keyframe_ids=np.zeros(1, np.int64),
    T_world_cam=np.eye(4)[None],
    fixed=np.ones(1, bool),
    keep_baseline=False,
    landmark_ids=np.zeros(0, np.int64),
    xyz=np.zeros((0, 3)),
    view=np.zeros(0, np.intp),
    point=np.zeros(0, np.intp),
    xy=np.zeros((0, 2)),
    sigma_px=np.zeros(0),
    confidence=np.zeros(0),
)
DEADLINE_S = 30.0


def take_what_a_killed_child_left(runner):
    os.kill(runner.pid, signal.SIGKILL)
    end_s, tick = time.monotonic() + DEADLINE_S, threading.Event()
    while runner.busy:
        assert time.monotonic() < end_s, f"the end of the child was not seen within {DEADLINE_S} s"
        assert runner.take() is None
        tick.wait(0.005)


def test_a_child_that_keeps_dying_is_given_up_with_one_clear_error(caplog):
    told = []
    runner = ProcessBundle(on_give_up=told.append)
    try:
        for _ in range(4):
            assert runner.submit(PROBLEM)
            take_what_a_killed_child_left(runner)
        assert not runner.given_up
        os.kill(runner.pid, signal.SIGKILL)
        runner._process.join(DEADLINE_S)
        for _ in range(3):
            assert not runner.submit(PROBLEM)
            assert runner.take(wait=True) is None
        assert runner.given_up
        assert (runner.pid, runner.busy) == (None, False)
        assert told == [GIVEN_UP]
        assert caplog.text.count(GIVEN_UP) == 1
        assert caplog.text.count("is started again") == 4
    finally:
        runner.close()


@pytest.mark.parametrize("wait", [False, True])
def test_a_child_that_hangs_is_ended_and_another_goes_on(wait, caplog):
    runner = ProcessBundle()
    try:
        os.kill(runner.pid, signal.SIGSTOP)
        hung = runner.pid
        assert runner.submit(PROBLEM)
        assert runner.take() is None
        assert runner.busy
        runner._exchange.since_s -= 2 * worker.DEADLINE_S
        result = runner.take(wait=wait)
        assert (result is not None) == wait, "another child answers one who waits"
        assert not runner.busy
        assert runner.pid != hung
        assert caplog.text.count("is started again") == 1
        assert runner.submit(PROBLEM), "the next one is taken"
    finally:
        runner.close()


@pytest.mark.parametrize("goes_on", [False, True])
def test_a_child_that_does_not_read_holds_nobody_up(goes_on):
    large = replace(PROBLEM, xyz=np.zeros((500_000, 3)))
    runner = ProcessBundle()
    try:
        os.kill(runner.pid, signal.SIGSTOP)
        taken = []
        caller = threading.Thread(target=lambda: taken.append(runner.submit(large)), daemon=True)
        caller.start()
        caller.join(DEADLINE_S)
        assert taken == [True]
        assert runner.take() is None
        assert runner.busy
        if goes_on:
            os.kill(runner.pid, signal.SIGCONT)
            before = runner.pid
            assert runner.take(wait=True) is not None
            assert runner.pid == before
    finally:
        since_s = time.monotonic()
        runner.close()
    assert time.monotonic() - since_s < DEADLINE_S
    assert not any(thread.name == "semcast-bundle-exchange" for thread in threading.enumerate())


def test_ctrl_c_does_not_reach_a_child_that_still_starts():
    runner = ProcessBundle(lossless=True)
    try:
        child = runner.pid
        os.kill(child, signal.SIGINT)
        assert runner.submit(PROBLEM)
        runner.take()
        assert runner.pid == child
    finally:
        runner.close()
