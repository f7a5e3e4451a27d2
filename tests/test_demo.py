import json
import os
import shutil
import signal
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from semcast import demo
from semcast.channel.settings import ChannelSettings
from semcast.cli import main
from semcast.commands.demo import few_poses, summary_table, why_no_pose
from semcast.common.camera import Intrinsics
from semcast.common.camera_settings import CameraSettings
from semcast.common.config import build_settings, read_toml, to_toml
from semcast.common.errors import ConfigError, SemcastError, SourceError
from semcast.common.loopback import free_endpoint
from semcast.common.recording_reader import RecordingReader
from semcast.common.role import Role
from semcast.common.sequence import open_sequence
from semcast.demo import (
    DemoSettings,
    Playback,
    agent_command,
    choose_playback,
    open_recording,
    role_commands,
    run_demo,
)
from semcast.demo_recording import look_at
from semcast.real_time import Plan
from semcast.server.replay import ReplaySettings, replay
from semcast.server.run_summary import run_line, too_much

pytestmark = pytest.mark.xdist_group("real-time")

SEQUENCE = Path(__file__).resolve().parents[1] / "deploy" / "demo" / "kitti_06"


def run(settings, tell=lambda line: None, progress=lambda done, text: None, stop=None):
    return run_demo(settings, open_recording(settings), stop or threading.Event(), tell, progress)


@pytest.mark.parametrize("stride", [1, 3, 7])
def test_a_machine_that_keeps_up_plays_at_the_recorded_times(tmp_path, monkeypatch, stride):
    monkeypatch.setattr(demo, "plan_for", lambda *given: Plan(0.5, given[3]))
    recorded = look_at(SEQUENCE, CameraSettings())
    recorded = replace(recorded, rate_hz=recorded.rate_hz / 1.0371)
    settings = DemoSettings(stride=stride, out=tmp_path)
    playback = choose_playback(settings, recorded)
    assert (playback.resize, playback.stride, playback.speed) == (0.5, stride, 1.0)
    assert "--pace" not in agent_command(settings, SEQUENCE, "tcp/127.0.0.1:1", playback)
    slower = choose_playback(
        DemoSettings(stride=stride, rate_hz=playback.rate_hz / 2, out=tmp_path), recorded
    )
    assert slower.speed == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("codec", "num_frames", "told"),
    [
        ("3dcsc-lite", 300, "0.25 of the recorded pace, which takes 60 s, as this machine can serve; faster"),
        ("3dcsc-lite", 3000, "which takes 10 min, as"),
        ("3dcsc-lite", 300, "a smaller --resize, or a conventional codec such as jpeg-amc, or at any pace"),
        ("jpeg-amc", 300, "a smaller --resize, or at any pace with --rate-hz"),
        ("3dcsc-lite", None, "0.25 of the recorded pace, as this machine can serve; faster"),
    ],
)
def test_who_waits_for_a_slow_machine_knows_how_long_and_what_is_faster(tmp_path, codec, num_frames, told):
    settings = DemoSettings(codec=codec, out=tmp_path, resize=0.5)
    (text,) = demo._reductions(settings, Playback(0.5, 1, 5.0, 0.25), num_frames)
    assert told in text


def test_what_a_machine_can_serve_is_measured_on_a_link_like_the_one_asked_for(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(demo, "plan_for", lambda *given: seen.append(given[-1]) or Plan(1.0, given[3]))
    settings = DemoSettings(link=ChannelSettings(snr_db=4.5), out=tmp_path)
    choose_playback(settings, look_at(SEQUENCE, CameraSettings()))
    assert seen == [4.5]


def test_a_damaged_first_image_is_no_reason_not_to_play_a_recording(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(demo, "plan_for", lambda *given: seen.append(given[2]) or Plan(0.5, given[3]))
    folder = shutil.copytree(SEQUENCE, tmp_path / "damaged")
    for name in ("000000.jpg", "000001.jpg"):
        (folder / "images" / name).write_bytes(b"no picture")
    assert choose_playback(DemoSettings(out=tmp_path), look_at(folder, CameraSettings())).resize == 0.5
    assert np.array_equal(seen[0], open_sequence(folder).image(2))


def write_video(path, count):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (64, 48))
    for k in range(count):
        writer.write(np.full((48, 64, 3), 20 * k, np.uint8))
    writer.release()


def test_a_video_is_played_like_a_sequence_but_compared_with_nothing(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(demo, "plan_for", lambda *given: seen.append(given[2]) or Plan(1.0, given[3]))
    video = tmp_path / "walk.avi"
    write_video(video, 4)
    with pytest.raises(SourceError, match="walk.avi is unknown"):
        look_at(video, CameraSettings())
    recorded = look_at(video, CameraSettings(focal_35mm=26.0))
    assert (recorded.num_frames, recorded.is_video) == (4, True)
    playback = choose_playback(DemoSettings(out=tmp_path, stride=1), recorded)
    assert (playback.rate_hz, playback.speed, seen[0].shape) == (20.0, 1.0, (48, 64, 3))
    assert "--reference" not in role_commands(DemoSettings(), None, "tcp/127.0.0.1:1")["server"]


def write_images(folder, count):
    folder.mkdir()
    for k in range(count):
        cv2.imwrite(str(folder / f"{k}.png"), np.full((48, 64, 3), 20 * k, np.uint8))


def commands_of(settings):
    endpoint = "tcp/127.0.0.1:1"
    agent = agent_command(settings, SEQUENCE, endpoint, Playback(0.5, 1, 8.0, 0.8))
    return {**role_commands(settings, SEQUENCE, endpoint), "agent": agent}


def test_every_setting_reaches_a_process(tmp_path):
    settings = DemoSettings(
        codec="webp-ldpc", modulation="analog", confidence="paper", view="web", seed=7,
        link=ChannelSettings(channel="burst", snr_db=3.5, slot_loss=0.3, delay_ms=250, frame_loss=0.125),
        out=tmp_path / "o", viewer_port=9877, web_port=9091,
    )  # fmt: skip
    words = [w for command in commands_of(settings).values() for w in command]
    for value in ("webp-ldpc", "analog", "burst", "paper", "web", "7", "0.5", "8", str(tmp_path / "o")):
        assert value in words
    link = " ".join(role_commands(settings, SEQUENCE, "tcp/127.0.0.1:1")["channel"])
    for flag in ("--snr-db 3.5", "--slot-loss 0.3", "--delay-ms 250", "--frame-loss 0.125"):
        assert f"{flag} " in link
    assert tuple(words[words.index(f"--{name}-port") + 1] for name in ("viewer", "web")) == ("9877", "9091")


def test_a_codec_that_chooses_its_modulation_is_given_none(tmp_path):
    commands = commands_of(DemoSettings(codec="jpeg-amc", out=tmp_path))
    assert not any("--modulation" in command for command in commands.values())


@pytest.mark.parametrize(
    "words",
    [
        ["demo", "--sequence", "missing"],
        ["agent", "--source", "missing"],
        ["server", "--out", "file/out"],
        ["eval", "trajectory", "--sequence", "missing"],
        ["eval", "codec", "--images", "missing"],
    ],
)
def test_a_modulation_that_is_asked_of_such_a_codec_is_told_to_do_nothing(
    words, tmp_path, monkeypatch, caplog
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    for given, told in (([], []), (["--modulation", "16qam"], ["modulation: no effect on codec jpeg-amc"])):
        caplog.clear()
        assert main([*words, "--codec", "jpeg-amc", *given]) == 1
        assert [
            r.getMessage().partition(",")[0] for r in caplog.records if "effect" in r.getMessage()
        ] == told


def test_the_camera_reaches_the_agent_and_the_reference_it_is_compared_with(tmp_path):
    def commands(**camera):
        settings = DemoSettings(camera=CameraSettings(**camera), out=tmp_path)
        return commands_of(settings)

    plain = commands(focal_35mm=26.0)
    lens = {"distortion": (0.1, 0.0, 0.0, 0.0), "distortion_model": "equidistant"}
    bent = commands(fx=500.0, fy=500.0, cx=320.0, cy=240.0, **lens)
    for role in ("agent", "server"):
        assert "--focal-35mm 26.0" in " ".join(plain[role])
        assert "--distortion 0.1 0.0 0.0 0.0 --distortion-model equidistant" in " ".join(bent[role])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"resize": 2.0}, "resize"),
        ({"stride": 0}, "stride"),
        ({"seed": -1}, r"seed must be in \[0, 2147483647\], got -1"),
        ({"viewer_port": 0}, r"viewer_port must be in \[1, 65535\], got 0"),
        ({"viewer_port": 9090}, "viewer_port and web_port must differ, got 9090 for both"),
    ],
)
def test_bad_settings_are_refused_before_anything_starts(values, message):
    with pytest.raises(ValueError, match=message):
        DemoSettings(**values)


@pytest.mark.parametrize("wrong", ["codec", "weights", "camera", "channel", "record", "out", "view"])
def test_what_can_not_run_is_refused_before_a_former_run_goes(tmp_path, wrong, monkeypatch):
    monkeypatch.setattr("semcast.server.view.feed.window_display", lambda: None)
    former = tmp_path / "out"
    former.mkdir()
    (former / "summary.json").write_text("{}")
    values = {"view": "none", "out": former, "codec": "jpeg-ldpc"}
    if wrong == "camera":
        values["sequence"] = tmp_path / "plain"
        shutil.copytree(SEQUENCE / "images", values["sequence"])
    encoder = tmp_path / "mine.onnx"
    encoder.touch()
    values |= {
        "codec": {"codec": "no-such-codec"},
        "weights": {"codec": str(encoder)},
        "channel": {"link": ChannelSettings(channel="trace", trace="file", trace_file=tmp_path / "none.csv")},
        "record": {"record": former / "summary.json" / "run.mcap"},
        "out": {"out": former / "summary.json"},
        "view": {"view": "native", "viewer_port": int(free_endpoint().rpartition(":")[2])},
    }.get(wrong, {})
    message = {
        "codec": "no-such-codec",
        "weights": "can only send",
        "camera": "camera of plain is unknown",
        "channel": "none.csv",
        "record": r"record can't be written to .*run\.mcap",
        "out": "summary.json can't be made a folder for outputs",
        "view": "no display: use --view web",
    }[wrong]
    with pytest.raises((SemcastError, ValueError), match=message):
        run(DemoSettings(**values))
    assert [p.name for p in former.iterdir()] == ["summary.json"]


def test_a_role_that_can_not_start_ends_the_demo_with_its_own_words(tmp_path, monkeypatch):
    monkeypatch.setattr("semcast.demo.check_codec", lambda name: None)
    settings = DemoSettings(codec="no-such-codec", view="none", resize=0.25, rate_hz=10.0, out=tmp_path)
    with pytest.raises(SemcastError, match="did not start: .*no-such-codec"):
        run(settings)


def test_a_server_that_ends_before_it_listens_is_not_waited_for(tmp_path, monkeypatch):
    program = (sys.executable, "-c", "import sys; sys.exit('semcast server: the disk is on fire')")
    monkeypatch.setattr("semcast.demo._PROGRAM", program)
    started_s = time.monotonic()
    with pytest.raises(SemcastError, match="server did not start: .*the disk is on fire"):
        run(DemoSettings(view="none", out=tmp_path))
    assert time.monotonic() - started_s < 20.0


def test_a_folder_with_images_no_run_wrote_is_no_place_for_outputs(tmp_path):
    sequence = tmp_path / "sequence"
    shutil.copytree(SEQUENCE, sequence)
    before = sorted(p.name for p in sequence.rglob("*"))
    settings = DemoSettings(sequence=sequence, codec="jpeg-ldpc", view="none", out=sequence)
    with pytest.raises(ConfigError, match="out must not hold images that no run wrote"):
        run(settings)
    assert sorted(p.name for p in sequence.rglob("*")) == before


def test_three_processes_turn_a_sequence_into_a_trajectory(tmp_path):
    told, rows = [], []
    recording = tmp_path / "run.mcap"
    settings = DemoSettings(
        codec="jpeg-ldpc", view="none", resize=0.3, stride=2, out=tmp_path, record=recording
    )
    summary, error = run(settings, told.append, lambda *row: rows.append(row))
    assert error is None
    assert summary is not None
    assert {line.split()[0] for line in told} >= {"server", "channel", "agent"}
    assert rows[-1][0] == 51
    frames = [text for _, text in rows if "inliers" in text]
    assert frames[-1].startswith("tracking ")
    assert rows[-1][1].startswith(("last adjustment of ", "depth ", "writing results"))
    for name in ("trajectory.tum", "map.ply", "summary.json", "settings.toml"):
        assert (tmp_path / name).stat().st_size > 0
    in_force = build_settings(DemoSettings, read_toml(tmp_path / "demo.toml"))
    assert (in_force.sequence, in_force.link) == (SEQUENCE, ChannelSettings())
    assert None not in (in_force.stride, in_force.rate_hz), "what this machine could serve"
    assert summary["completeness"] > 0.3  # live, so a loaded machine drops frames
    assert summary["ate_percent"] < 5.0
    info = RecordingReader(recording).info()
    assert info.complete
    assert not info.missed
    # What the server itself sends is recorded with the rest.
    assert info.counts["semcast/demo/tx/symbols"] >= len(frames)
    assert info.counts["semcast/demo/rx/symbols"] >= len(frames)
    assert info.counts["semcast/demo/pose"] >= len(frames)
    assert info.counts["semcast/demo/camera"] >= 1
    again = replay(ReplaySettings(file=recording, reference=SEQUENCE, dense_cloud="none"))
    assert again["frames"]["tracked"] >= len(frames)  # none is too old or overtaken in a replay


@pytest.mark.slow
def test_a_link_that_nothing_can_be_decoded_on_is_said(tmp_path):
    lines, told = [], []
    settings = DemoSettings(
        codec="jpeg-ldpc",
        link=ChannelSettings(snr_db=0.0),
        view="file",
        resize=0.3,
        rate_hz=5.0,
        stride=2,
        out=tmp_path,
    )
    summary, error = run(settings, lines.append, lambda *row: told.append(row))
    assert error is None
    assert summary["frames"]["tracked"] == 0
    # On a busy machine it is still told that results are being written.
    num_done, text = [row for row in told if row[1].startswith("no image could be decoded")][-1]
    assert text == f"no image could be decoded, {num_done} outages"
    assert num_done > 5
    assert "0 frames tracked, 0 with a pose; dropped: " in (tmp_path / "logs" / "server.log").read_text()
    assert not [line for line in lines if "with a pose" in line], "the table that follows says it"
    assert (tmp_path / "run.rrd").stat().st_size > 20_000  # grey images


@pytest.mark.slow
def test_a_link_that_loses_all_ends_the_demo_and_is_said(tmp_path):
    settings = DemoSettings(
        codec="jpeg-ldpc",
        link=ChannelSettings(frame_loss=1.0),
        view="none",
        resize=0.25,
        rate_hz=20.0,
        stride=4,
        out=tmp_path,
    )
    stop = threading.Event()
    patience = threading.Timer(90.0, stop.set)
    patience.start()
    summary, error = run(settings, stop=stop)
    patience.cancel()
    assert not stop.is_set(), "it ends by itself"
    assert error is None
    assert summary["frames"]["tracked"] == 0
    assert summary["drops"]["missing"] == summary["frames"]["sent"] > 3


@pytest.mark.slow
def test_an_agent_that_gives_up_ends_the_demo_with_what_came_out_so_far(tmp_path):
    sequence = tmp_path / "sequence"
    shutil.copytree(SEQUENCE, sequence)
    images = sorted((sequence / "images").iterdir())
    for image in images[12:]:
        image.write_bytes(b"no image")
    settings = DemoSettings(
        sequence=sequence, codec="jpeg-ldpc", view="none", resize=0.4, rate_hz=10.0, out=tmp_path / "out"
    )
    told = []
    summary, error = run(settings, told.append)
    assert error is not None
    assert "images" in error
    assert [line.partition(", see")[0] for line in told if line.startswith("images left out")] == [
        "images left out, unreadable or of another size: 9"
    ]
    warnings = [line for line in told if line.startswith("the agent warns: ")]
    assert len(warnings) == 4, "the first three, and how many more"
    assert "000012.jpg is not a readable image" in warnings[0]
    assert "times more, see" in warnings[3]
    assert summary is not None
    assert summary["frames"]["tracked"] > 0


def test_a_demo_that_is_stopped_before_its_first_frame_blames_no_process(tmp_path, monkeypatch, capsys):
    def interrupted(*_):
        os.kill(os.getpid(), signal.SIGINT)
        return None, None

    monkeypatch.setattr("semcast.commands.demo.run_demo", interrupted)
    assert main(["demo", "--out", str(tmp_path)]) == 130
    said = capsys.readouterr().err
    assert "stopped before the first frame was tracked: there are no results" in said
    assert "logs" not in said


def test_a_demo_that_is_stopped_when_its_server_was_killed_says_where_to_look(tmp_path, monkeypatch, capsys):
    def interrupted(*_):
        (tmp_path / "frames.jsonl").write_text("{}\n")
        os.kill(os.getpid(), signal.SIGINT)
        return None, None

    monkeypatch.setattr("semcast.commands.demo.run_demo", interrupted)
    assert main(["demo", "--out", str(tmp_path)]) == 130
    said = capsys.readouterr().err
    assert "no summary was written; the logs of the three processes say why" in said
    assert "stopped before the first frame" not in said


@pytest.mark.parametrize(
    ("value", "told"), [(0.003312, "0.00331 m"), (12.345, "12.3 m"), (1234.5, "1230 m"), (0.0, "0 m")]
)
def test_errors_are_shown_with_three_digits(value, told):
    table = summary_table({"completeness": 0.98765, "ate_rmse_m": value, "ate_percent": 0.1234})
    names, values = ([str(cell) for cell in column.cells] for column in table.columns)
    assert values == ["98.8%", "0.123 % of the path", told]
    assert names[1:] == ["position error (ATE RMSE after Sim(3))", "  in metres"]
    in_no_metres = summary_table({"completeness": 0.98765, "ate_rmse_m": None, "ate_percent": 0.1234})
    assert [str(cell) for cell in in_no_metres.columns[1].cells] == ["98.8%", "0.123 % of the path"]


@pytest.mark.parametrize(("readout_ms", "told"), [(19.62, ["100.0%", "19.6 ms from top"]), (0.0, ["100.0%"])])
def test_a_rolling_shutter_that_images_were_put_right_for_is_shown(readout_ms, told):
    table = summary_table({"completeness": 1.0, "readout_ms": readout_ms, "readout_from": "top"})
    assert [str(cell) for cell in table.columns[1].cells] == told


def test_a_camera_given_by_hand_takes_the_place_of_one_that_does_not_fit_the_images(tmp_path, monkeypatch):
    sequence = tmp_path / "halved"
    write_images(sequence, 3)
    Intrinsics(fx=90, fy=90, cx=63.5, cy=47.5, width=128, height=96).save(sequence / "intrinsics.json")
    called = []
    monkeypatch.setattr(
        "semcast.commands.demo.run_demo", lambda settings, *_: called.append(settings) or (None, None)
    )
    words = ["demo", "--sequence", str(sequence), "--out", str(tmp_path / "run")]
    assert main([*words, "--focal-35mm", "26"]) == 1, "no summary was written"
    assert [settings.camera.focal_35mm for settings in called] == [26.0]


def test_the_summary_may_have_stdout_for_itself(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    summary = {"completeness": 1.0, "num_landmarks": 7}
    monkeypatch.setattr("semcast.commands.demo.run_demo", lambda *_: (summary, None))
    assert main(["demo", "--sequence", str(SEQUENCE), "--json", "-"]) == 0
    shown = capsys.readouterr()
    assert json.loads(shown.out)["num_landmarks"] == 7
    assert "landmarks" in shown.err
    assert not Path("-").exists()


def test_few_poses_are_said_not_to_be_those_of_a_stream():
    assert "only 17% of the frames have a pose: are the images" in few_poses({"completeness": 0.17})
    assert few_poses({"completeness": 0.9}) is None
    assert few_poses({"completeness": 0.0}) is None, "that has a line of its own"


def test_a_demo_without_a_pose_says_why():
    assert "no image could be decoded" in why_no_pose({"frames": {"source": 51}, "completeness": 0.0})
    assert "move sideways" in why_no_pose({"frames": {"tracked": 51}, "completeness": 0.0})


def test_what_the_line_below_the_table_says_is_not_told_as_a_warning_too(tmp_path):
    summary = {
        "frames": {"sent": 4, "tracked": 1, "posed": 0},
        "drops": {"superseded": 3},
    }
    server = Role("server", [], tmp_path / "log")
    known = [run_line(summary), too_much(summary)]
    said = [*known, "the focal length seems too short"]
    log = [f"2026-03-01T11:58:05 WARNING semcast.server.session: {text}" for text in said]
    server.log.write_text("\n".join(log))
    assert demo._warnings(server, known) == said[-1:]


def test_frames_that_a_busy_machine_skipped_are_not_blamed_on_the_images():
    skipped = {
        "frames": {"sent": 34, "tracked": 5},
        "drops": {"superseded": 23, "too_old": 6, "duplicate": 9},
    }
    told = "the server had no time for 29 of 34; a smaller --resize, a larger --stride"
    assert f"only 6% of the frames have a pose: {told}" in few_poses({"completeness": 0.059, **skipped})
    assert f"no frame has a pose: {told}" in why_no_pose({"completeness": 0.0, **skipped})
    few = {**skipped, "drops": {"superseded": 10}}
    assert "are the images" in few_poses({"completeness": 0.059, **few})


@pytest.mark.parametrize(
    ("link", "words", "told"),
    [
        ({}, [], []),  # as a demo leaves it in its demo.toml
        ({"slot_loss": 0.3}, [], ["slot_loss: no effect on channel awgn as it is set"]),
        ({}, ["--slot-loss", "0.2"], ["slot_loss: no effect on channel awgn as it is set"]),
    ],
)
def test_values_of_a_link_that_nobody_asked_for_are_not_warned_of(link, words, told, tmp_path, caplog):
    file = tmp_path / "demo.toml"
    file.write_text(to_toml(DemoSettings(sequence=tmp_path / "none", link=ChannelSettings(**link))))
    assert main(["demo", "--config", str(file), *words]) == 1
    assert [record.message for record in caplog.records if "no effect" in record.message] == told
