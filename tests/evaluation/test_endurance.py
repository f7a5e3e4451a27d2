import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from semcast.channel.settings import ChannelSettings
from semcast.common.errors import ConfigError
from semcast.common.sequence import open_sequence
from semcast.common.trajectory import Trajectory, write_tum
from semcast.evaluation.endurance import EnduranceSettings, back_and_forth, evaluate_endurance


def test_frames_go_back_and_forth():
    assert list(back_and_forth(4, 13)) == [0, 1, 2, 3, 2, 1, 0, 1, 2, 3, 2, 1, 0]


def test_memory_counts_what_is_held():
    # In a process of its own: here, what other tests gave up may be handed back meanwhile.
    program = (
        "from semcast.evaluation.endurance import resident_mb\n"
        "before = resident_mb()\n"
        "held = bytearray(b'x') * 60_000_000\n"
        "print(resident_mb() - before, len(held))\n"
    )
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    grown_mb, held = answer.stdout.split()
    assert 50 < float(grown_mb) < 70
    assert held == "60000000"


def test_a_long_run_reports_cost_and_map(room, tmp_path, caplog):
    caplog.set_level("INFO", "semcast.evaluation.endurance")
    settings = EnduranceSettings(
        sequence=room, codec="none", max_frames=14, frames=45, every=15, json=tmp_path / "e.json"
    )
    report = evaluate_endurance(settings)
    assert json.loads(settings.json.read_text()) == report
    told = [record.getMessage().split(":")[0] for record in caplog.records]
    assert told == ["15 of 45 frames", "30 of 45 frames", "45 of 45 frames"], (
        "half an hour is not passed in silence"
    )
    assert [row["frames"] for row in report["results"]] == [15, 30, 45]
    assert all(row["posed_share"] >= 0.9 for row in report["results"])
    assert all(0.0 < row["frame_ms_p50"] <= row["frame_ms_p95"] for row in report["results"])
    assert all(0.0 <= row["ate_percent"] < 3.0 for row in report["results"])
    # In percent of one pass of 14 frames, however often it was ridden.
    one_pass_m = Trajectory(np.arange(14.0), open_sequence(room).groundtruth().T_world_cam[:14]).path_length
    for row in report["results"]:
        assert row["ate_percent"] == pytest.approx(100.0 * row["ate_rmse_m"] / one_pass_m)
    last = report["results"][-1]
    assert 40 < last["landmarks"] <= 20_000
    assert report["growth"]["memory_mb"] == pytest.approx(
        last["memory_mb"] / report["results"][1]["memory_mb"]
    )


def test_frames_without_a_true_pose_have_no_error(room, tmp_path):
    part = tmp_path / "part"
    shutil.copytree(room, part)
    truth = open_sequence(room).groundtruth()
    known = slice(6, 12)
    write_tum(part / "groundtruth.txt", Trajectory(truth.t_s[known], truth.T_world_cam[known]))
    report = evaluate_endurance(
        EnduranceSettings(sequence=part, codec="none", max_frames=14, frames=26, every=26)
    )
    (row,) = report["results"]
    assert row["posed_share"] >= 0.9
    # With the nearest true pose for those outside the true path it was 16 percent.
    assert row["ate_rmse_m"] < 0.03 * Trajectory(np.arange(6.0), truth.T_world_cam[known]).path_length


def test_settings_that_give_no_run_are_refused(room, phase_codec):
    with pytest.raises(ValueError, match="frames must be at least 1, got 0"):
        EnduranceSettings(sequence=room, frames=0)
    with pytest.raises(ValueError, match=r"every must be in \[1, 10\], got 11"):
        EnduranceSettings(sequence=room, frames=10, every=11)
    lost = ChannelSettings(frame_loss=1.0)
    with pytest.raises(ConfigError, match="no frame was received at 10 dB: there is nothing to run"):
        evaluate_endurance(
            EnduranceSettings(sequence=room, codec="phase", link=lost, frames=5, every=5), phase_codec
        )
    with pytest.raises(ConfigError, match="at least 3 frames"):
        evaluate_endurance(EnduranceSettings(sequence=room, codec="none", max_frames=2, frames=5, every=5))
