import pytest

from semcast.common.codec import DEFAULT_CODEC
from semcast.evaluation.markdown import table, with_part
from semcast.evaluation.pair_summary import cells_of, pair_summary


def cell(snr_db, errors_deg, interval=(-1.0, 1.0), **values):
    results = {
        mode: {
            "rot_deg_mean": e / 2,
            "tdir_deg_mean": e,
            "auc10": 100 - e,
            "cpu_ms": {"p50": 7.0},
            "num_pairs": 20,
        }
        for mode, e in errors_deg.items()
    }
    low, high = interval
    paired = {"mode": "robust", "against": "poselib", "figure": "tdir_deg_mean"}
    return {
        "snr_db": snr_db,
        "features": "klt",
        "max_matches": 0,
        "gap": 1,
        "num_pairs_lost": 3,
        "results": results,
        "auroc": {"epipolar": {"confidence": 0.25}},
        "comparisons": [{**paired, "paired": {"low": low, "high": high}}],
        **values,
    }


def report(*cells):
    settings = {"codec": DEFAULT_CODEC, "link": {"channel": "awgn"}}
    return {"sequence": "room", "settings": settings, "cells": list(cells)}


ERRORS = {
    "plain_ransac": 20.0,
    "opencv_ransac": 12.0,
    "poselib": 8.0,
    "paper": 10.0,
    "off": 4.0,
    "robust": 4.0,
    "inverted": 6.0,
    "oracle": 2.0,
}


def rows_of(text, first):
    return [
        [part.strip() for part in line.strip("|").split("|")]
        for line in text.splitlines()
        if line.startswith(f"| {first}")
    ]


def test_figures_by_hand():
    worse = {**ERRORS, "robust": 16.0, "poselib": 8.0}
    text = pair_summary([report(cell(2.0, ERRORS, (-5, -3)), cell(12.0, worse, (2, 9)))])
    against, gain = rows_of(text, "room; klt")
    # ratio of the two cells: 4/8 and 16/8, geometric mean 1; one cell better, one worse
    assert against == [
        "room; klt",
        "2",
        "20.0",
        "12.0",
        "-",
        "8.0",
        "10.0",
        "4.0",
        "10.0",
        "2.0",
        "1.00",
        "1",
        "1",
    ]
    # only the cell at 2 dB counts: 6 less 10, 5 and 2 of rotation, 12 less 20, 10 and 4 of direction
    assert gain == ["room; klt", "1", "6.0", "-4.0", "+1.0", "+4.0", "12.0", "-8.0", "+2.0", "+8.0"]
    assert "`robust`: +4.0 of rotation and +8.0 of direction in the median of the cells." in text
    assert "`paper` has 0.50 times that of `plain_ransac`" in text
    assert "In the 1 hard cells (6 dB and below" in text
    assert "it has 0.50 times the error of `poselib`" in text
    assert "on the true inliers alone has 0.25 times it" in text
    assert rows_of(text, "inverted") == [["inverted", "-2.0", "-2.0"]]
    assert rows_of(text, "robust") == [["robust", "-6.0", "-12.0"]]
    assert rows_of(text, "confidence |")[-1] == ["confidence", "0.25"]


def test_a_cell_is_in_the_row_of_its_recording_of_its_link_of_its_number_of_matches_and_of_all():
    thinned = cell(2.0, {**ERRORS, "robust": 6.0}, max_matches=40)
    jpeg = {**report(thinned), "settings": {"codec": "jpeg-ldpc", "link": {"channel": "awgn"}}}
    text = pair_summary([report(cell(2.0, ERRORS)), jpeg])
    table_of_errors = text[text.index("**Mean trans") : text.index("Over all")]
    means = {row[0]: (row[1], row[8]) for row in rows_of(table_of_errors, "") if row[1].isdigit()}
    assert means == {
        "room; klt": ("2", "5.0"),
        "awgn": ("1", "4.0"),
        "awgn, jpeg-ldpc": ("1", "6.0"),
        "all matches": ("1", "4.0"),
        "40 matches": ("1", "6.0"),
        "all": ("2", "5.0"),
    }


def test_cells_without_a_link_are_left_out():
    assert cells_of([report(cell(None, ERRORS))]) == []
    assert pair_summary([]) == ""


def test_a_part_of_a_page_is_replaced_and_markers_are_needed():
    page = "a\n<!-- x -->\nold\n<!-- /x -->\nb\n"
    assert with_part(page, "x", "new") == "a\n<!-- x -->\nnew\n<!-- /x -->\nb\n"
    with pytest.raises(ValueError, match="<!-- y -->"):
        with_part(page, "y", "new")
    assert list(table(["a"], [["1"]])) == ["| a |", "|---|", "| 1 |"]


@pytest.mark.parametrize("num_pairs_lost", [11, 20])
def test_a_cell_in_which_most_pairs_were_lost_is_left_out_and_said(num_pairs_lost):
    silent = cell(6.0, dict.fromkeys(ERRORS, 90.0), num_pairs_lost=num_pairs_lost)
    with_it, without = (pair_summary([report(cell(2.0, ERRORS), *more)]) for more in ((silent,), ()))
    assert "Left out: 1 cell(s) in which most pairs were lost." in with_it
    assert with_it.replace(" Left out: 1 cell(s) in which most pairs were lost.", "") == without
