"""Two modes over the same links, compared run by run."""

import numpy as np
import pytest

from semcast.evaluation.trajectory_summary import Pairing, pairings_of, ratio_interval, trajectory_summary


def cell(mode, ate_percent, snr_db=6.0):
    runs = [
        {"seed": k, "ate_percent": v, "completeness": 0.0 if v is None else 1.0}
        for k, v in enumerate(ate_percent)
    ]
    return {"snr_db": snr_db, "confidence": mode, "runs": runs}


def report(*cells):
    return {
        "sequence": "room",
        "settings": {"codec": "c", "link": {"channel": "erasure"}},
        "cells": list(cells),
    }


def test_runs_are_paired_by_seed_and_failed_ones_left_out():
    ours, theirs = [1.0, 2.0, None, 1.0, 1.0, 4.0], [2.0, 2.0, 3.0, 4.0, 1.0, 2.0]
    (found,) = pairings_of([report(cell("robust", ours), cell("off", theirs))])
    assert found.title == "room, c, erasure, 6 dB"
    assert found.num_failed == 1
    assert (found.ours_posed, found.theirs_posed) == (pytest.approx(5 / 6), 1.0)
    np.testing.assert_array_equal(found.ours_percent, [1, 2, 1, 1, 4])
    np.testing.assert_array_equal(found.theirs_percent, [2, 2, 4, 1, 2])


def test_cells_with_few_seeds_one_mode_or_no_link_are_left_out():
    few = report(cell("robust", [1.0] * 4), cell("off", [1.0] * 4))
    alone = report(cell("robust", [1.0] * 9))
    clean = report(cell("robust", [1.0] * 9, None), cell("off", [1.0] * 9, None))
    assert pairings_of([few, alone, clean]) == []
    assert trajectory_summary([few]) == ""


def test_the_ratio_is_that_of_a_typical_run_and_its_interval_holds_it():
    a = Pairing("a", np.array([1.0, 2.0, 1.0, 2.0, 1.0]), np.array([2.0, 4.0, 2.0, 4.0, 2.0]))
    b = Pairing("b", np.array([2.0] * 5), np.array([1.0] * 5))
    assert ratio_interval([a]) == pytest.approx((0.5, 0.5, 0.5))
    assert ratio_interval([a, b])[0] == pytest.approx(1.0), "half and twice"
    noisy = Pairing("c", np.exp(np.linspace(-1.0, 0.4, 12)), np.ones(12))
    ratio, low, high = ratio_interval([noisy])
    assert ratio == pytest.approx(np.exp(-0.3))
    assert 0.5 < low < ratio < high < 1.05


def test_the_table():
    text = trajectory_summary([report(cell("robust", [1.0, 1.0, 1.0, 1.0, 5.0]), cell("off", [2.0] * 5))])
    row = next(line for line in text.splitlines() if line.startswith("| room"))
    assert [p.strip() for p in row.strip("|").split("|")][:9] == [
        "room, c, erasure, 6 dB",
        "5",
        "0",
        "1.00",
        "5.00",
        "100.0%",
        "2.00",
        "2.00",
        "100.0%",
    ]
    assert "Over all 1 rows: 0.69 (" in text
