import numpy as np
import pytest

from semcast.agent.video_times import VideoTimes


@pytest.mark.parametrize(
    ("stamps_ms", "times_ms"),
    [
        ([7, 107, 117, 127, 327, 337, 347, 357, 367, 377], [0, 100, 110, 120, 320, 330, 340, 350, 360, 370]),
        ([0.0] * 10, [20 * k for k in range(10)]),
        ([20.0001 * k for k in range(10)], [20 * k for k in range(10)]),
        ([0, 20.9, 40, 59.1, 80, 100, 120, 140, 160, 180], [20 * k for k in range(10)]),
        ([0, 100, 110, 110, 310, 320, 330, 340, 350, 360], [0, 100, 110, 130, 310, 320, 330, 340, 350, 360]),
        ([0, 30, 40, np.nan], [0, 30, 40, 60]),  # late once, and then where it is usually
        ([0, 100, 90, 80, 310, np.nan, 340, 350, 360, 370], [0, 100, 120, 140, 310, 330, 340, 350, 360, 370]),
    ],
)
def test_times_of_a_video_are_its_own_where_it_has_some(stamps_ms, times_ms):
    times = VideoTimes(50.0)
    assert [times.next_ns(stamp_ms) for stamp_ms in stamps_ms] == [1_000_000 * t for t in times_ms]
    assert times_in_ms(stamps_ms) == times_ms, "known a frame ahead, they are no others"


def times_in_ms(stamps_ms):
    times = VideoTimes(50.0)
    return [times.next_ns(*both) / 1e6 for both in zip(stamps_ms, [*stamps_ms[1:], np.nan], strict=True)]


@pytest.mark.parametrize("wrong_ms", [85, 300, 1e8])
@pytest.mark.parametrize("at", [1, 2, 6])
def test_a_single_stamp_that_is_far_ahead_is_wrong(at, wrong_ms):
    regular = [20 * k for k in range(10)]
    assert times_in_ms([*regular[:at], regular[at] + wrong_ms, *regular[at + 1 :]]) == regular
    uneven = [0, 30, 45, 60, 90, 100, 125, 140, 150, 170]
    got = times_in_ms([*uneven[:at], uneven[at] + wrong_ms, *uneven[at + 1 :]])
    assert got == [*uneven[:at], uneven[at - 1] + 20, *uneven[at + 1 :]]


def test_after_several_that_are_far_ahead_frames_come_at_the_usual_rate():
    stamps_ms = [0, 20, 5000, 5040, *(20 * k for k in range(4, 200))]
    assert times_in_ms(stamps_ms) == [0, 20, *(5000, 5040), *(5040 + 20 * k for k in range(1, 197))]


@pytest.mark.parametrize(
    ("period_ms", "num_read", "num_stored", "is_cut"),
    [
        (20, 10, 14, True),
        # 280 ms at its usual rate, as counted of a container that says no number.
        (30, 10, 14, False),
        (20, 11, 14, False),
        (20, 97, 100, False),
        (20, 979, 1000, True),
        (20, 980, 1000, False),
    ],
)
def test_a_video_is_cut_where_it_neither_has_its_frames_nor_lasts_to_its_end(
    period_ms, num_read, num_stored, is_cut
):
    times = VideoTimes(50.0)
    for k in range(num_read):
        times.next_ns(period_ms * k)
    assert times.is_cut(num_stored) is is_cut
