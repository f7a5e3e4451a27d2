"""Adjustments in the process itself and in one of their own."""

import os
import signal

import numpy as np
from small_windows import make_problem

from semcast.server.mapping.bundle import InlineBundle, optimise
from semcast.server.mapping.bundle_process import ProcessBundle


def test_inline_gives_the_same_bits_again():
    results = []
    for _ in range(2):
        runner = InlineBundle()
        assert runner.submit(make_problem()[0])
        assert runner.busy
        assert not runner.submit(make_problem()[0])
        results.append(runner.take())
        assert runner.take() is None
    assert np.array_equal(results[0].T_world_cam, results[1].T_world_cam)
    assert np.array_equal(results[0].xyz, results[1].xyz)


def test_the_process_gives_what_inline_gives_and_survives_a_kill():
    problem, _, _ = make_problem()
    inline = optimise(problem)
    runner = ProcessBundle(lossless=True)
    try:
        assert runner.submit(problem)
        result = runner.take()
        assert result is not None
        assert np.array_equal(result.T_world_cam, inline.T_world_cam)
        before = runner.pid
        os.kill(before, signal.SIGKILL)
        assert runner.submit(problem) or runner.submit(problem)
        result = runner.take()
        assert result is not None
        assert np.array_equal(result.xyz, inline.xyz)
        assert runner.pid != before
    finally:
        runner.close()
        runner.close()
    assert not runner.submit(problem)
    assert runner.take() is None


def test_live_process_never_waits_unless_asked():
    runner = ProcessBundle()
    try:
        assert runner.take() is None
        assert runner.submit(make_problem()[0])
        assert runner.busy
        result = runner.take() or runner.take(wait=True)
        assert result is not None
        assert result.ok
        assert not runner.busy
    finally:
        runner.close()
