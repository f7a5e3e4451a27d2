"""The recorder: it writes on its own thread, and a disk that is slow or full costs no more than it must."""

import errno
import io
import json
import os
import threading
import time
import types
from pathlib import Path

import pytest
from full_disk import room_for
from recorded_messages import HEADER, made_messages, scanned
from waiting import until

from semcast import SourceError
from semcast.common.recorder import ENTRY_BYTES, MAX_TOPICS, Recorder
from semcast.common.recording_reader import (
    RecordingReader,
    scan_info,
)


def test_the_recorder_writes_from_its_thread_and_counts(tmp_path):
    path = tmp_path / "sub" / "a.mcap"
    with Recorder(path, HEADER) as recorder:
        before_ns = time.time_ns()
        for topic, kind, _, _, data in made_messages(200):
            recorder.put(topic, kind, data)
        after_ns = time.time_ns()
        recorder.add_metadata("semcast.stream", {"digest": "d"})
    recorder.put("late", "pose", b"x")
    assert recorder.num_written == 200
    assert recorder.drops == {"closed": 1}
    reader = RecordingReader(path)
    found = list(reader.messages())
    assert [(m.topic, m.kind, m.sequence, m.data) for m in found] == [
        (topic, kind, sequence, data) for topic, kind, _, sequence, data in made_messages(200)
    ]
    times_ns = [m.log_time_ns for m in found]
    assert [before_ns, *times_ns, after_ns] == sorted([before_ns, *times_ns, after_ns])
    poses = list(reader.messages(frozenset({"pose"})))
    assert {m.topic for m in poses} == {"semcast/a/pose"}
    info = reader.info()
    assert info.complete
    assert info.metadata["semcast.stream"] == {"digest": "d"}
    assert json.dumps(info.metadata)


def test_a_recording_that_is_there_is_kept(tmp_path):
    path = tmp_path / "run.mcap"
    for k in range(3):
        with Recorder(path, HEADER) as recorder:
            recorder.put("semcast/a/pose", "pose", bytes([k]))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run-1.mcap", "run-2.mcap", "run.mcap"]
    names = ("run-1.mcap", "run-2.mcap", "run.mcap")
    contents = [[m.data for m in RecordingReader(tmp_path / name).messages()] for name in names]
    assert contents == [[b"\x00"], [b"\x01"], [b"\x02"]]


def test_an_empty_file_is_written_over(tmp_path):
    path = tmp_path / "run.mcap"
    path.touch()
    with Recorder(path, HEADER) as recorder:
        recorder.put("semcast/a/pose", "pose", b"x")
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]


def test_a_recorder_that_heard_nothing_leaves_all_as_it_was(tmp_path):
    path = tmp_path / "run.mcap"
    with Recorder(path, HEADER):
        pass
    assert not list(tmp_path.iterdir())
    with Recorder(path, HEADER) as recorder:
        recorder.put("semcast/a/pose", "pose", b"x")
    for _ in range(2):
        with Recorder(path, HEADER):
            pass
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]
    assert [m.data for m in RecordingReader(path).messages()] == [b"x"]


def test_folders_made_for_nothing_go_again(tmp_path):
    (tmp_path / "mine").mkdir()
    with Recorder(tmp_path / "mine" / "new" / "newer" / "a.mcap", HEADER):
        assert (tmp_path / "mine" / "new" / "newer").is_dir()
    assert list(tmp_path.iterdir()) == [tmp_path / "mine"]
    assert list((tmp_path / "mine").iterdir()) == []
    with Recorder(tmp_path / "mine" / "new" / "newer" / "a.mcap", HEADER):
        (tmp_path / "mine" / "new" / "notes.txt").write_text("somebody else's")
    assert (tmp_path / "mine" / "new" / "notes.txt").exists()


def test_a_link_to_a_device_stays_where_nothing_came(tmp_path):
    link = tmp_path / "run.mcap"
    link.symlink_to(os.devnull)
    with Recorder(link, HEADER):
        pass
    assert link.is_symlink()


def test_a_message_that_the_format_can_not_hold_ends_the_recording_with_a_word(tmp_path, caplog, monkeypatch):
    with Recorder(tmp_path / "a.mcap", HEADER) as recorder:
        with monkeypatch.context() as patched:
            patched.setattr("time.time_ns", lambda: -1)  # a clock before 1970
            recorder.put("t", "pose", b"x")
        recorder.put("t", "pose", b"x")
    assert recorder.error is not None
    assert recorder.drops["disk"] == 2
    assert "recording into" in caplog.text


class SlowStream(io.BytesIO):
    """Waits at the first chunk until it is let go."""

    def __init__(self, gate):
        super().__init__()
        self._gate = gate

    def write(self, data):
        if len(data) > 600:
            self._gate.wait(10)
        return super().write(data)


@pytest.fixture
def recorder_onto(tmp_path, monkeypatch):
    """Make a recorder whose file is a given stream."""

    def make(stream, **options):
        with monkeypatch.context() as patched:
            patched.setattr(Path, "open", lambda *_: stream)
            return Recorder(tmp_path / "a", HEADER, **options)

    return make


def test_a_slow_disk_drops_newest_messages_counts_them_and_never_blocks(recorder_onto):
    gate = threading.Event()
    stream = SlowStream(gate)
    kept = io.BytesIO()
    stream.close = lambda: kept.write(stream.getvalue())
    recorder = recorder_onto(stream, queue_bytes=50_000)
    for _ in range(3000):
        recorder.put("t", "pose", bytes(1000))
    assert recorder.drops["queue"] > 500
    gate.set()
    recorder.close()
    info = scan_info(io.BytesIO(kept.getvalue()), "kept")
    assert info.counts["t"] == recorder.num_written == 3000 - recorder.drops["queue"]
    # Gaps inside are seen; those at the very end leave no later message to show them.
    assert 0 <= info.missed.get("t", 0) <= recorder.drops["queue"]


def test_a_flood_of_empty_messages_and_notes_does_not_wait_without_end(recorder_onto, caplog):
    gate = threading.Event()
    recorder = recorder_onto(SlowStream(gate), queue_bytes=1_000_000)
    recorder.add_metadata("first", {"long": 700 * "x"})  # the disk waits at it
    for k in range(3000):
        recorder.put("t", "pose", b"")
        recorder.add_metadata(str(k), {})
    assert recorder.drops["queue"] >= 6000 - 2 * 1_000_000 // ENTRY_BYTES
    assert caplog.text.count("messages are left out of") == 1
    gate.set()
    recorder.close()
    assert f"{recorder.drops['queue']} messages were left out of" in caplog.text


def test_more_keys_than_a_recording_has_numbers_for_do_not_end_it(tmp_path, caplog):
    path = tmp_path / "flood.mcap"
    with Recorder(path, HEADER) as recorder:
        for k in range(66_000):
            recorder.put(f"semcast/a/{k}", "x", b"")
        recorder.put("semcast/a/0", "x", b"the stream")
    assert recorder.error is None
    assert recorder.drops == {"topics": 66_000 - MAX_TOPICS}
    assert recorder.num_written == MAX_TOPICS + 1
    assert caplog.text.count(f"they come under more than {MAX_TOPICS} keys") == 1


class FullDisk(io.BytesIO):
    """Has room for so many bytes."""

    def __init__(self, room):
        super().__init__()
        self._room = room

    def write(self, data):
        if self.tell() + len(data) > self._room:
            super().write(bytes(data)[: max(0, self._room - self.tell())])
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(data)


def test_a_full_disk_is_reported_once_and_what_was_written_stays_readable(recorder_onto, caplog):
    stream = FullDisk(3_000_000)
    kept = io.BytesIO()
    stream.close = lambda: kept.write(stream.getvalue())
    recorder = recorder_onto(stream)
    for k in range(600):
        recorder.put("t", "pose", k.to_bytes(4, "big") + bytes(9996))
    recorder.close()
    for _ in range(5):
        recorder.put("t", "pose", b"later")
    reports = [r for r in caplog.records if "No space left" in r.getMessage()]
    assert len(reports) == 1
    assert "the stream goes on" in reports[0].getMessage()
    assert recorder.error is not None
    # Of the chunk that was cut, a reader may find more than the recorder counts on.
    found = scanned(kept.getvalue())[0]
    assert len(found) > 200
    assert [int.from_bytes(m.data[:4], "big") for m in found] == list(range(len(found)))
    assert 200 <= recorder.num_written <= len(found)
    assert recorder.bytes_written == recorder.num_written * 10_000
    assert recorder.num_written + recorder.drops["disk"] == 600
    assert f"{recorder.num_written} messages were recorded" in caplog.text


def test_a_recording_leaves_the_end_of_a_disk_to_the_results_and_is_whole(tmp_path, monkeypatch, caplog):
    free = [101_000_000]
    monkeypatch.setattr("shutil.disk_usage", lambda path: types.SimpleNamespace(free=free[0]))
    path, told = tmp_path / "run.mcap", []
    with Recorder(path, HEADER, results=tmp_path, on_error=told.append) as recorder:
        recorder.put("t", "pose", b"first")
        until(lambda: recorder.num_written == 1)
        free[0] = 99_000_000
        recorder.put("t", "pose", b"second")
        until(lambda: recorder.error is not None)
    why = "99 MB of the disk are free, of which 100 are kept for results"
    assert told == [f"recording into {path} ended: {why}"]
    assert recorder.drops == {"disk": 1}
    info = RecordingReader(path).info()
    assert info.complete
    assert info.counts["t"] == 1


def test_without_room_for_more_than_the_results_nothing_is_begun(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda path: types.SimpleNamespace(free=99_000_000))
    path = tmp_path / "run.mcap"
    path.write_bytes(b"a recording of hours")
    with pytest.raises(SourceError, match="99 MB of the disk are free, of which 100 are kept for results$"):
        Recorder(path, HEADER, results=tmp_path)
    assert path.read_bytes() == b"a recording of hours"
    with pytest.raises(SourceError, match="99 MB of the disk are free"):
        Recorder(tmp_path / "new" / "newer" / "run.mcap", HEADER, results=tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"], "folders made for nothing go again"
    with Recorder(path, HEADER) as recorder:  # nothing else is to be written
        recorder.put("t", "pose", b"first")
    assert RecordingReader(path).info().counts["t"] == 1


def test_a_path_that_can_not_be_written_is_a_clear_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SourceError, match="can't be written"):
        Recorder(tmp_path / "file" / "a.mcap", HEADER)


def test_a_disk_that_is_full_at_the_start_leaves_the_former_recording_where_it_was(tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(b"a recording of hours")
    with room_for(1), pytest.raises(SourceError, match=r"run\.mcap can't be written"):
        Recorder(path, HEADER)
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]
    assert path.read_bytes() == b"a recording of hours"


def test_whatever_ends_a_recording_is_told(tmp_path, monkeypatch, caplog):
    def broken(self, *item):
        raise MemoryError

    monkeypatch.setattr("semcast.common.recorder.RecordingWriter.add", broken)
    told = []
    with Recorder(tmp_path / "a.mcap", HEADER, on_error=told.append) as recorder:
        recorder.put("a/tx/symbols", "symbols", b"data")
    assert recorder.error == "MemoryError"
    assert told == [f"recording into {tmp_path / 'a.mcap'} ended: MemoryError"]
    assert recorder.drops["disk"] == 1
    assert "the stream goes on, 0 messages were recorded" in caplog.text
