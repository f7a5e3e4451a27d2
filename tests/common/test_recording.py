import errno
import io
import json
import os
import threading
import time
import types
from pathlib import Path

import numpy as np
import pytest
from full_disk import room_for
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from waiting import until

from semcast import SourceError
from semcast.common.recorder import ENTRY_BYTES, MAX_TOPICS, Recorder
from semcast.common.recording_reader import (
    RecordedMessage,
    RecordedMetadata,
    RecordingReader,
    RecordingScan,
    scan_info,
)
from semcast.common.recording_writer import (
    RecordingWriter,
    recording_metadata,
    recover_file,
    recover_stream,
)

HEADER = recording_metadata('codec = "3dcsc"\n', "9.9")
TOPICS = (("semcast/a/rx/symbols", "symbols"), ("semcast/a/pose", "pose"), ("semcast/a/link", "link"))


def made_messages(count=120, seed=0):
    """Messages of unlike sizes, every payload findable in the file by its first sixteen random bytes."""
    rng = np.random.default_rng(seed)
    sequence = dict.fromkeys(TOPICS, 0)
    messages = []
    for k in range(count):
        topic = TOPICS[k % 3]
        size = int(rng.integers(16, 900))
        messages.append((*topic, 1000 + 10 * k, sequence[topic], rng.bytes(size)))
        sequence[topic] += 1
    return messages


def written(messages, chunk_bytes=4000, finish=True):
    stream = io.BytesIO()
    writer = RecordingWriter(stream, HEADER, chunk_bytes=chunk_bytes)
    for message in messages:
        writer.add(*message)
    if finish:
        writer.finish()
    else:
        writer.flush()
    return stream.getvalue()


def scanned(data, strict=True):
    scan = RecordingScan(io.BytesIO(data), "bytes", strict=strict)
    records = list(scan.records())
    return [r for r in records if isinstance(r, RecordedMessage)], records, scan


def as_tuple(message):
    return (message.topic, message.kind, message.log_time_ns, message.sequence, message.data)


def test_what_was_written_is_read_back_in_order():
    messages = made_messages()
    found, records, scan = scanned(written(messages))
    assert [as_tuple(m) for m in found] == messages
    assert records[0] == RecordedMetadata("semcast.recording", HEADER)
    assert scan.complete


def test_the_mcap_library_reads_the_file_too():
    messages = made_messages()
    reader = make_reader(io.BytesIO(written(messages)), validate_crcs=True)
    found = [
        (channel.topic, schema.name, message.log_time, message.sequence, message.data)
        for schema, channel, message in reader.iter_messages()
    ]
    assert found == [(t, f"semcast.{k}", ns, s, d) for t, k, ns, s, d in messages]
    assert next(iter(reader.iter_metadata())).metadata == HEADER
    summary = reader.get_summary()
    assert all(chunk.compression == "" for chunk in summary.chunk_indexes)
    assert len(summary.chunk_indexes) > 5
    channels = summary.channels.values()
    assert {c.message_encoding for c in channels} == {"msgpack"}


def test_a_file_cut_at_any_place_gives_every_whole_message():
    messages = made_messages()
    whole = written(messages)
    # Where each message ends, found without the reader: payloads are random and so occur once.
    ends = np.array([whole.index(m[4]) + len(m[4]) for m in messages])
    assert np.all(np.diff(ends) > 0)
    rng = np.random.default_rng(1)
    places = np.unique(np.concatenate([rng.integers(0, len(whole), 1000), ends, ends - 1, [len(whole)]]))
    recovered = 0
    for place in places:
        data = whole[:place]
        expected = messages[: int((ends <= place).sum())]
        if place < 8:
            with pytest.raises(SourceError, match="not a recording"):
                scanned(data)
            continue
        found, records, scan = scanned(data)
        assert [as_tuple(m) for m in found] == expected, place
        if not any(isinstance(r, RecordedMetadata) for r in records):
            assert not expected
            with pytest.raises(SourceError, match="nothing to recover"):
                recover_stream(io.BytesIO(data), io.BytesIO(), "bytes")
        elif place % 5 == 0:
            target = io.BytesIO()
            info = recover_stream(io.BytesIO(data), target, "bytes")
            assert info.complete == scan.complete
            again, _, after = scanned(target.getvalue())
            assert [as_tuple(m) for m in again] == expected
            assert after.complete
            recovered += 1
    assert recovered > 100


@pytest.mark.parametrize("hit", [0, 40])  # the first chunk is the one that defines the topics
def test_damage_is_named_and_recover_keeps_the_other_chunks(hit):
    messages = made_messages()
    whole = bytearray(written(messages))
    whole[whole.index(messages[hit][4]) + 5] ^= 0x01
    with pytest.raises(SourceError, match="semcast recover"):
        scanned(bytes(whole))
    target = io.BytesIO()
    info = recover_stream(io.BytesIO(bytes(whole)), target, "bytes")
    assert info.num_damaged_chunks == 1
    found = [as_tuple(m) for m in scanned(target.getvalue())[0]]
    lost = [m for m in messages if m not in found]
    assert messages[hit] in lost
    assert len(lost) < 15
    assert info.missed == {}


def test_what_damage_took_is_told_apart_from_what_the_recorder_dropped():
    messages = [("t", "pose", k, k if k < 30 else k + 7, bytes([k]) * 500) for k in range(60)]
    whole = bytearray(written(messages))
    whole[whole.index(messages[10][4])] ^= 0x01
    target = io.BytesIO()
    recover_stream(io.BytesIO(bytes(whole)), target, "bytes")
    for stream in (io.BytesIO(bytes(whole)), target):
        stream.seek(0)
        info = scan_info(stream, "bytes")
        assert 50 < info.counts["t"] < 60
        assert info.missed == {"t": 7}
        assert info.metadata["semcast.damage"] == {"num_left_out": "1"}


@pytest.mark.parametrize("place", range(40))
def test_a_damaged_head_of_a_chunk_costs_that_chunk_at_most(place):
    messages = made_messages()
    whole = bytearray(written(messages))
    index = make_reader(io.BytesIO(bytes(whole))).get_summary().chunk_indexes[2]
    whole[index.chunk_start_offset + 9 + place] ^= 0x04  # behind opcode and length of the record
    target = io.BytesIO()
    info = recover_stream(io.BytesIO(bytes(whole)), target, "bytes")
    assert info.complete
    found = [as_tuple(m) for m in scanned(target.getvalue())[0]]
    is_checksum = 24 <= place < 28
    assert info.num_damaged_chunks == is_checksum
    assert len(messages) - 15 < len(found) < len(messages) if is_checksum else found == messages


def test_a_compressed_recording_is_refused_with_the_reason():
    stream = io.BytesIO()
    writer = Writer(stream, compression=CompressionType.ZSTD)
    writer.start()
    schema = writer.register_schema("semcast.pose", "", b"")
    channel = writer.register_channel("t", "msgpack", schema)
    writer.add_message(channel, 1, b"x", 1)
    writer.finish()
    for strict in (True, False):
        with pytest.raises(SourceError, match=r"bytes is compressed \(zstd\)"):
            scanned(stream.getvalue(), strict)


def test_random_damage_never_raises_anything_but_a_source_error():
    whole = written(made_messages(40))
    rng = np.random.default_rng(2)
    for _ in range(400):
        data = bytearray(whole)
        for place in rng.integers(0, len(whole), rng.integers(1, 6)):
            data[place] = rng.integers(256)
        for strict in (True, False):
            try:
                scanned(bytes(data), strict)
            except SourceError:
                continue
        try:
            recover_stream(io.BytesIO(bytes(data)), io.BytesIO(), "bytes")
        except SourceError:
            continue


def test_zeros_at_the_end_as_after_a_power_cut_end_the_reading():
    messages = made_messages(30)
    data = written(messages, finish=False)
    found, _, scan = scanned(data + bytes(5000))
    assert [as_tuple(m) for m in found] == messages
    assert not scan.complete


def test_flushed_messages_are_in_the_file_before_it_is_closed():
    stream = io.BytesIO()
    writer = RecordingWriter(stream, HEADER)
    writer.add("t", "pose", 1, 0, b"payload")
    assert b"payload" not in stream.getvalue()
    writer.flush()
    assert [m.data for m in scanned(stream.getvalue())[0]] == [b"payload"]


def test_a_cut_is_told_once_however_often_the_file_is_read(tmp_path, caplog):
    path = tmp_path / "run.mcap"
    path.write_bytes(written(made_messages(), finish=False))
    reader = RecordingReader(path)
    assert list(reader.messages()) == list(reader.messages())
    assert caplog.text.count("was cut off") == 1


def test_info_counts_topics_times_and_messages_the_recorder_missed():
    messages = [("t", "pose", 5, 0, b"abc"), ("t", "pose", 6, 1, b"de"), ("t", "pose", 9, 4, b"f")]
    info = scan_info(io.BytesIO(written(messages)), "bytes")
    assert info.counts == {"t": 3}
    assert info.num_bytes == {"t": 6}
    assert info.kinds == {"t": "pose"}
    assert info.missed == {"t": 2}
    assert (info.start_ns, info.end_ns, info.complete) == (5, 9, True)


def test_other_files_are_refused_with_the_reason(tmp_path):
    path = tmp_path / "a.mcap"
    with pytest.raises(SourceError, match="can't be read"):
        RecordingReader(path)
    path.write_bytes(b"\x89PNG\r\n and so on")
    with pytest.raises(SourceError, match="does not start as an MCAP file"):
        RecordingReader(path)
    path.write_bytes(written([])[:60])
    with pytest.raises(SourceError, match="cut off before its first record"):
        RecordingReader(path)
    stream = io.BytesIO()
    RecordingWriter(stream, {**HEADER, "format": "7", "semcast": "3.0"}).finish()
    path.write_bytes(stream.getvalue())
    with pytest.raises(SourceError, match=r"format 7 by semcast 3\.0, this semcast reads format 1"):
        RecordingReader(path)


def test_recover_replaces_the_file_only_when_the_new_one_is_whole(tmp_path):
    messages = made_messages(50)
    path = tmp_path / "a.mcap"
    path.write_bytes(written(messages)[:-3000])
    before, _, _ = scanned(path.read_bytes())
    info = recover_file(path, path)
    assert not info.complete
    assert [m.data for m in RecordingReader(path).messages()] == [m.data for m in before]
    assert RecordingReader(path).info().complete
    path.write_bytes(b"nothing")
    with pytest.raises(SourceError, match="not start"):
        recover_file(path, path)
    assert path.read_bytes() == b"nothing"
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


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


def test_a_recording_that_is_not_there_is_named_alone(tmp_path):
    missing = tmp_path / "missing.mcap"
    with pytest.raises(SourceError, match=r"missing\.mcap can't be read: No such file"):
        recover_file(missing, missing)
    assert list(tmp_path.iterdir()) == []


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
