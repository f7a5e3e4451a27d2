import pytest

from semcast.common.messages import StatusMessage
from semcast.common.metrics import WINDOW, Metrics, duration_percentiles
from semcast.common.wire import pack, unpack


class Clock:
    def __init__(self):
        self.now_ns = 10**12

    def __call__(self):
        return self.now_ns

    def advance(self, seconds):
        self.now_ns += round(seconds * 1e9)


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def metrics(clock):
    return Metrics("agent", clock)


def test_percentiles_of_durations_by_hand():
    assert duration_percentiles([1.0, 2.0, 3.0, float("nan")]) == {"p50": 2.0, "p95": 2.9, "max": 3.0}
    assert duration_percentiles([float("inf")]) is None


def test_rates_are_over_the_last_five_seconds(metrics, clock):
    for _ in range(40):
        metrics.count("sent")
        clock.advance(0.1)
    assert metrics.rates_hz()["sent"] == pytest.approx(10.0)  # 40 in the 4 s since the start
    clock.advance(3.0)
    assert metrics.rates_hz()["sent"] == pytest.approx(20 / 5, abs=0.21)
    clock.advance(10.0)
    assert metrics.rates_hz()["sent"] == 0.0
    assert metrics.counts == {"sent": 40}


def test_stage_times_are_percentiles_of_the_last_runs(metrics, clock):
    for k in range(1, 101):
        metrics.observe("encode", float(k))
    assert metrics.stages_ms()["encode"] == pytest.approx({"p50": 50.5, "p95": 95.05, "max": 100.0})
    for _ in range(WINDOW):
        metrics.observe("encode", 2.0)
    assert metrics.stages_ms()["encode"] == {"p50": 2.0, "p95": 2.0, "max": 2.0}

    def run_and_fail():
        with metrics.stage("broken"):
            clock.advance(0.25)
            raise KeyError

    with pytest.raises(KeyError):
        run_and_fail()
    assert metrics.stages_ms()["broken"]["max"] == pytest.approx(250.0)


def test_drops_are_counted_by_reason_and_can_be_taken_back(metrics):
    metrics.drop("missing", 3)
    metrics.drop("missing", -1)
    metrics.drop("stale")
    metrics.drop("superseded", 0)
    assert metrics.drops == {"missing": 2, "stale": 1}


def test_the_status_travels(metrics, clock):
    for _ in range(3):
        metrics.count("sent")
    metrics.drop("stale")
    metrics.observe("encode", 4.0)
    metrics.error("it broke")
    clock.advance(2.0)
    status = unpack(pack(metrics.status(7)), StatusMessage)
    assert (status.role, status.agent_epoch, status.uptime_s, status.last_error) == (
        "agent",
        7,
        2.0,
        "it broke",
    )
    assert status.counts == {"sent": 3, "errors": 1}
    assert status.drops == {"stale": 1}
    assert status.stages_ms == {"encode": (4.0, 4.0, 4.0)}
    assert metrics.summary()["stage_ms"]["encode"] == {"p50": 4.0, "p95": 4.0, "max": 4.0}


def test_what_a_process_is_at_travels_until_it_is_done(metrics):
    assert metrics.status(7).activity == ""
    metrics.be_at("depth 3 of 9 keyframes")
    assert unpack(pack(metrics.status(7)), StatusMessage).activity == "depth 3 of 9 keyframes"
    metrics.be_at("")
    assert metrics.status(7).activity == ""


def test_an_error_about_a_file_whose_name_is_no_text_does_not_end_the_status(metrics):
    metrics.error("room\udcff can't be written to")
    assert unpack(pack(metrics.status(1)), StatusMessage).last_error == "room? can't be written to"


def test_absurd_numbers_of_missing_frames_do_not_end_the_status(metrics):
    for _ in range(2):
        metrics.drop("missing", 2**63 - 1)  # what one frame with an absurd number leaves missing
    assert unpack(pack(metrics.status(1)), StatusMessage).drops == {"missing": 2**63 - 1}


def test_the_closing_line_says_what_was_dropped(metrics):
    for _ in range(45):
        metrics.count("sent")
    assert metrics.closing_line("sent") == "45 frames sent; dropped: none"
    metrics.drop("superseded", 6)
    metrics.drop("missing", 1)
    metrics.drop("missing", -1)
    assert metrics.closing_line("sent") == "45 frames sent; dropped: 6 superseded"
    metrics.drop("duplicate", 2)
    assert metrics.closing_line("sent") == "45 frames sent; dropped: 6 superseded; came twice: 2"


def test_one_frame_is_no_frames(metrics):
    metrics.count("sent")
    assert metrics.closing_line("sent") == "1 frame sent; dropped: none"
