"""Ctrl-C is held back where it would do harm, and not lost."""

import multiprocessing
import signal

import pytest

from semcast.common.interrupts import ctrl_c_held, deaf_children


def test_ctrl_c_waits_for_the_end_of_the_block():
    done = []

    def work():
        with ctrl_c_held():
            signal.raise_signal(signal.SIGINT)
            done.append("all of it")

    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["all of it"]
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before


def test_a_child_never_hears_of_ctrl_c():
    child = multiprocessing.get_context("spawn").Process(target=signal.raise_signal, args=(signal.SIGINT,))
    with deaf_children():
        child.start()
    child.join(30.0)
    assert child.exitcode == 0
