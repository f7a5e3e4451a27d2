"""What waits for a consumer that is busy for a moment, and for one that is too slow for good."""

import threading

import pytest

from semcast.server import backlog
from semcast.server.backlog import Backlog

PERIOD_S = 0.1


class Clock:
    """A clock that is set."""

    now_s = 0.0

    def __call__(self):
        return self.now_s


def worked_off(num_frames, service_s, missing=(), burst=1):
    """Return ``[(frame, wait_s)]`` of a consumer that takes ``service_s(frame)`` for each that comes.

    So many as ``burst`` come at once, at the time of the last of them.
    """
    clock = Clock()
    waiting = Backlog(clock)
    taken, free_s, put, has_asked = [], 0.0, 0, False
    while put < num_frames or len(waiting):
        arrives_s = (put // burst * burst + burst - 1) * PERIOD_S if put < num_frames else float("inf")
        if free_s <= arrives_s and (len(waiting) or not has_asked):
            clock.now_s = max(clock.now_s, free_s)
            frame = waiting.get(0)
            has_asked = frame is None
            if frame is not None:
                taken.append((frame, clock.now_s - frame * PERIOD_S))
                free_s = clock.now_s + service_s(frame)
        else:
            clock.now_s = max(clock.now_s, arrives_s)
            if put not in missing:
                waiting.put(put)
            put += 1
    assert waiting.dropped == num_frames - len(missing) - len(taken)
    return taken


def test_nothing_is_lost_to_one_moment_in_which_the_consumer_is_busy():
    taken = worked_off(30, lambda frame: 0.45 if frame == 5 else 0.04)
    assert [frame for frame, _ in taken] == list(range(30))
    waits_s = [wait_s for _, wait_s in taken]
    assert max(waits_s) < 0.36
    assert waits_s[12:] == pytest.approx([0.0] * 18), "it has caught up"


def test_what_waited_too_long_gives_way_to_what_came_after():
    taken = worked_off(40, lambda frame: 1.05 if frame == 5 else 0.04)
    frames = [frame for frame, _ in taken]
    assert frames == [*range(6), *range(11, 40)]
    assert max(wait_s for _, wait_s in taken) <= backlog.MAX_WAIT_S


@pytest.mark.parametrize("service_s", [0.11, 0.15, 0.5])
def test_a_consumer_that_is_too_slow_for_good_is_not_late_for_good(service_s):
    taken = worked_off(300, lambda frame: service_s)
    waits_s = [wait_s for frame, wait_s in taken if frame * PERIOD_S > 3.0]
    assert max(waits_s) <= 2 * PERIOD_S + 1e-6
    assert sum(wait_s > PERIOD_S + 1e-6 for wait_s in waits_s) <= len(waits_s) // 10
    assert len(taken) >= 300 * PERIOD_S / service_s - 1, "it is never idle"


def test_a_frame_that_does_not_come_ends_no_overload():
    taken = worked_off(300, lambda frame: 0.15, missing=range(20, 300, 20))
    assert max(wait_s for frame, wait_s in taken if frame * PERIOD_S > 3.0) <= 0.15 + 1e-6


def test_after_an_overload_busy_moments_are_worked_off_again():
    taken = worked_off(120, lambda frame: 0.15 if frame < 30 else 0.45 if frame == 90 else 0.04)
    assert [frame for frame, _ in taken if frame >= 60] == list(range(60, 120))
    assert len([frame for frame, _ in taken if frame < 30]) < 25


def test_frames_that_come_three_at_once_do_not_keep_an_overload_going():
    taken = worked_off(120, lambda frame: 0.5 if frame < 30 else 0.07, burst=3)
    assert len([frame for frame, _ in taken if frame < 30]) < 15
    assert [frame for frame, _ in taken if frame >= 60] == list(range(60, 120))


@pytest.mark.parametrize("burst", [1, 3])
def test_an_overload_in_bursts_gets_the_newest(burst):
    taken = worked_off(300, lambda frame: 0.13, burst=burst)
    lasting = [frame for frame, _ in taken if frame >= 60]
    assert max(wait_s for frame, wait_s in taken if frame >= 60) <= 0.14 + burst * PERIOD_S
    assert len(lasting) >= 75


def test_a_flood_is_bounded_in_number():
    waiting = Backlog(Clock())
    for frame in range(1000):
        waiting.put(frame)
    assert (len(waiting), waiting.dropped) == (backlog.MAX_WAITING, 1000 - backlog.MAX_WAITING)
    assert waiting.get(0) == 1000 - backlog.MAX_WAITING
    assert waiting.clear() == backlog.MAX_WAITING - 1
    assert waiting.dropped == 1000 - backlog.MAX_WAITING
    assert waiting.get(0) is None


def test_closing_wakes_whoever_waits_and_keeps_what_is_inside():
    waiting = Backlog()
    taken = []
    consumer = threading.Thread(target=lambda: taken.extend((waiting.get(5), waiting.get(5))))
    consumer.start()
    waiting.put("last")
    waiting.close()
    consumer.join(60)
    assert taken == ["last", None]
    waiting.put("never")
    assert waiting.get(0) is None
