"""What the demo sends: as large and as often as this machine can serve."""

import multiprocessing
import os
import threading

import numpy as np
import pytest

from semcast import real_time
from semcast.common.conventional import ConventionalCodec
from semcast.common.errors import ConfigError, SemcastError
from semcast.real_time import MAX_PIXELS, Plan, Speed, make_plan, measure_speed, plan_for

pytestmark = pytest.mark.xdist_group("real-time")

#: A machine that serves images of ``MAX_PIXELS`` at 10 Hz with two cores, just so.
FIT = Speed(coding_ms=41.0, following_ms=12.5)
WIDE = (500, 1000)


def noise(height, width):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def times(factor):
    return Speed(factor * FIT.coding_ms, factor * FIT.following_ms)


def test_a_machine_that_keeps_up_sends_all_and_reduces_only_large_images():
    assert make_plan(FIT, (480, 500), 10.0, 2) == Plan(1.0, 10.0)
    plan = make_plan(FIT, WIDE, 10.0, 2)
    assert plan == Plan(pytest.approx((MAX_PIXELS / 500_000) ** 0.5, abs=0.01), 10.0)
    assert make_plan(times(0.01), WIDE, 10.0, 2) == plan, "never faster than recorded, never larger"


def test_a_slow_machine_gets_smaller_images_first_and_then_fewer_a_second():
    fit, slower, slow = (make_plan(times(factor), WIDE, 10.0, 2) for factor in (1.0, 1.3, 3.0))
    assert slower.resize < fit.resize
    assert slower.rate_hz == 10.0
    assert slow.resize == pytest.approx(0.6**0.5 * fit.resize, abs=0.01)
    assert 3.0 < slow.rate_hz < 6.0
    assert make_plan(times(6.0), WIDE, 10.0, 2).rate_hz == pytest.approx(slow.rate_hz / 2, rel=0.01)
    assert make_plan(times(3.0), WIDE, 2.0, 2) == Plan(fit.resize, 2.0), "a slow recording has time enough"


def test_more_cores_serve_more_and_a_size_that_is_asked_for_is_kept():
    assert make_plan(times(1.8), WIDE, 10.0, 4).rate_hz == 10.0
    asked = make_plan(FIT, WIDE, 10.0, 2, resize=1.0)
    assert asked.resize == 1.0
    assert 6.0 < asked.rate_hz < 9.0


def test_the_work_is_timed_on_the_images_themselves():
    small, large = (measure_speed("jpeg-ldpc", "16qam", noise(side, side)) for side in (48, 256))
    assert 0.0 < small.coding_ms < large.coding_ms
    assert 0.0 < small.following_ms < large.following_ms
    flat = measure_speed("jpeg-ldpc", "16qam", np.full((64, 64, 3), 90, np.uint8))
    assert flat.following_ms > 0.0, "nothing to follow is no error"


def test_a_poor_link_that_takes_longer_to_decode_is_what_is_timed(monkeypatch):
    timed = set()
    decode = ConventionalCodec.decode

    def noted(codec, received):
        timed.add(float(received.effective_snr_db[0]))
        return decode(codec, received)

    monkeypatch.setattr(ConventionalCodec, "decode", noted)
    for snr_db in (4.0, 12.0):
        measure_speed("jpeg-ldpc", "16qam", noise(48, 48), snr_db=snr_db)
    assert timed == {4.0, 12.0}


def test_cores_that_are_shared_promise_less(monkeypatch):
    alone = {"coding": [40.0, 40.0], "following": [10.0, 10.0]}
    shared = {"coding": [40.0, 120.0], "following": [10.0, 30.0]}
    speeds = []
    for ms in (alone, shared):
        left = {name: list(values) for name, values in ms.items()}
        monkeypatch.setattr(real_time, "_coding_ms", lambda *_given, left=left: left["coding"].pop())
        monkeypatch.setattr(real_time, "_following_ms", lambda _image, left=left: left["following"].pop())
        speeds.append(measure_speed("jpeg-ldpc", "16qam", noise(48, 48), num_cores=2))
    assert speeds == [Speed(40.0, 10.0), Speed(60.0, 15.0)], "two cores do 1/40 + 1/120 images a millisecond"


def test_the_plan_follows_from_a_measurement_in_a_process_of_its_own():
    plan = plan_for("3dcsc-lite", "16qam", noise(720, 1280), 10.0)
    assert 0.4 <= plan.resize <= 0.52
    assert 0.0 < plan.rate_hz <= 10.0
    with pytest.raises(ConfigError, match="codec must be"):
        plan_for("3dcs", "16qam", noise(64, 64), 10.0)


def die(*_given):
    os._exit(9)


def test_a_measurement_whose_process_dies_is_one_clear_error(monkeypatch):
    monkeypatch.setattr(real_time, "measure_speed", die)
    with pytest.raises(SemcastError, match="ended early, .* with --resize and --rate-hz nothing is measured"):
        plan_for("3dcsc-lite", "16qam", noise(64, 64), 10.0)


def test_a_measurement_is_given_up_when_the_demo_is_stopped():
    stop = threading.Event()
    stop.set()
    assert plan_for("3dcsc-lite", "16qam", noise(720, 1280), 10.0, stop=stop) is None
    assert not multiprocessing.active_children()
