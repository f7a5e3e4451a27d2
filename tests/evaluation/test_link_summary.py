"""Two modes compared link by link over all recordings."""

import numpy as np
import pytest

from semcast.common.codec import DEFAULT_CODEC
from semcast.evaluation.link_summary import compare_links, link_summary


def cell(mode, errors, snr_db=2.0):
    runs = [
        {
            "seed": k,
            "ate_percent": final,
            "ate_at_once_percent": live,
            "rpe_trans_percent": final,
            "rpe_rot_deg": live,
        }
        for k, (final, live) in enumerate(errors)
    ]
    return {"snr_db": snr_db, "confidence": mode, "runs": runs}


def report(ours, theirs, *, codec=DEFAULT_CODEC, gap_s=0.0, **link):
    return {
        "sequence": "room",
        "settings": {"codec": codec, "gap_s": gap_s, "link": {"channel": "rayleigh", **link}},
        "cells": [cell("robust", ours), cell("off", theirs)],
    }


def recordings(reports):
    """As many recordings as there are reports."""
    return [{**report, "sequence": f"room {k}"} for k, report in enumerate(reports)]


def factor(final, live, num_runs=3):
    """A recording whose errors with confidence are so many times those without."""
    without = [(0.1 * 2.0**k, 0.3 * 2.0**k) for k in range(num_runs)]
    return report([(final * a, live * b) for a, b in without], without)


def test_a_recording_counts_once_however_many_runs_it_has():
    (link,) = compare_links(recordings([factor(0.5, 2.0, num_runs=9), *[factor(2.0, 0.5)] * 5]))
    assert (link.channel, link.snr_db, link.num_runs) == ("rayleigh", 2.0, 24)
    np.testing.assert_allclose(np.exp(link.log_ratios), [[0.5, 2.0] * 2, *[[2.0, 0.5] * 2] * 5])
    row = link_summary(recordings([factor(0.5, 2.0), *[factor(2.0, 0.5)] * 5])).splitlines()[-1]
    assert row.startswith("| rayleigh, 2 dB | 6 | 18 | 1.59 ("), "2 to the power of 4 / 6"


def test_two_files_of_a_recording_are_one():
    reports = [*recordings([factor(0.5, 0.5)] * 5), {**factor(0.5, 0.5, num_runs=2), "sequence": "room 4"}]
    (link,) = compare_links(reports)
    assert (len(link.log_ratios), link.num_runs) == (5, 17)


def test_recordings_that_go_alike_leave_no_doubt():
    assert "| 0.80 (0.80 .. 0.80) | 0.90 (0.90 .. 0.90) | 0.80 (" in link_summary(
        recordings([factor(0.8, 0.9)] * 5)
    )


def test_a_link_needs_enough_recordings_and_these_enough_runs():
    assert compare_links(recordings([factor(0.5, 0.5)] * 4)) == []
    assert compare_links(recordings([factor(0.5, 0.5, num_runs=2)] * 9)) == []
    assert link_summary(recordings([factor(0.5, 0.5)] * 4)) == ""


@pytest.mark.parametrize(
    "other", [{"codec": "jpeg-ldpc"}, {"gap_s": 1.0}, {"doppler_hz": 5.0}, {"channel": "trace"}]
)
def test_other_codecs_gaps_doppler_and_traces_are_other_links(other):
    errors = [(0.1, 0.1)] * 3
    assert compare_links(recordings([report(errors, errors, **other)] * 5)) == []
    assert len(compare_links(recordings([report(errors, errors)] * 5))) == 1


def test_runs_without_a_path_are_left_out_and_no_error_is_too_small():
    ours, theirs = [(None, None), (0.0, 0.1), (0.1, 0.1), (0.1, 0.1)], [(0.1, 0.1)] * 4
    (link,) = compare_links(recordings([report(ours, theirs)] * 5))
    assert link.num_runs == 15
    assert np.isfinite(link.log_ratios).all()
