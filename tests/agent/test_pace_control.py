"""The agent's pace against a simulated server that takes so long for a frame and keeps the newest waiting."""

import numpy as np
import pytest

from semcast.agent.pace_control import MAX_STRIDE, PaceControl, start_stride
from semcast.common.messages import LinkReport

PERIOD_S = 1 / 30


def report(frame_id, num_superseded, epoch=1):
    return LinkReport(
        agent_epoch=epoch,
        frame_id=frame_id,
        snr_db_estimate=10.0,
        t_capture_ns=round(frame_id * PERIOD_S * 1e9),
        num_superseded=num_superseded,
    )


class Server:
    """Serves one frame at a time; a newer one replaces the one that waits."""

    def __init__(self, pace, service_s):
        self.pace, self.service_s = pace, service_s
        self.encoder_free_s = 0.0
        self.free_s = 0.0
        self.waiting = None
        self.superseded = 0
        self.served = []

    def put(self, frame_id, now_s):
        self.advance(now_s)
        if self.waiting is not None:
            self.superseded += 1
        self.waiting = frame_id
        self.advance(now_s)

    def advance(self, now_s):
        if self.waiting is not None and self.free_s <= now_s:
            started_s = max(self.free_s, self.waiting * PERIOD_S)
            self.pace.on_report(report(self.waiting, self.superseded))
            self.served.append(self.waiting)
            self.free_s = started_s + self.service_s(started_s)
            self.waiting = None


def run(service_s, seconds, lost=0.0, rate_hz=0.0, encode_s=0.0):
    """Return the pace, the server and the stride at every frame of a 30 Hz source; it need not be known.

    An encoder that is busy passes frames over.
    """
    pace = PaceControl(1, rate_hz)
    server = Server(pace, service_s)
    rng = np.random.default_rng(0)
    strides = []
    for frame_id in range(round(seconds / PERIOD_S)):
        now_s = frame_id * PERIOD_S
        if pace.wants(round(now_s * 1e9)) and server.encoder_free_s <= now_s:
            server.encoder_free_s = now_s + encode_s
            pace.on_sent()
            if rng.random() >= lost:
                server.put(frame_id, now_s)
        server.advance(now_s)
        strides.append(pace.stride)
    return pace, server, np.array(strides)


@pytest.mark.parametrize(
    ("service_ms", "stride"), [(20, 1), (30, 1), (35, 1), (40, 1), (55, 2), (100, 3), (165, 4)]
)
def test_the_stride_is_what_the_server_can_serve(service_ms, stride):
    _, server, strides = run(lambda now_s: service_ms * 1e-3, 20)
    assert np.median(strides[60:]) == stride
    after = strides[150:]
    assert np.mean(after == stride) > 0.6, "more is tried seldom"
    gaps = np.diff(server.served[-40:])
    assert np.mean(gaps == stride) > 0.7, "evenly spaced"


def test_an_encoder_that_is_slower_than_the_source_does_not_hide_that_the_server_is_slower_still():
    _, server, strides = run(lambda now_s: 0.3, 30, encode_s=0.13)
    settled = np.flatnonzero(strides >= 8)
    assert settled[0] * PERIOD_S < 10.0, "one frame in two would be what the encoder leaves out anyway"
    gaps = np.diff([frame_id for frame_id in server.served if frame_id > 300])
    assert np.median(gaps) >= 8
    _, server, strides = run(lambda now_s: 0.02, 10, encode_s=0.13)
    assert set(strides) == {1}, "a server that keeps up is no reason to send less"


def test_a_server_that_takes_a_second_for_a_frame_is_soon_spared_what_it_passes_over():
    _, server, strides = run(lambda now_s: 0.9, 80)
    first = np.flatnonzero(strides > 1)[0] * PERIOD_S
    assert first < 13.0, "twenty and twelve reports would take 29 s"
    assert 20 <= strides[-1] <= 27, "few of them are passed over"
    assert np.ptp(np.diff(server.served[-6:])) <= strides[-1], "and the rest is evenly spaced"


def test_after_a_slow_server_the_pace_is_back_within_minutes():
    _, _, strides = run(lambda now_s: 0.9 if now_s < 60 else 0.02, 210)
    assert strides[60 * 30] > 20
    assert strides[-1] == 1


def test_what_the_beginning_of_a_map_keeps_the_server_from_says_nothing_of_the_pace():
    pace, passed_over = PaceControl(1, rate_hz=0.0), 0
    for frame_id in range(60):
        assert pace.wants(round(frame_id * PERIOD_S * 1e9))
        passed_over += 2 if frame_id <= 20 else 0
        pace.on_report(report(frame_id, passed_over))
    assert pace.stride == 1
    for frame_id in range(60, 76):
        passed_over += 2
        pace.on_report(report(frame_id, passed_over))
    assert pace.stride > 1


def test_trials_of_more_become_rare_when_they_fail():
    _, _, strides = run(lambda now_s: 0.060, 300)
    trials = np.flatnonzero((strides[1:] == 1) & (strides[:-1] == 2))
    early, late = np.sum(trials < 30 * 60), np.sum(trials >= 30 * 240)
    assert early >= 3
    assert 1 <= late <= 3


def test_the_stride_comes_back_when_the_server_has_time_again(caplog):
    caplog.set_level("INFO")
    _, _, strides = run(lambda now_s: 0.160 if now_s < 10 else 0.015, 60)
    assert strides[: 10 * 30].max() == 4
    assert strides[-1] == 1
    assert "sending one frame in 4, as many as the server can follow" in caplog.text
    assert caplog.messages[-1] == "sending every frame"


def test_one_busy_moment_and_frames_lost_on_the_air_change_nothing():
    busy = (5.0, 5.6)
    _, server, strides = run(lambda now_s: 0.25 if busy[0] <= now_s < busy[1] else 0.02, 20, lost=0.3)
    assert server.superseded >= 5
    assert set(strides) == {1}


def test_a_stride_has_an_end():
    pace, _, strides = run(lambda now_s: 2.0, 240)
    assert pace.stride == strides.max() == MAX_STRIDE


def test_reports_of_others_and_old_ones_count_for_nothing():
    pace = PaceControl(1, 0.0)
    assert pace.wants(0)
    for k in range(1, 40):
        pace.on_report(report(k, 3 * k, epoch=2))
    pace.on_report(report(50, 0))
    for k in range(1, 40):
        pace.on_report(report(k, 3 * k))
    assert pace.stride == 1
    for k in range(51, 70):
        pace.on_report(report(k, 1000 - k))
    assert pace.stride == 1, "a server that counts from 0 again has passed over nothing"
    for k in range(70, 90):
        pace.on_report(report(k, 1000 + k))
    assert pace.stride > 1


def test_a_fast_source_begins_with_what_two_cores_can_serve_and_goes_up():
    assert [start_stride(rate_hz) for rate_hz in (0, 5, 10, 15, 20, 30, 60, 1000)] == [
        1,
        1,
        1,
        1,
        2,
        3,
        5,
        MAX_STRIDE,
    ]
    pace = PaceControl(1, 30.0)
    assert [pace.wants(k) for k in range(7)] == [True, False, False, True, False, False, True]
    _, server, strides = run(lambda now_s: 0.02, 20, rate_hz=30.0)
    assert (strides[0], strides[-1]) == (3, 1)
    assert server.superseded == 0


@pytest.mark.parametrize(("given_hz", "stride"), [(10.0, 1), (20.0, 2), (30.0, 3), (60.0, 3)])
def test_a_camera_that_gives_fewer_images_than_it_says_is_thinned_by_what_it_gives(given_hz, stride):
    pace = PaceControl(1, 30.0)
    for k in range(round(1.2 * given_hz)):
        pace.wants(round(k / given_hz * 1e9))
        if k < 0.9 * given_hz:
            assert pace.stride == 3
    assert pace.stride == stride


def test_a_camera_that_pauses_after_its_first_frame_is_not_taken_for_a_slow_one():
    pace = PaceControl(1, 30.0)
    for t_s in (0.0, *(1.5 + k * PERIOD_S for k in range(60))):
        pace.wants(round(t_s * 1e9))
    assert pace.stride == 3


class Reports:
    """Reports on every frame of a source, each with so many passed over since the one before."""

    def __init__(self):
        self.pace = PaceControl(1, 0.0)
        self.frame_id = self.passed_over = 0

    def next(self, passed_over):
        self.pace.wants(round(self.frame_id * PERIOD_S * 1e9))
        self.frame_id += 1
        self.passed_over += passed_over
        self.pace.on_report(report(self.frame_id, self.passed_over))

    def num_until_stride(self, stride, passed_over):
        """Return how many reports, all alike, it takes."""
        for count in range(1, 1000):
            self.next(passed_over)
            if self.pace.stride == stride:
                return count
        raise AssertionError(f"the stride stays {self.pace.stride}")


def test_a_trial_that_fails_doubles_the_patience_and_one_that_lasts_ends_that():
    reports = Reports()
    reports.num_until_stride(2, passed_over=1)
    first = reports.num_until_stride(1, passed_over=0)
    assert 30 <= first <= 33, "thirty, and those of frames from before the change: nothing has failed yet"
    reports.num_until_stride(2, passed_over=1)
    assert reports.num_until_stride(1, passed_over=0) == first + 30, "the trial failed at once"
    for _ in range(40):
        reports.next(0)
    reports.num_until_stride(2, passed_over=1)
    assert reports.num_until_stride(1, passed_over=0) == first, "that one did not"
