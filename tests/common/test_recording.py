import io

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from recorded_messages import HEADER, made_messages, scanned

from semcast import SourceError
from semcast.common.recording_reader import (
    RecordedMetadata,
    RecordingReader,
    scan_info,
)
from semcast.common.recording_writer import (
    RecordingWriter,
    recover_file,
    recover_stream,
)


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


def test_a_recording_that_is_not_there_is_named_alone(tmp_path):
    missing = tmp_path / "missing.mcap"
    with pytest.raises(SourceError, match=r"missing\.mcap can't be read: No such file"):
        recover_file(missing, missing)
    assert list(tmp_path.iterdir()) == []
