"""Tables of paths: of the README the default codec's, and in all of them what a median would hide."""

import json
import re

import pytest

from semcast.common.codec import DEFAULT_CODEC
from semcast.evaluation.path_tables import median_and_worst, readme_table, trajectory_table


def cell_of(errors_percent, posed=(1.0,), **figures):
    known = sorted(e for e in errors_percent if e is not None)
    runs = [
        {"ate_percent": e, "completeness": p, "parts": [{"submap": 0, "num_posed": 40}]}
        for e, p in zip(errors_percent, posed, strict=True)
    ]
    return {
        "snr_db": 6.0,
        "confidence": "robust",
        "completeness": sorted(posed)[len(posed) // 2],
        "ate_percent": known[len(errors_percent) // 2],
        "ate_rmse_m": 0.5,
        "rpe_trans_percent": 1.0,
        "rpe_rot_deg": 0.1,
        "psnr_db": 30.0,
        "seeds": list(range(len(runs))),
        "runs": runs,
        **figures,
    }


def report(codec, ate_percent, **settings):
    cell = cell_of([ate_percent])
    return {
        "sequence": "drive",
        "settings": {"codec": codec, "link": {"channel": "rayleigh"}, **settings},
        "cells": [cell],
    }


@pytest.mark.parametrize(
    "other",
    [
        report("3dcsc-vr", 7.77),
        report(DEFAULT_CODEC, 7.77, gap_s=1.0),
        report(DEFAULT_CODEC, 7.77, link={"channel": "rayleigh", "doppler_hz": 5.0}),
        report(DEFAULT_CODEC, 7.77, link={"channel": "trace"}),
    ],
)
def test_other_codecs_and_links_are_not_in_it(tmp_path, other):
    (tmp_path / "trajectory_a.json").write_text(json.dumps(report(DEFAULT_CODEC, 0.25)))
    (tmp_path / "trajectory_b.json").write_text(json.dumps(other))
    rows = readme_table(tmp_path)
    assert "0.25" in rows
    assert "7.77" not in rows


def test_a_recording_that_was_sent_over_the_poor_link_alone_is_not_in_it(tmp_path):
    poor = report(DEFAULT_CODEC, 7.77)
    (tmp_path / "trajectory_a.json").write_text(json.dumps(poor))
    assert "7.77" in readme_table(tmp_path)
    poor["cells"][0]["snr_db"] = 2.0
    (tmp_path / "trajectory_a.json").write_text(json.dumps(poor))
    assert "7.77" not in readme_table(tmp_path)


def test_a_part_that_an_interrupted_run_left_is_not_in_it(tmp_path):
    (tmp_path / "trajectory_a.json").write_text(json.dumps(report(DEFAULT_CODEC, 0.25)))
    (tmp_path / "trajectory_b.partial.json").write_text(json.dumps(report(DEFAULT_CODEC, 7.77)))
    assert "7.77" not in readme_table(tmp_path)


@pytest.mark.parametrize(
    ("errors_percent", "text"),
    [
        ([0.2, 0.2, 0.29], "0.20"),
        ([0.2, 0.1, 0.4], "0.20 (0.40)"),
        ([0.2, None, 0.1], "0.20 (1 of 3 without a path)"),
    ],
)
def test_the_worst_run_stands_beside_the_median_where_it_is_clearly_worse(errors_percent, text):
    assert median_and_worst(cell_of(errors_percent, (1.0,) * 3)) == text


def test_of_the_shares_of_frames_with_a_pose_the_least_one_is_told(tmp_path):
    shown = report(DEFAULT_CODEC, 0.25)
    shown["cells"] = [cell_of([0.25, 0.25, 0.9], (1.0, 0.9996, 1.0))]
    (tmp_path / "trajectory_a.json").write_text(json.dumps(shown))
    assert "| drive | - | 0.25 (0.90), 99.9% posed | - |" in readme_table(tmp_path)
    shown["cells"] = [cell_of([0.25, 0.25, 0.3], (1.0, 0.5, 1.0))]
    (row,) = list(trajectory_table(shown))[2:]
    assert re.search(r"\| 0.250 \| 0.500 \|", row)


def test_maps_that_fell_into_parts_are_told_of(tmp_path):
    shown = report(DEFAULT_CODEC, 0.25)
    (one_part,) = list(trajectory_table(shown))[2:]
    shown["cells"] = [cell_of([0.25, 0.25, 0.3], (1.0,) * 3)]
    shown["cells"][0]["runs"][1]["parts"].append({"submap": 3, "num_posed": 20})
    (tmp_path / "trajectory_a.json").write_text(json.dumps(shown))
    assert "| drive | - | 0.25, 2 parts | - |" in readme_table(tmp_path)
    head, _, row = trajectory_table(shown)
    assert row.split("|")[head.split("|").index(" most parts ")] == " 2 "
    assert one_part.count("|") == row.count("|") - 1, "it has a column only where there are parts"


def test_errors_of_poses_as_published_stand_beside_those_of_one_link(tmp_path):
    shown = report(DEFAULT_CODEC, 0.25)
    shown["cells"][0]["ate_at_once_percent"] = shown["cells"][0]["runs"][0]["ate_at_once_percent"] = 0.5
    (tmp_path / "trajectory_a.json").write_text(json.dumps(shown))
    head, _, row = readme_table(tmp_path).splitlines()
    assert head.startswith("| recording | clean images | fading, 6 dB | the same, live |")
    assert row.startswith("| drive | - | 0.25 | 0.50 |")


def test_figures_of_published_poses_have_columns_where_a_file_has_them():
    shown = report(DEFAULT_CODEC, 0.25)
    without = list(trajectory_table(shown))
    assert "live" not in without[0]
    live = cell_of([0.2, 0.2, 0.2], (1.0,) * 3, ate_at_once_percent=0.3)
    for run, error, posed in zip(live["runs"], (0.3, 0.2, 0.9), (1.0, 0.75, 1.0), strict=True):
        run.update(ate_at_once_percent=error, completeness_at_once=posed)
    shown["cells"].append(live)
    head, _, old, new = trajectory_table(shown)
    assert head.split(" | ")[5:7] == ["live ATE %", "least completeness, live"]
    assert old.split(" | ")[5:7] == ["-", "-"]
    assert new.split(" | ")[3:7] == ["0.200", "1.000", "0.300 (0.900)", "0.750"]


def test_how_errors_compare_with_covariances_has_a_column_where_a_file_has_it():
    shown = report(DEFAULT_CODEC, 0.25)
    assert not any("sigma" in line for line in trajectory_table(shown))
    shown["cells"].append(shown["cells"][0] | {"stated_ratio_trans": 1.26, "stated_ratio_rot": 0.5})
    head, _, old, new = trajectory_table(shown)
    column = head.split("|").index(" live error / stated sigma: place, turn ")
    assert old.split("|")[column] == " -, - "
    assert new.split("|")[column] == " 1.3, 0.5 "
