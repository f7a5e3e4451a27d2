import numpy as np
import pytest

from semcast.common.playback import check_playback, usual_period_ns


def test_what_is_not_given_and_what_is_in_range_passes():
    check_playback()
    check_playback(resize=0.05, stride=1, max_frames=1, rate_hz=0.01)
    check_playback(resize=1.0, rate_hz=1000.0)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"resize": 1.01}, r"resize must be in \[0.05, 1\], got 1.01"),
        ({"resize": float("nan")}, r"resize must be in \[0.05, 1\], got nan"),
        ({"stride": 0}, "stride must be at least 1, got 0"),
        ({"max_frames": -1}, "max_frames must be at least 1, got -1"),
        ({"rate_hz": 0.0}, r"rate_hz must be in \[0.01, 1000\], got 0"),
    ],
)
def test_each_value_has_its_range(given, text):
    with pytest.raises(ValueError, match=text):
        check_playback(**given)


def test_a_gap_does_not_change_the_usual_period():
    assert usual_period_ns(np.array([0, 40, 80, 120, 900], np.int64)) == 40.0


@pytest.mark.parametrize("size", [2, 3, 5, 12])
def test_of_frames_in_bunches_the_period_is_that_of_the_camera(size):
    times_ns = np.array([(k // size * size + size) * 100_000_000 + k % size * 2_000_000 for k in range(120)])
    assert usual_period_ns(times_ns) == pytest.approx(100_000_000, rel=0.2)
    times_ns[36:] += 40_000_000_000
    assert usual_period_ns(times_ns) == pytest.approx(100_000_000, rel=0.2), "with a pause as well"


def test_lost_frames_and_pauses_do_not_change_the_usual_period():
    rng = np.random.default_rng(0)
    came = np.flatnonzero(rng.random(200) > 0.5) * 40
    assert usual_period_ns(came) == 40.0
    paused = np.arange(60) * 40 + 1000 * (np.arange(60) // 20)
    assert usual_period_ns(paused) == 40.0


def test_one_frame_counts_as_ten_a_second():
    assert usual_period_ns(np.array([7], np.int64)) * 1e-9 == 0.1
