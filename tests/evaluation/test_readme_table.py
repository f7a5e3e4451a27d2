"""The README's table holds the default codec's paths, whatever else was measured."""

import json

import pytest

from semcast.common.codec import DEFAULT_CODEC
from semcast.evaluation.results_page import readme_table


def report(codec, ate_percent, **settings):
    cell = {"snr_db": 6.0, "confidence": "robust", "completeness": 1.0, "ate_percent": ate_percent}
    return {
        "sequence": "drive",
        "settings": {"codec": codec, "link": {"channel": "rayleigh"}, **settings},
        "cells": [cell],
    }


@pytest.mark.parametrize("other", [report("3dcsc-vr", 7.77), report(DEFAULT_CODEC, 7.77, gap_s=1.0)])
def test_other_codecs_and_gaps_are_not_in_it(tmp_path, other):
    (tmp_path / "trajectory_a.json").write_text(json.dumps(report(DEFAULT_CODEC, 0.25)))
    (tmp_path / "trajectory_b.json").write_text(json.dumps(other))
    rows = readme_table(tmp_path)
    assert "0.25" in rows
    assert "7.77" not in rows
