import json

import pytest

from semcast.common.errors import SourceError
from semcast.common.recorder import Recorder
from semcast.common.recording_reader import RecordingReader
from semcast.common.recording_writer import recording_metadata
from semcast.evaluation.recording import RecordingSettings, by_frame, evaluate_recording


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / "run.mcap"
    with Recorder(path, recording_metadata("", "0")) as recorder:
        recorder.put("semcast/a/camera", "camera", b"c")
        for _ in range(4):
            recorder.put("semcast/a/tx/symbols", "symbols", bytes(2000))
            recorder.put("semcast/a/rx/symbols", "symbols", bytes(8000))
    return path


def test_messages_are_grouped_by_the_frame_they_follow(recording):
    groups = by_frame(RecordingReader(recording).messages())
    assert [[m.topic.split("/")[2] for m in group] for group in groups] == [["tx", "rx"]] * 4


def test_the_cost_is_measured_and_kept(recording, tmp_path):
    settings = RecordingSettings(
        file=recording, rate_hz=50.0, round_s=0.2, rounds=2, json=tmp_path / "c.json"
    )
    report = evaluate_recording(settings)
    assert json.loads(settings.json.read_text()) == report
    assert len(report["core_share_rounds"]) == 2
    assert -0.5 < report["core_share"] < 1.0
    assert report["bytes_per_s"] == pytest.approx(50 * 10_000)
    assert report["dropped"] == 0
    assert report["command"].startswith("semcast eval recording run.mcap --rate-hz 50.0")


def test_a_recording_without_frames_is_one_clear_error(tmp_path):
    with Recorder(tmp_path / "e.mcap", recording_metadata("", "0")) as recorder:
        recorder.put("semcast/a/camera", "camera", b"c")
    with pytest.raises(SourceError, match="holds no frames an agent sent"):
        evaluate_recording(RecordingSettings(file=tmp_path / "e.mcap"))
    with pytest.raises(ValueError, match="rounds must be at least 1, got 0"):
        RecordingSettings(file=tmp_path / "e.mcap", rounds=0)
    with pytest.raises(ValueError, match="round_s must be long enough for a frame at 0.5 Hz, got 0.2"):
        RecordingSettings(file=tmp_path / "e.mcap", rate_hz=0.5, round_s=0.2)
