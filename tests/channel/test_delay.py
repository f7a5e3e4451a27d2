import queue
import threading
import time

import numpy as np
import pytest

from semcast.channel.delay import CAPACITY, DelayLine, extra_delay_ms


class Ends:
    """A delay line and what comes out of it."""

    def __init__(self):
        self.out = queue.Queue()
        self.line = DelayLine(lambda packet, lossless: self.out.put((packet, time.monotonic())))


@pytest.fixture
def ends():
    opened = Ends()
    yield opened
    opened.line.close()


def test_without_delay_a_packet_is_sent_at_once_by_the_caller(ends):
    assert ends.line.put(b"a", False, 0.0)
    assert ends.out.get_nowait()[0] == b"a"


def test_a_packet_takes_as_long_as_set_and_packets_overlap(ends):
    start_s = time.monotonic()
    for k in range(100):
        ends.line.put(bytes([k]), False, 400.0)
    came = [ends.out.get(timeout=60) for _ in range(100)]
    assert [packet[0] for packet, _ in came] == list(range(100))
    assert came[0][1] - start_s >= 0.4
    assert came[-1][1] - came[0][1] < 20.0, "a hundred delays of 0.4 s pass at the same time"


def test_jitter_delays_but_never_reorders(ends):
    start_s = time.monotonic()
    for k in range(50):
        ends.line.put(bytes([k]), False, extra_delay_ms(20.0, 0, k))
    came = [ends.out.get(timeout=60) for _ in range(50)]
    assert [packet[0] for packet, _ in came] == list(range(50))
    longest_s = 1e-3 * max(extra_delay_ms(20.0, 0, k) for k in range(50))
    assert came[-1][1] - start_s >= longest_s > 0.025


def test_jitter_belongs_to_the_frame_and_is_exponential():
    drawn = np.array([extra_delay_ms(20.0, 3, k) for k in range(2000)])
    assert drawn.mean() == pytest.approx(20.0, abs=4 * 20.0 / 2000**0.5)
    assert np.median(drawn) == pytest.approx(20.0 * np.log(2), abs=2.0)
    assert extra_delay_ms(20.0, 3, 1234) == drawn[1234]
    assert extra_delay_ms(10.0, 3, 1234) == drawn[1234] / 2
    assert extra_delay_ms(0.0, 3, 1234) == 0.0
    assert extra_delay_ms(20.0, 4, 1234) != drawn[1234]


def test_a_delay_taken_back_does_not_let_packets_overtake(ends):
    ends.line.put(b"slow", False, 80.0)
    ends.line.put(b"fast", False, 0.0)
    assert [ends.out.get(timeout=60)[0] for _ in range(2)] == [b"slow", b"fast"]


def test_a_packet_without_delay_waits_for_one_that_is_being_sent_and_for_no_other():
    began, may_end, sent = threading.Event(), threading.Event(), queue.Queue()

    def send(packet, lossless):
        if packet == b"slow":
            began.set()
            assert may_end.wait(10)
        sent.put((packet, threading.current_thread()))

    line = DelayLine(send)
    line.put(b"slow", False, 1.0)
    assert began.wait(10)
    line.put(b"fast", False, 0.0)
    may_end.set()
    assert [sent.get(timeout=60)[0] for _ in range(2)] == [b"slow", b"fast"]
    # Once the thread has seen that nothing is left, the caller sends again.
    deadline_s = time.monotonic() + 10
    sender = None
    while sender is not threading.current_thread() and time.monotonic() < deadline_s:
        line.put(b"later", False, 0.0)
        sender = sent.get(timeout=60)[1]
    assert sender is threading.current_thread()
    line.close()
    assert not line._thread.is_alive(), "a line where nothing waits ends too"


def test_a_full_line_refuses_packets(ends):
    assert all(ends.line.put(b"x", False, 10_000.0) for _ in range(CAPACITY))
    assert not ends.line.put(b"x", False, 10_000.0)
    ends.line.close()
    ends.line.close()
    assert ends.out.empty()


def test_a_line_holds_no_more_bytes_than_it_may_and_takes_packets_again_when_some_have_left():
    out = queue.Queue()
    line = DelayLine(lambda packet, lossless: out.put(packet), capacity_bytes=10)
    assert line.put(bytes(6), False, 200.0)
    assert not line.put(bytes(5), False, 200.0)
    assert line.put(bytes(4), False, 200.0)
    assert [len(out.get(timeout=60)) for _ in range(2)] == [6, 4]
    assert line.put(bytes(10), False, 1.0)
    assert len(out.get(timeout=60)) == 10
    line.close()


def test_a_packet_that_can_not_be_sent_costs_itself_alone():
    sent, failed = queue.Queue(), []

    def send(packet, lossless):
        if packet == b"bad":
            raise RuntimeError("no such packet")
        sent.put(packet)

    line = DelayLine(send, failed.append)
    for packet in (b"bad", b"good"):
        assert line.put(packet, False, 1.0)
    assert sent.get(timeout=60) == b"good"
    assert failed == ["sending a delayed packet failed: no such packet"]
    line.close()
    assert not line.put(b"late", False, 1.0)
