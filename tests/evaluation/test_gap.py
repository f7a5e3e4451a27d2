"""Seconds of a recording that never arrive."""

import numpy as np
import pytest

from semcast.common.errors import ConfigError
from semcast.evaluation.gap import Gap, gap_in, outside, recovery_s
from semcast.evaluation.result_table import result_table
from semcast.evaluation.trajectory import TrajectorySettings, evaluate_trajectory

TIMES_NS = 7_000_000_000 + 100_000_000 * np.arange(100)


def test_a_gap_lies_inside_and_is_as_long_as_told():
    gaps = {gap_in(range(100), TIMES_NS, 1.0, seed) for seed in range(30)}
    assert len(gaps) > 15
    for gap in gaps:
        assert 20 <= gap.first_id <= gap.last_id <= 79
        assert gap.last_id - gap.first_id == 9
    assert gap_in(range(100), TIMES_NS, 1.0, 3) == gap_in(range(100), TIMES_NS, 1.0, 3)


def test_time_counts_whatever_the_stride():
    gap = gap_in(range(10, 100, 3), TIMES_NS, 1.5, 0)
    assert gap.first_id % 3 == gap.last_id % 3 == 1
    assert gap.last_id - gap.first_id == 12
    left = outside(range(10, 100, 3), gap)
    assert len(left) == 25
    assert set(range(10, 100, 3)) - set(left) == set(range(gap.first_id, gap.last_id + 1, 3))


@pytest.mark.parametrize(
    ("gap_s", "told"), [(6.5, "at most 5.94 in 9.9 s"), (0.01, "longer than frames are apart")]
)
def test_a_gap_that_does_not_fit_is_told(gap_s, told):
    with pytest.raises(ConfigError, match=told):
        gap_in(range(100), TIMES_NS, gap_s, 0)


def test_recovery_begins_with_the_first_frame_after_the_gap():
    rows = [
        {"frame_id": k, "t_source_ns": int(TIMES_NS[k]), "posed": k < 20 or k >= 33}
        for k in [*range(20), *range(30, 40)]
    ]
    assert recovery_s(rows, Gap(20, 29)) == pytest.approx(0.3)
    assert recovery_s(rows[:22], Gap(20, 29)) is None
    assert recovery_s(rows[:20], Gap(20, 29)) is None


def test_a_run_tells_how_soon_the_camera_was_located_again(room):
    settings = TrajectorySettings(sequence=room, codec="none", gap_s=0.2, seeds=2)
    report = evaluate_trajectory(settings)
    (cell,) = report["cells"]
    for run in cell["runs"]:
        gap = run["gap"]
        assert not any(gap["first_id"] <= row["frame_id"] <= gap["last_id"] for row in run["rows"])
        assert gap["recovery_s"] is not None
    assert cell["recovery_s"] <= 0.5
    assert "again" in result_table("trajectory", report).head
    without = evaluate_trajectory(TrajectorySettings(sequence=room, codec="none", max_frames=8))
    assert "gap" not in without["cells"][0]["runs"][0]
    assert "again" not in result_table("trajectory", without).head


@pytest.mark.parametrize("gap_s", [-0.1, 61.0, float("nan")])
def test_lengths_out_of_range_are_told(room, gap_s):
    with pytest.raises(ValueError, match=r"gap_s must be in \[0, 60\]"):
        TrajectorySettings(sequence=room, gap_s=gap_s)
