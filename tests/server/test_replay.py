"""A recording replays to the same poses every time; through another channel it does not."""

import itertools
import json
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from recorded_demo import FRAMES, SEQUENCE, without_depth

from semcast.channel.settings import ChannelSettings
from semcast.cli import main
from semcast.common.codecs import load_codec
from semcast.common.config import build_settings, read_toml
from semcast.common.errors import ConfigError, SemcastError, SourceError
from semcast.common.messages import CameraInfo
from semcast.common.recorded_streams import recorded_streams
from semcast.common.recorder import Recorder
from semcast.common.recording_reader import RecordingReader
from semcast.common.recording_writer import recording_metadata
from semcast.common.run_folder import read_run
from semcast.common.sequence import open_sequence
from semcast.common.wire import pack, unpack
from semcast.server.marker_settings import MarkerSettings
from semcast.server.record import StreamNotes, kind_of_key
from semcast.server.replay import ReplaySettings, replay
from semcast.server.session import Session
from semcast.server.view.settings import ViewSettings


def test_a_key_tells_the_kind_of_its_messages():
    assert kind_of_key("semcast/a/rx/symbols") == kind_of_key("semcast/a/tx/symbols") == "symbols"
    assert kind_of_key("semcast/a/status/agent") == "status"


def test_the_camera_of_an_agent_that_came_back_is_asked_for(tmp_path, recording):
    messages = list(RecordingReader(recording).messages(frozenset({"camera", "status", "symbols"})))
    camera = unpack(next(m for m in messages if m.kind == "camera").data, CameraInfo)
    asked = []

    def answer(agent_id, agent_epoch):
        asked.append((agent_id, agent_epoch))
        return camera if len(asked) > 1 else None

    with Recorder(tmp_path / "late.mcap", recording_metadata("", "test")) as recorder:
        notes = StreamNotes(recorder, answer)
        status = next(m for m in messages if m.topic.endswith("status/agent"))
        for message in (*(m for m in messages if m.kind == "symbols"), status, status, status):
            notes.put(message.topic, message.data)
    # Two agents of one name would answer each for the other.
    assert asked == 2 * [("agent0", camera.agent_epoch)], "again after silence, and not once it is known"
    (stream,) = recorded_streams(RecordingReader(tmp_path / "late.mcap"))
    assert stream.num_received == FRAMES


def test_no_more_starts_of_agents_are_noted_than_there_can_be(tmp_path, recording, caplog, monkeypatch):
    monkeypatch.setattr("semcast.server.record.MAX_STREAMS", 3)
    messages = list(RecordingReader(recording).messages(frozenset({"camera", "status"})))
    camera = unpack(next(m for m in messages if m.kind == "camera").data, CameraInfo)
    status = next(m for m in messages if m.topic.endswith("status/agent"))
    asked = []
    with Recorder(tmp_path / "many.mcap", recording_metadata("", "test")) as recorder:
        notes = StreamNotes(recorder, lambda *start: asked.append(start))
        for k in range(5):
            notes.put("semcast/agent0/camera", pack(replace(camera, agent_epoch=k)))
        notes.put(status.topic, status.data)
    info = RecordingReader(tmp_path / "many.mcap").info()
    assert sorted(name for name in info.metadata if "stream" in name) == [
        f"semcast.stream.{k}" for k in range(3)
    ]
    assert info.counts["semcast/agent0/camera"] == 5
    assert not asked
    assert caplog.text.count("3 starts of agents are noted") == 1


def test_everything_that_was_sent_is_in_the_recording(recording):
    counts = RecordingReader(recording).info().counts
    assert counts["semcast/agent0/tx/symbols"] == FRAMES
    assert counts["semcast/agent0/rx/symbols"] == FRAMES
    assert counts["semcast/agent0/camera"] >= 1
    assert counts["semcast/agent0/source"] == FRAMES


def test_weights_are_those_of_the_recorded_codec(recording, tiny_weights):
    with pytest.raises(ConfigError, match="codec 'jpeg-ldpc' has no weights, got .*tiny.safetensors"):
        replay(without_depth(recording, weights=tiny_weights))


def test_weights_that_do_not_fit_leave_a_former_run_where_it_is(recording, tiny_weights, tmp_path):
    (tmp_path / "summary.json").write_text("{}")
    for weights in (tiny_weights, tmp_path / "missing.safetensors"):
        with pytest.raises(SemcastError):
            replay(without_depth(recording, weights=weights, out=tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["summary.json"]


def test_the_recording_names_the_weights_that_decode_it(recording):
    notes = {k: v for k, v in RecordingReader(recording).info().metadata.items() if "stream" in k}
    (values,) = notes.values()
    assert values["codec"] == "jpeg-ldpc"
    assert values["weights_digest"] == load_codec("jpeg-ldpc").digest
    assert values["image_wh"] == "490x148"
    assert values["source"] == "kitti_06"


def test_two_replays_give_the_same_files_and_another_channel_does_not(recording, tmp_path):
    seen = []
    for name in ("a", "b"):
        summary = replay(
            ReplaySettings(file=recording, out=tmp_path / name, reference=SEQUENCE, end_s=0.85),
            None,
            seen.append,
        )
        assert summary["completeness"] > 0.4
        assert summary["stage_ms"]["equalise"]["p50"] > 0.0
    assert seen == 2 * list(range(9))
    first, second = ((tmp_path / name / "trajectory.tum").read_bytes() for name in ("a", "b"))
    assert first == second
    clouds = [(tmp_path / name / "dense.ply").read_bytes() for name in ("a", "b")]
    assert clouds[0] == clouds[1]
    assert len(clouds[0]) > 10_000
    link = ChannelSettings(snr_db=15.0, frame_loss=0.4)
    lossy = without_depth(recording, out=tmp_path / "c", link=link, end_s=0.85)
    assert replay(lossy)["stage_ms"]["equalise"]["p50"] > 0.0
    assert (tmp_path / "c" / "trajectory.tum").read_bytes() != first
    assert build_settings(ReplaySettings, read_toml(tmp_path / "c" / "settings.toml")) == replace(
        lossy, symbols="transmitted"
    )


def test_a_replay_looks_for_the_marker_it_is_told_of(recording, whole, caplog):
    assert whole[0]["metres"] is None
    summary = replay(without_depth(recording, marker=MarkerSettings(side_m=0.2, marker_id=3)))
    assert summary["metres"] == []
    assert "the metre is not known: marker 3 of apriltag_36h11 must be in 3 images or more" in caplog.text
    assert summary["frames"] == whole[0]["frames"]


def test_the_command_shows_what_is_known_and_names_its_files(recording, tmp_path, capsys):
    assert main(["replay", str(recording), "--out", str(tmp_path / "out"), "--end-s", "0.6"]) == 0
    shown = capsys.readouterr().out
    assert "frames with a pose" in shown
    assert "error" not in shown, "there is no truth"
    names = (
        "trajectory.tum, map.ply, dense.ply, reconstruction.npz, summary.json, settings.toml, frames.jsonl"
    )
    assert shown.endswith(f"in {tmp_path / 'out'}: {names}\n")


def test_names_with_brackets_are_shown_as_they_are(recording, tmp_path, capsys):
    # What rich would take for the end of a style that never began, and for a style.
    copied = tmp_path / "walk [" / "end].mcap"
    copied.parent.mkdir()
    copied.write_bytes(recording.read_bytes())
    out = tmp_path / "again [bold]"
    words = ["--out", str(out), "--end-s", "0.6", "--dense-cloud", "none"]
    assert main(["replay", str(copied), *words]) == 0
    assert f"in {out}: " in capsys.readouterr().out


def test_a_replay_that_is_stopped_before_its_first_frame_does_not_blame_the_recording(recording, tmp_path):
    stop = threading.Event()
    stop.set()
    assert replay(without_depth(recording, out=tmp_path), stop)["frames"]["tracked"] == 0


def test_a_replay_without_a_pose_says_so_and_fails(recording, tmp_path, capsys):
    assert main(["replay", str(recording), "--end-s", "0.05"]) == 1
    assert "semcast replay: no frame has a pose" in capsys.readouterr().err


def test_a_replay_that_is_broken_off_in_its_last_adjustment_has_left_results(
    recording, tmp_path, monkeypatch
):
    def break_off(session):
        raise KeyboardInterrupt

    monkeypatch.setattr("semcast.server.session.Session.conclude", break_off)
    with pytest.raises(KeyboardInterrupt):
        replay(without_depth(recording, out=tmp_path))
    assert len(read_run(tmp_path).frame_ids) > FRAMES / 2


def test_a_part_is_measured_by_the_way_that_was_gone(recording):
    truth = open_sequence(SEQUENCE).groundtruth()
    part = replay(without_depth(recording, reference=SEQUENCE, start_s=0.2, end_s=0.95))
    assert part["frames"]["source"] == 8
    assert part["completeness"] > 0.7
    steps_m = np.linalg.norm(np.diff(truth.positions, axis=0), axis=1)
    assert part["path_length_m"] == pytest.approx(steps_m[2:9].sum(), rel=0.4)


def test_recorded_originals_give_the_same_psnr_as_the_sequence(recording, tmp_path):
    found = {}
    for name, reference in (("recorded", None), ("sequence", SEQUENCE)):
        replay(without_depth(recording, out=tmp_path / name, reference=reference))
        rows = (tmp_path / name / "frames.jsonl").read_text().splitlines()
        found[name] = [json.loads(row)["psnr_db"] for row in rows]
    assert found["recorded"] == found["sequence"]
    assert len(found["recorded"]) == FRAMES
    assert all(15.0 < psnr_db < 45.0 for psnr_db in found["recorded"])


def test_a_replay_that_can_not_be_shown_ends_its_threads(recording, tmp_path, monkeypatch):
    def fail(*_):
        raise ConfigError("no display here")

    monkeypatch.setattr("semcast.server.replay.open_viewer", fail)
    before = set(threading.enumerate())
    with pytest.raises(ConfigError, match="no display here"):
        replay(without_depth(recording, out=tmp_path, save_images="all"))
    left = {thread.name for thread in set(threading.enumerate()) - before}
    assert not {name for name in left if name.startswith("semcast")}


def test_a_paced_and_shown_replay_gives_the_same_poses(recording, tmp_path):
    plain = without_depth(recording, out=tmp_path / "plain", end_s=0.6)
    assert plain.source == "received"
    replay(plain)
    began_s = time.monotonic()
    shown = without_depth(
        recording, out=tmp_path / "shown", end_s=0.6, pace=0.5, view=ViewSettings(view="file")
    )
    replay(shown)
    assert time.monotonic() - began_s > 0.8  # the source's 0.5 s or more at half the pace
    first, second = ((tmp_path / name / "trajectory.tum").read_bytes() for name in ("plain", "shown"))
    assert first == second
    assert (tmp_path / "shown" / "run.rrd").stat().st_size > 10_000
    assert not (tmp_path / "plain" / "run.rrd").exists()


def test_a_channel_means_the_transmitted_symbols(recording):
    assert ReplaySettings(file=recording, link=ChannelSettings(snr_db=4.0)).source == "transmitted"
    with pytest.raises(ValueError, match="symbols must be transmitted for another channel, got received"):
        ReplaySettings(file=recording, symbols="received", link=ChannelSettings(snr_db=4.0))
    with pytest.raises(ValueError, match=r"pace must be in \[0, 100\], got -1"):
        ReplaySettings(file=recording, pace=-1.0)


def test_a_frame_that_can_not_be_tracked_costs_itself_alone(recording, whole, tmp_path, caplog, monkeypatch):
    process, count = Session.process, itertools.count()

    def fails_once(self, *args, **kwargs):
        if next(count) == 2:
            raise np.linalg.LinAlgError("singular")
        return process(self, *args, **kwargs)

    monkeypatch.setattr(Session, "process", fails_once)
    other = replay(without_depth(recording, out=tmp_path / "run"))
    assert other["drops"] == {**whole[0]["drops"], "track": 1}
    assert other["frames"]["tracked"] == whole[0]["frames"]["tracked"] - 1
    assert (tmp_path / "run" / "summary.json").is_file()
    assert "could not be tracked and is left out" in caplog.text


def test_a_time_range_without_frames_is_one_clear_error(recording, tmp_path):
    long = r"it is 0\.9 s long"
    replay(without_depth(recording, end_s=0.3, out=tmp_path / "run"))
    with pytest.raises(SourceError, match=f"no frame of .*run.mcap lies after 100 s: {long}"):
        replay(without_depth(recording, start_s=100.0, out=tmp_path / "run"))
    with pytest.raises(SourceError, match=f"lies after 0.21 s and before 0.22 s: {long}"):
        replay(without_depth(recording, start_s=0.21, end_s=0.22))
    assert not (tmp_path / "run" / "previous-1").exists()
    with pytest.raises(ValueError, match="end_s must be later"):
        ReplaySettings(file=recording, start_s=2.0, end_s=1.0)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--start-s", "nan"], "--start-s must be at least 0 and finite, got nan"),
        (["--start-s", "-1"], "--start-s must be at least 0 and finite, got -1"),
        (["--end-s", "nan"], "--end-s must be later than start_s (0), got nan"),
        (["--save-images", "all"], "--save-images needs --out, got save_images='all' without a folder"),
        (["--fx", "9", "--fy", "9", "--cx", "9", "--cy", "9"], "--fx is of the camera of the reference"),
        (["--seed", "-1"], "--seed must be in [0, 2147483647], got -1"),
        (["--threads", "99999"], "--threads must be in [1, 1024], got 99999"),
        (["--out", ""], "--out must be the name of a file or folder, got ''"),
    ],
)
def test_settings_that_can_not_be_are_one_clear_error(recording, words, text, capsys):
    assert main(["replay", str(recording), *words]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"semcast replay: {text}")
    assert said.count("\n") == 1


def test_the_seed_is_that_of_the_estimation_too(recording, tmp_path):
    replay(without_depth(recording, out=tmp_path, seed=7, end_s=0.6))
    in_force = read_toml(tmp_path / "settings.toml")
    assert in_force["seed"] == in_force["reconstruction"]["seed"] == 7
