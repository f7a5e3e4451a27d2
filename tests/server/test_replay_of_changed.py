"""Replays of recordings that were cut, changed or damaged, and of several streams."""

import re
from dataclasses import replace

import pytest
from recorded_demo import FRAMES, without_depth

from semcast.cli import main
from semcast.common.errors import SourceError
from semcast.common.messages import CameraInfo, SymbolFrame
from semcast.common.recorded_streams import recorded_streams
from semcast.common.recording_reader import RecordingReader
from semcast.common.recording_writer import RecordingWriter, recording_metadata, recover_file
from semcast.common.wire import pack, unpack
from semcast.describe import describe_recording
from semcast.server.record import kind_of_key
from semcast.server.replay import replay


def test_a_cut_recording_is_recovered_and_still_replays(recording, tmp_path, capsys):
    cut = tmp_path / "cut.mcap"
    data = recording.read_bytes()
    cut.write_bytes(data[: len(data) * 3 // 4])
    info = recover_file(cut, tmp_path / "whole.mcap")
    assert not info.complete
    assert main(["recover", str(cut), "--out", str(tmp_path / "again.mcap")]) == 0
    assert capsys.readouterr().out.endswith(f"messages; {cut} was cut off\n")
    holed = tmp_path / "holed.mcap"
    holed.write_bytes(data[: len(data) // 2] + bytes(1000) + data[len(data) // 2 + 1000 :])
    assert main(["recover", str(holed), "--out", str(tmp_path / "again.mcap")]) == 0
    assert capsys.readouterr().out.endswith(f"messages; {holed} was damaged: 1 chunk left out\n")
    assert RecordingReader(tmp_path / "whole.mcap").info().complete
    assert replay(without_depth(tmp_path / "whole.mcap"))["frames"]


@pytest.fixture
def with_a_later_start(recording, tmp_path):
    """The recording, then the camera of another start of the agent, which never sent a frame."""
    path = tmp_path / "two.mcap"
    messages = list(RecordingReader(recording).messages())
    camera = unpack(next(m.data for m in messages if m.kind == "camera"), CameraInfo)
    later = replace(camera, agent_epoch=camera.agent_epoch + 10**9)
    with path.open("wb") as stream:
        writer = RecordingWriter(stream, recording_metadata("", "0"))
        for m in messages:
            writer.add(m.topic, m.kind, m.log_time_ns, m.sequence, m.data)
        writer.add("semcast/agent0/camera", "camera", messages[-1].log_time_ns, 99, pack(later))
        writer.finish()
    return path


def test_a_start_without_frames_does_not_hide_the_one_before(recording, with_a_later_start, tmp_path):
    with_frames, without = recorded_streams(RecordingReader(with_a_later_start))
    assert (with_frames.num_received, with_frames.num_transmitted) == (FRAMES, FRAMES)
    assert (without.num_received, without.num_transmitted) == (0, 0)
    assert without.camera.agent_epoch == with_frames.camera.agent_epoch + 10**9
    for name, path in (("alone", recording), ("both", with_a_later_start)):
        replay(without_depth(path, out=tmp_path / name, end_s=0.6))
    first, second = ((tmp_path / name / "trajectory.tum").read_bytes() for name in ("alone", "both"))
    assert first == second


def test_topics_that_another_tool_renamed_are_no_streams(recording, tmp_path):
    path = tmp_path / "renamed.mcap"
    with path.open("wb") as stream:
        writer = RecordingWriter(stream, recording_metadata("", "0"))
        for k, m in enumerate(RecordingReader(recording).messages(frozenset({"camera", "symbols"}))):
            writer.add("camera" if k % 2 else "/front camera/camera", m.kind, m.log_time_ns, 0, m.data)
        writer.finish()
    with pytest.raises(SourceError, match="says nothing about a camera"):
        replay(without_depth(path))
    assert kind_of_key("semcast/agent0") == ""


def test_a_frame_that_was_sent_again_counts_once(recording, tmp_path):
    path = tmp_path / "again.mcap"
    messages = list(RecordingReader(recording).messages())
    messages += [m for m in messages if m.kind == "symbols"][-2:]
    with path.open("wb") as stream:
        writer = RecordingWriter(stream, recording_metadata("", "0"))
        for m in messages:
            writer.add(m.topic, m.kind, m.log_time_ns, m.sequence, m.data)
        writer.finish()
    assert recorded_streams(RecordingReader(path)) == recorded_streams(RecordingReader(recording))


def with_changed_frame(recording, path, sequence, change):
    """Write a recording again with one received frame's message changed."""
    num_changed = 0
    with path.open("wb") as stream:
        writer = RecordingWriter(stream, recording_metadata("", "0"))
        for m in RecordingReader(recording).messages():
            is_hit = m.topic.endswith("rx/symbols") and m.sequence == sequence
            num_changed += is_hit
            writer.add(m.topic, m.kind, m.log_time_ns, m.sequence, change(m.data) if is_hit else m.data)
        writer.finish()
    assert num_changed == 1
    return path


def test_a_forged_frame_id_costs_its_frame_alone(recording, tmp_path, caplog):
    def forge(data):
        return pack(replace(unpack(data, SymbolFrame), frame_id=2**62, t_source_ns=2**62))

    path = with_changed_frame(recording, tmp_path / "forged.mcap", 0, forge)
    frames = [[], []]
    for seen, file in zip(frames, (recording, path), strict=True):
        replay(without_depth(file, end_s=0.6), None, seen.append)
    assert set(frames[0]) - set(frames[1]) == {frames[0][0]}
    assert f"frame {2**62} is left out" in caplog.text


def test_an_unreadable_message_costs_its_frame_alone(recording, whole, tmp_path, caplog):
    path = with_changed_frame(recording, tmp_path / "damaged.mcap", 2, lambda data: data[:-9])
    seen = []
    replay(without_depth(path), None, seen.append)
    assert len(set(whole[1]) - set(seen)) == 1
    assert "a message of semcast/agent0/rx/symbols" in caplog.text


def test_an_unreadable_message_of_another_agent_is_not_told(recording, tmp_path, caplog):
    path = tmp_path / "two.mcap"
    with path.open("wb") as stream:
        writer = RecordingWriter(stream, recording_metadata("", "0"))
        writer.add("semcast/right/rx/symbols", "symbols", 1, 0, b"junk")
        for m in RecordingReader(recording).messages():
            writer.add(m.topic, m.kind, m.log_time_ns, m.sequence, m.data)
        writer.finish()
    replay(without_depth(path, end_s=0.3))
    assert "is left out" not in caplog.text


def test_a_frame_of_another_codec_costs_itself_alone(recording, whole, tmp_path, caplog):
    def of_another(data):
        return pack(replace(unpack(data, SymbolFrame), digest="0123"))

    path = with_changed_frame(recording, tmp_path / "mixed.mcap", 2, of_another)
    mixed = replay(without_depth(path))
    assert mixed["drops"] == {**whole[0]["drops"], "codec": 1}
    assert mixed["frames"]["tracked"] == whole[0]["frames"]["tracked"] - 1
    assert "is left out" in caplog.text


def test_a_stream_is_chosen_by_its_number(with_a_later_start):
    with pytest.raises(SourceError, match=r"no received frames of stream 2 \(stream 1: \d+, stream 2: 0\)"):
        replay(without_depth(with_a_later_start, stream=2))
    with pytest.raises(SourceError, match=r"stream must be in \[1, 2\] for .*two.mcap, got 3"):
        replay(without_depth(with_a_later_start, stream=3))
    assert replay(without_depth(with_a_later_start, stream=1, end_s=0.6))["frames"]


def test_info_lists_the_streams_of_a_recording(with_a_later_start):
    sections = dict(describe_recording(with_a_later_start))
    (first, told), (second, told_of_second) = sections["streams"]
    assert (first, second) == ("--stream 1", "--stream 2")
    assert re.search(r"agent0, jpeg-ldpc, begun .* UTC: \d+ frames sent, \d+ received", told)
    assert told_of_second.endswith("0 frames sent, 0 received")
