"""A recording that is being written is locked: nothing replaces it, and it is not taken for a cut off one."""

import threading

import pytest

from semcast.common.errors import SourceError
from semcast.common.recorder import Recorder
from semcast.common.recording_reader import RecordingReader
from semcast.common.recording_writer import recording_metadata, recover_file

HEADER = recording_metadata('codec = "3dcsc"\n', "9.9")


def test_a_recording_that_goes_on_is_neither_replaced_nor_taken_for_a_cut_one(tmp_path, caplog):
    path = tmp_path / "run.mcap"
    with Recorder(path, HEADER) as recorder:
        recorder.add_metadata("semcast.stream", {"digest": "d"})
        with pytest.raises(SourceError, match="run.mcap can't be replaced: it is still being recorded"):
            recover_file(path, path)
        with pytest.raises(SourceError, match="something else is being recorded into it"):
            Recorder(path, HEADER)
        assert not list(RecordingReader(path).messages())
        assert "still being recorded" in caplog.text
        assert "cut off" not in caplog.text
        recover_file(path, tmp_path / "so far.mcap")
        recorder.put("semcast/a/pose", "pose", b"x")
    assert [m.data for m in RecordingReader(path).messages()] == [b"x"]
    assert recover_file(path, path).complete


def test_a_recording_that_ended_early_is_mended_while_its_process_runs(tmp_path, monkeypatch):
    path = tmp_path / "run.mcap"
    failed = threading.Event()
    with Recorder(path, HEADER, on_error=lambda _: failed.set()) as recorder:
        monkeypatch.setattr("time.time_ns", lambda: -1)  # a clock before 1970, which the format can't hold
        recorder.put("semcast/a/pose", "pose", b"x")
        assert failed.wait(10.0)
        recover_file(path, path)
    assert RecordingReader(path).info().complete
