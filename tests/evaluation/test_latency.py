import json

import pytest

from semcast.common.errors import ConfigError
from semcast.evaluation.latency import LatencySettings, evaluate_latency, stage_profile

pytestmark = pytest.mark.xdist_group("real-time")


def test_profile_by_hand():
    rows = [{"stage_ms": {"encode": 4.0}}, {"stage_ms": {"encode": 2.0, "bundle": 10.0}}]
    profile = stage_profile(rows)
    assert profile["stages"]["encode"] == {
        "p50": 3.0,
        "p95": pytest.approx(3.9),
        "max": 4.0,
        "ran_share": 1.0,
        "mean_per_frame_ms": 3.0,
        "time_share": pytest.approx(6 / 16),
    }
    assert profile["stages"]["bundle"]["ran_share"] == 0.5
    assert profile["stages"]["bundle"]["mean_per_frame_ms"] == 5.0
    assert profile["bottleneck"] == "bundle"
    with pytest.raises(ValueError, match="at least one"):
        stage_profile([])


def test_every_stage_of_the_path_is_timed(room, phase_codec, tmp_path):
    settings = LatencySettings(
        sequence=room, codec="phase", snr_db=(20.0,), max_frames=12, json=tmp_path / "l.json"
    )
    report = evaluate_latency(settings, phase_codec)
    assert json.loads(settings.json.read_text()) == report
    assert {"encode", "channel", "equalise", "decode", "view"} <= set(report["stages"])
    assert report["num_frames"] == 7
    assert report["bottleneck"] in report["stages"]
    assert sum(s["time_share"] for s in report["stages"].values()) == pytest.approx(1.0)
    assert report["image_wh"] == [224, 160]


def test_settings_that_leave_nothing_to_time_are_refused(room, phase_codec):
    with pytest.raises(ConfigError, match="warmup"):
        evaluate_latency(LatencySettings(sequence=room, max_frames=3, warmup=3), phase_codec)
    with pytest.raises(ValueError, match="one each"):
        LatencySettings(sequence=room, snr_db=(2.0, 4.0))
