"""A live server alone, timed on a recorded stream."""

import json
import os
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from semcast.agent.agent import camera_info
from semcast.agent.encoder import FrameEncoder
from semcast.agent.settings import AgentSettings
from semcast.agent.source import open_source
from semcast.agent.source_settings import SourceSettings
from semcast.channel.link import Link
from semcast.channel.settings import ChannelSettings
from semcast.cli import main
from semcast.common.codecs import load_codec
from semcast.common.errors import SemcastError, SourceError
from semcast.common.phy.pilots import insert_pilots
from semcast.common.recording_writer import RecordingWriter, recording_metadata
from semcast.common.symbol_payload import data_symbols, pack_iq, pack_lost
from semcast.common.wire import pack
from semcast.evaluation import server
from semcast.evaluation.interruption import InterruptedMeasurementError
from semcast.evaluation.server import ServerRunSettings, evaluate_server

pytestmark = pytest.mark.xdist_group("real-time")

SEQUENCE = Path(__file__).resolve().parents[2] / "deploy" / "demo" / "kitti_06"
NUM_FRAMES = 4
EPOCH = 1_700_000_000_000_000_000


def record(path, **of_encoder):
    """Four small frames as they were received, four a second, and what does not count."""
    source = SourceSettings(source=str(SEQUENCE), resize=0.3, max_frames=NUM_FRAMES, pace="receiver")
    opened, codec = open_source(source), load_codec("jpeg-ldpc")
    agent = AgentSettings(source=source, codec=codec.name, mode="replay")
    camera = replace(camera_info(agent, opened, codec, EPOCH), **of_encoder)
    encoder, link = FrameEncoder(codec, EPOCH, lossless=True), Link(ChannelSettings(snr_db=15.0), 0)
    with path.open("wb") as stream:
        writer = RecordingWriter(stream, recording_metadata("", "test"))
        writer.add("semcast/agent0/camera", "camera", EPOCH, 0, pack(camera))
        for k, frame in enumerate(opened.frames(threading.Event())):
            tx = encoder.encode(frame, 15.0)
            sent = link.transmit(insert_pilots(data_symbols(tx)), 0.1 * k, k)
            received = {"payload": pack_iq(sent.slots_rx), "slot_lost": pack_lost(sent.slot_lost)}
            rx = replace(tx, direction="rx", payload_format="iq16", **received, **of_encoder)
            at_ns = EPOCH + k * 250_000_000
            writer.add("semcast/agent0/rx/symbols", "symbols", at_ns, k, pack(rx))
        for k in range(1, 6):  # an agent repeats its last frame; another start of it left some as well
            for again in (rx, replace(rx, agent_epoch=EPOCH - 1, seq=k)):
                writer.add("semcast/agent0/rx/symbols", "symbols", at_ns + k * 10_000_000, k, pack(again))
        writer.finish()
    opened.close()
    return path


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return record(tmp_path_factory.mktemp("recording") / "run.mcap")


def test_each_run_is_of_a_new_server_that_takes_the_whole_stream(file, tmp_path, capsys):
    words = ["eval", "server", str(file), "--pace", "2", "--runs", "2", "--json", str(tmp_path / "r.json")]
    assert main(words) == 0
    report = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))
    assert report["command"].startswith("semcast eval server run.mcap --pace 2.0 --runs 2")
    assert (report["sequence"], report["codec"]) == ("kitti_06", "jpeg-ldpc")
    assert report["rate_hz"] == pytest.approx(8.0)
    assert len(report["results"]) == 2
    for run in report["results"]:
        assert run["frames"]["sent"] == NUM_FRAMES
        assert run["frames"]["tracked"] + sum(run["drops"].values()) == NUM_FRAMES
        assert run["stage_ms"]["decode"]["p50"] > 0.0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert sum(row[:1] == [str(NUM_FRAMES)] for row in rows) == 2


def test_a_server_that_does_not_start_is_told_in_its_own_words(file, tmp_path, monkeypatch):
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\necho first >&2\necho no torch here >&2\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    with pytest.raises(SemcastError, match="the server did not get to the end: no torch here"):
        evaluate_server(ServerRunSettings(file=file))


def test_a_stream_that_the_server_cannot_decode_is_no_result(tmp_path):
    other = record(tmp_path / "other.mcap", digest="0" * 16)
    with pytest.raises(SemcastError, match=r"the server decoded no frame of .*other.mcap; dropped: \d"):
        evaluate_server(ServerRunSettings(file=other, pace=4.0, runs=1))


def test_a_server_that_does_not_end_is_told(file, monkeypatch):
    monkeypatch.setattr(server, "_CONCLUDED_S", 0.01)
    with pytest.raises(SemcastError, match=r"the server did not end within 0\.01 s: "):
        evaluate_server(ServerRunSettings(file=file, pace=4.0))


def test_an_interruption_leaves_the_runs_before_it(file, tmp_path, monkeypatch):
    runs = iter([{"frames": {}, "drops": {}, "completeness": 1.0, "stage_ms": {}}])

    def run(*_):
        if (result := next(runs, None)) is None:
            raise KeyboardInterrupt
        return result

    monkeypatch.setattr(server, "_run", run)
    with pytest.raises(KeyboardInterrupt) as caught:
        evaluate_server(ServerRunSettings(file=file, json=tmp_path / "r.json"))
    assert caught.type is InterruptedMeasurementError
    report = json.loads((tmp_path / "r.partial.json").read_text(encoding="utf-8"))
    assert (report["partial"], len(report["results"])) == (True, 1)


def test_its_server_ends_with_it_however_that_ends(file, tmp_path, monkeypatch):
    """In a group of its own, so that Ctrl-C in a terminal reaches the server through the evaluation alone."""
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\necho of $SEMCAST_PARENT_PID, $(($(ps -o pgid= -p $$) - $$))\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    with pytest.raises(SemcastError, match=f"of {os.getpid()}, 0$"):
        evaluate_server(ServerRunSettings(file=file))


def test_a_recording_without_the_stream_is_refused_before_a_server_is_started(file, monkeypatch):
    monkeypatch.setattr(sys, "executable", "nothing that could be started")
    with pytest.raises(SourceError, match=r"stream must be in \[1, 1\]"):
        evaluate_server(ServerRunSettings(file=file, stream=2))


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"pace": 0.0}, r"pace must be in \[0.01, 100\], got 0"),
        ({"runs": 0}, "runs must be at least 1, got 0"),
        ({"threads": 0}, "threads must be"),
    ],
)
def test_settings_out_of_range_are_refused(file, given, text):
    with pytest.raises(ValueError, match=text):
        ServerRunSettings(file=file, **given)
