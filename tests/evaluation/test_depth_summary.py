"""Depth with confidence and without, side by side."""

from semcast.evaluation.depth_summary import depth_summary


def row(snr_db, mode, coverage, codec="3dcsc"):
    figures = {"coverage": coverage, "outlier_share": coverage and coverage / 10, "median_error": 0.005}
    return {"codec": codec, "snr_db": snr_db, "confidence": mode, **figures}


def test_each_snr_with_both_modes_has_a_row():
    rows = [row(6.0, "on", 0.5), row(6.0, "off", 0.4), row(2.0, "on", 0.3), row(2.0, "off", 0.2)]
    rows += [row(None, "off", 0.9, codec="none"), row(6.0, "on", 0.7, codec="vit"), row(8.0, "on", 0.6)]
    _, _, *lines = depth_summary({"results": rows}).splitlines()
    assert lines == [
        "| 2 dB | 30.0% | 20.0% | 3.0% | 2.0% | 0.50% | 0.50% |",
        "| 6 dB | 50.0% | 40.0% | 5.0% | 4.0% | 0.50% | 0.50% |",
    ]


def test_an_snr_at_which_nothing_arrived_has_none():
    assert len(depth_summary({"results": [row(2.0, "on", 0.0), row(2.0, "off", 0.0)]}).splitlines()) == 2
