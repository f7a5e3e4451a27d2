"""Decoding ahead keeps the order, never runs away, and survives what can't be decoded."""

import threading
import time

from waiting import came_true, until

from semcast.common.errors import ProtocolError
from semcast.server.decode_ahead import DecodeAhead


class Inbox:
    """Hands out 0, 1, 2, ... and remembers how far it was emptied."""

    def __init__(self, num):
        self.taken = 0
        self._num = num

    def take(self, timeout_s):
        if self.taken == self._num:
            threading.Event().wait(min(timeout_s, 0.01))
            return None
        self.taken += 1
        return self.taken - 1


def drain(ahead, num):
    got, deadline = [], time.monotonic() + 60
    while len(got) < num and time.monotonic() < deadline:
        item = ahead.get(0.1)
        if item is not None:
            got.append(item)
    return got


def test_every_frame_comes_out_once_and_in_order():
    inbox = Inbox(200)
    ahead = DecodeAhead(inbox.take, lambda x: x * 10, lambda m, r: None)
    assert drain(ahead, 200) == [10 * k for k in range(200)]
    assert ahead.get(0.0) is None
    ahead.close()
    ahead.close()


def test_no_more_than_one_frame_is_taken_ahead_of_the_tracker():
    inbox, decoded = Inbox(50), threading.Event()

    def decode(x):
        decoded.set()
        return (x,)

    ahead = DecodeAhead(inbox.take, decode, lambda m, r: None)
    assert decoded.wait(60)
    assert ahead.get(60.0) == (0,)
    # One may now be decoded and wait; a second one must not have been taken for it.
    deadline = time.monotonic() + 0.3
    while time.monotonic() < deadline:
        assert inbox.taken <= 2
    ahead.close()


def test_it_is_busy_until_the_tracker_has_what_was_taken():
    inbox, may_decode = Inbox(2), threading.Event()

    def decode(x):
        assert may_decode.wait(60)
        if x == 1:
            raise ProtocolError("the samples don't fit")
        return (x,)

    ahead = DecodeAhead(inbox.take, decode, lambda m, r: None)
    until(lambda: ahead.is_busy, deadline_s=30.0)
    may_decode.set()
    assert not came_true(lambda: not ahead.is_busy, 0.1), "decoded, it still waits for the tracker"
    assert ahead.get(60.0) == (0,)
    until(lambda: inbox.taken == 2 and not ahead.is_busy)
    ahead.close()


def test_one_bad_frame_never_stops_the_stream(caplog):
    failures = []

    def decode(x):
        if x in (1, 2):
            raise ProtocolError("the samples don't fit")
        if x == 3:
            raise ZeroDivisionError
        return x + 100

    inbox = Inbox(6)
    ahead = DecodeAhead(inbox.take, decode, lambda m, r: failures.append((m, r)))
    with caplog.at_level("WARNING"):
        assert drain(ahead, 3) == [100, 104, 105]
    ahead.close()
    assert failures == [(1, "codec"), (2, "codec"), (3, "decode")]
    assert caplog.text.count("the samples don't fit") == 1


def test_a_frame_that_can_not_be_taken_never_stops_the_stream(caplog):
    inbox = Inbox(3)

    def take(timeout_s):
        number = inbox.take(timeout_s)
        if number == 1:
            raise ZeroDivisionError
        return number

    ahead = DecodeAhead(take, lambda x: x + 100, lambda m, r: None)
    assert drain(ahead, 2) == [100, 102]
    ahead.close()
    assert "taking a frame failed" in caplog.text


def test_a_frame_that_can_not_even_be_left_out_never_stops_the_stream(caplog):
    def decode(x):
        if x < 2:
            raise ZeroDivisionError
        return x

    def on_failure(message, reason):
        raise RuntimeError("nobody wants to know")

    ahead = DecodeAhead(Inbox(4).take, decode, on_failure)
    assert drain(ahead, 2) == [2, 3]
    ahead.close()
    assert caplog.text.count("leaving a frame out failed: nobody wants to know") == 1


def test_a_failure_that_comes_again_with_every_frame_is_logged_once(caplog):
    def fails(x):
        raise ZeroDivisionError("always")

    failures = []
    ahead = DecodeAhead(Inbox(50).take, fails, lambda m, r: failures.append((m, r)))
    until(lambda: len(failures) == 50)
    ahead.close()
    assert failures == [(k, "decode") for k in range(50)]
    assert [record.getMessage() for record in caplog.records] == ["decoding a frame failed: always"]


def test_one_that_got_stale_while_it_waited_is_left_out_and_one_that_was_waited_for_is_not():
    asked, got = [], []

    def is_stale(x):
        asked.append(x)
        return True

    ahead = DecodeAhead(Inbox(10_000).take, lambda x: x, lambda m, r: None, is_stale)
    deadline = time.monotonic() + 60
    while not asked:
        assert time.monotonic() < deadline
        got.append(ahead.get(60.0))
        time.sleep(0.01)  # the tracker is busy, and the next one waits
    ahead.close()
    last = len(got)
    assert asked == [last - 1]
    assert got == [*range(last - 1), last]


def test_what_nobody_took_before_the_end_is_dropped():
    inbox, decoded = Inbox(1), threading.Event()
    ahead = DecodeAhead(inbox.take, lambda x: decoded.set() or (x,), lambda m, r: None)
    assert decoded.wait(60)
    until(lambda: not ahead._is_decoding, "the frame in the slot")
    ahead.close()
    assert ahead.get(0.0) is None
    assert not ahead.is_busy


def test_the_end_does_not_wait_long_for_a_frame_that_is_being_decoded(caplog, monkeypatch):
    monkeypatch.setattr("semcast.server.decode_ahead.CLOSE_S", 0.05)
    begun, may_end = threading.Event(), threading.Event()
    ahead = DecodeAhead(Inbox(1).take, lambda x: begun.set() or may_end.wait(60), lambda m, r: None)
    assert begun.wait(60)
    ahead.close()
    assert [record.getMessage() for record in caplog.records] == [
        "the frame that is being decoded is left: its image is not waited for"
    ]
    may_end.set()
    until(lambda: not ahead._thread.is_alive(), "the end of the thread behind it")
