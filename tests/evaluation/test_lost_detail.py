"""Fit and grades of confidence where pictures are coded smaller."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from semcast.common.lost_detail import ERROR_FACTORS
from semcast.evaluation import lost_detail

RESULT = Path(__file__).resolve().parents[2] / "evaluation/results/lost_detail.json"


def test_the_fit_finds_the_factors_behind_noisy_labels():
    rng = np.random.default_rng(0)
    errors = rng.exponential(0.6, (2, 20_000))
    expected = 1.0 - np.tanh(1.2 * errors[0] + 0.35 * errors[1])
    label = (expected + rng.normal(0.0, 0.1, expected.shape)).clip(0.0, 1.0)
    assert lost_detail.fit_factors(errors, label) == pytest.approx((1.2, 0.35), abs=0.03)


def test_the_factors_in_use_are_those_of_the_fit():
    report = json.loads(RESULT.read_text(encoding="utf-8"))
    assert report["used"] == list(ERROR_FACTORS)
    assert report["fitted"] == pytest.approx(ERROR_FACTORS, abs=0.01)


def test_photos_are_sent_fitted_and_graded(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    for folder in ("train", "valid"):
        (tmp_path / folder).mkdir()
        for k in range(2):
            coarse = rng.integers(0, 256, (12, 16, 3), dtype=np.uint8)
            photo = cv2.resize(coarse, (192, 144), interpolation=cv2.INTER_CUBIC)
            cv2.imwrite(str(tmp_path / folder / f"{k}.png"), photo)
    monkeypatch.setattr(lost_detail, "_SNRS_DB", (10.0,))
    monkeypatch.setattr(lost_detail, "_CODECS", ("3dcsc-lite", "jpeg-amc"))
    out = tmp_path / "result.json"
    monkeypatch.setattr("sys.argv", ["lost_detail", str(tmp_path), "--photos", "2", "--json", str(out)])
    lost_detail.main()
    report = json.loads(out.read_text(encoding="utf-8"))
    assert all(np.isfinite(report["fitted"]))
    assert [row["rate"] for row in report["kept"]] == ["1/48", "1/32", "1/24"]
    assert [row["codec"] for row in report["valid"]] == ["3dcsc-lite"] * 3 + ["jpeg-amc"] * 3
    for row in report["kept"] + report["valid"]:
        assert 0.0 < row["ece_with_lost_detail"] < 1.0
        assert 0.0 < row["ece_of_all_as_decoded"] < 1.0
