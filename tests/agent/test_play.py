"""A recorded stream put back on the network: what live processes make of it."""

import contextlib
import logging
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from announced import announced_camera
from waiting import until

from semcast.agent.encoder import FrameEncoder
from semcast.agent.play import PlaySettings, run_play
from semcast.agent.source import SourceFrame
from semcast.channel.emulator import run_channel
from semcast.channel.emulator_settings import EmulatorSettings
from semcast.channel.link import Link
from semcast.channel.settings import ChannelSettings
from semcast.cli import main
from semcast.common.errors import SourceError
from semcast.common.keys import camera_key, channel_key, rx_key, source_key, tx_key
from semcast.common.loopback import free_endpoint, open_hub
from semcast.common.messages import CameraInfo, ChannelReport, SourceImage, StatusMessage, SymbolFrame
from semcast.common.metrics import Metrics
from semcast.common.network_settings import NetworkSettings
from semcast.common.phy.pilots import insert_pilots
from semcast.common.recording_writer import RecordingWriter, recording_metadata
from semcast.common.symbol_payload import data_symbols, pack_iq, pack_lost
from semcast.common.wire import pack, unpack
from semcast.server.receiver import Receiver

pytestmark = pytest.mark.xdist_group("real-time")

EPOCH = 1_700_000_000_000_000_000
NUM_FRAMES = 6
AGENT = "agent0"


def camera_of(codec, **changes):
    values = {
        "agent_id": AGENT, "agent_epoch": EPOCH, "nominal_rate_hz": 50.0, "codec": codec.name,
        "digest": codec.digest, "modulation": codec.modulation, "source_name": "steps",
        "num_frames": NUM_FRAMES, "last_frame_id": NUM_FRAMES - 1,
    }  # fmt: skip
    return announced_camera(**{**values, **changes})


def frames_of(codec, epoch=EPOCH, *, lossless=False, lost=()):
    """What agent and channel sent, frame by frame: the two sides of the channel."""
    encoder, link = FrameEncoder(codec, epoch, lossless), Link(ChannelSettings(snr_db=20.0), 0)
    for k in range(NUM_FRAMES):
        image = np.full((48, 64, 3), 20 * k, np.uint8)
        t_ns = 10**9 + 20_000_000 * k
        tx = encoder.encode(SourceFrame(k, t_ns, t_ns, image, k == NUM_FRAMES - 1), 10.0)
        sent = link.transmit(insert_pilots(data_symbols(tx)), 0.0, k)
        rx = replace(
            tx, direction="rx", payload_format="iq16", payload=pack_iq(sent.slots_rx),
            slot_lost=pack_lost(sent.slot_lost),
        )  # fmt: skip
        if k in lost:
            rx = replace(rx, payload_format="lost", payload=b"") if lossless else None
        yield tx, rx


def stream_of(codec, epoch=EPOCH, period_s=0.02, **how):
    """Times and messages of a whole stream, as a recorder has them."""
    yield 0.0, camera_of(codec, agent_epoch=epoch, lossless=how.get("lossless", False))
    for k, (tx, rx) in enumerate(frames_of(codec, epoch, **how)):
        original = {"frame_id": k, "image_hw": (48, 64), "image_format": "png", "data": b"png"}
        yield period_s * k, SourceImage(agent_epoch=epoch, **original)
        yield period_s * k, tx
        report = {"frame_id": k, "channel": "awgn", "num_slots": 3, "num_slots_lost": 0}
        is_lost = rx is None
        yield (
            period_s * k,
            ChannelReport(agent_epoch=epoch, snr_db_set=20.0, frame_lost=is_lost, **report),
        )
        if rx is not None:
            yield period_s * k + 0.001, rx


KEYS = {"camera": camera_key, "source": source_key, "channel": channel_key}


def write(path, timed, *, finish=True, of_another=()):
    with path.open("wb") as file:
        writer = RecordingWriter(file, recording_metadata("", "test"))
        for count, (t_s, message) in enumerate(timed):
            make = KEYS.get(message.kind) or (tx_key if message.direction == "tx" else rx_key)
            writer.add(make(AGENT), message.kind, EPOCH + round(t_s * 1e9), count, pack(message))
        for message in of_another:
            writer.add("semcast/right/rx/symbols", "symbols", EPOCH, 0, pack(message))
        if finish:
            writer.finish()
        else:
            writer.flush()
    return path


@pytest.fixture
def file(tmp_path, codec):
    return write(tmp_path / "run.mcap", stream_of(codec))


class Bench:
    """A hub with a server's receiver, and ears for everything that is sent."""

    def __init__(self, agent_id=AGENT, mode="live"):
        self.hub, self.endpoint = open_hub()
        self.network = NetworkSettings(connect=(self.endpoint,))
        self.metrics = Metrics("server")
        self.agent_id = agent_id
        self.heard = {name: [] for name in ("camera", "source", "channel", "tx/symbols")}
        self.heard |= {"status/agent": [], "status/channel": []}
        for name, heard in self.heard.items():
            self.hub.subscribe(f"semcast/{agent_id}/{name}", "every", heard.append)
        self.receiver = Receiver(self.hub, agent_id, mode, self.metrics)
        self.threads = []

    def messages(self, name, kind):
        return [unpack(payload, kind) for payload in list(self.heard[name])]

    def begin_server(self):
        self.hub.declare_alive(self.agent_id, "server")

    def play(self, file, **changes):
        play = Play(PlaySettings(file=file, network=self.network, **changes))
        self.threads.append(play)
        return play

    def take(self, play, count=None):
        """Take frames as a server does, so many or to the final one; and whatever came to the end."""
        frames = []
        end_s = time.monotonic() + 60.0
        is_all = False
        while not is_all or (frame := self.receiver.next(0.0)) is not None:
            assert time.monotonic() < end_s
            for camera in self.messages("camera", CameraInfo):
                self.receiver.announce_ready(camera.agent_epoch)
            frame = self.receiver.next(0.02) if not is_all else frame
            if frame is not None:
                frames.append(frame)
                self.receiver.done(frame.message)
            if not is_all and frames and (frames[-1].message.final or len(frames) == count):
                is_all = True
                play.join(60)
        if play.error is not None:
            raise play.error
        return frames

    def close(self):
        for thread in self.threads:
            thread.stop.set()
            thread.join(30)
        self.receiver.close()
        self.hub.close()


class Play(threading.Thread):
    def __init__(self, settings):
        super().__init__()
        self.settings, self.stop = settings, threading.Event()
        self.result = self.error = None
        self.start()

    def run(self):
        try:
            self.result = run_play(self.settings, self.stop)
        except Exception as err:
            self.error = err


@pytest.fixture
def bench():
    opened = Bench()
    with contextlib.closing(opened):
        yield opened


def test_a_server_receives_what_the_link_made_of_the_frames_as_a_new_stream(bench, file, codec, caplog):
    bench.begin_server()
    before_ns, before_mono_ns = time.time_ns(), time.monotonic_ns()
    play = bench.play(file)
    frames = bench.take(play)
    recorded = [rx for _, rx in frames_of(codec)]
    assert [f.message.frame_id for f in frames] == list(range(NUM_FRAMES))
    assert [f.message.payload for f in frames] == [rx.payload for rx in recorded]
    assert [f.message.t_source_ns for f in frames] == [rx.t_source_ns for rx in recorded]
    assert [f.message.seq for f in frames] == list(range(NUM_FRAMES))
    assert frames[-1].message.final
    epoch = frames[0].message.agent_epoch
    assert before_ns < epoch < time.time_ns()
    assert play.result["agent_epoch"] == epoch
    # What is measured against these clocks is of today.
    assert all(before_mono_ns < f.message.t_capture_ns < time.monotonic_ns() for f in frames)
    assert frames[0].camera == camera_of(codec, agent_epoch=epoch)
    until(lambda: len(bench.heard["source"]) == NUM_FRAMES, "the originals")
    assert {m.agent_epoch for m in bench.messages("source", SourceImage)} == {epoch}
    until(lambda: len(bench.heard["channel"]) == NUM_FRAMES, "what the recorded channel reported")
    reports = bench.messages("channel", ChannelReport)
    assert {(m.agent_epoch, m.snr_db_set) for m in reports} == {(epoch, 20.0)}
    assert not bench.heard["tx/symbols"], "a channel would send them on"
    assert bench.metrics.drops == {}
    assert not [r for r in caplog.records if r.name == "semcast.agent.play" and r.levelno >= logging.WARNING]


def test_a_server_in_replay_mode_and_what_plays_to_it_say_why_nothing_comes_of_it(file, caplog, monkeypatch):
    monkeypatch.setattr("semcast.agent.peers.READY_S", 0.3)
    with contextlib.closing(Bench(mode="replay")) as bench:
        bench.begin_server()
        play = bench.play(file)
        play.join(30)
        until(lambda: bench.metrics.drops.get("mode") == NUM_FRAMES, "the frames, which it takes none of")
    assert "the server has not said that it is ready: see its log; in --mode replay" in caplog.text
    said = "the agent runs in live mode, this server in replay: give both one --mode, live for 'semcast play'"
    assert said in caplog.text


def test_the_end_of_a_played_stream_is_told(bench, file):
    bench.begin_server()
    play = bench.play(file)
    bench.take(play)
    until(lambda: any(m.ended for m in bench.messages("status/agent", StatusMessage)), "the end")
    last = bench.messages("status/agent", StatusMessage)[-1]
    assert last.counts["sent"] == NUM_FRAMES
    assert play.result["complete"]
    until(lambda: bench.hub.alive_roles(AGENT) == {"server"}, "agent and channel gone")


def test_frames_that_were_lost_on_the_air_count_as_sent(bench, tmp_path, codec):
    file = write(tmp_path / "run.mcap", stream_of(codec, lost=(2, 5)))
    bench.begin_server()
    play = bench.play(file)
    frames = bench.take(play, count=4)
    assert [f.message.seq for f in frames] == [0, 1, 3, 4]
    assert play.result["counts"]["sent"] == NUM_FRAMES, "or the server would not miss the last one"
    assert play.result["counts"]["played"] == 4


def test_where_only_the_received_side_was_recorded_gaps_in_it_tell_what_was_sent(bench, tmp_path, codec):
    timed = stream_of(codec, lost=(2, 3))
    received = [(t_s, m) for t_s, m in timed if getattr(m, "direction", "rx") == "rx"]
    play = bench.play(write(tmp_path / "run.mcap", received), wait=False)
    play.join(30)
    assert play.result["counts"]["sent"] == NUM_FRAMES
    assert play.result["counts"]["played"] == NUM_FRAMES - 2


def test_transmitted_symbols_go_through_a_channel_that_runs(bench, file):
    stop = threading.Event()
    radio = EmulatorSettings(network=bench.network, link=ChannelSettings(snr_db=7.0))
    channel = threading.Thread(target=run_channel, args=(radio, stop))
    channel.start()
    bench.begin_server()
    try:
        frames = bench.take(bench.play(file, symbols="transmitted"))
    finally:
        stop.set()
        channel.join(30)
    until(lambda: len(bench.heard["tx/symbols"]) == NUM_FRAMES, "what was sent")
    reports = bench.messages("channel", ChannelReport)
    assert {m.snr_db_set for m in reports} == {7.0}, "the recorded channel says nothing"
    assert frames[-1].message.frame_id == NUM_FRAMES - 1


def test_nothing_is_played_before_the_server_is_there_and_ctrl_c_ends_the_waiting(bench, file, caplog):
    caplog.set_level(logging.INFO)
    play = bench.play(file)
    until(lambda: "waiting for server of 'agent0'" in caplog.text, "the waiting")
    answer = bench.hub.request(camera_key(AGENT), b"", 5.0)
    assert unpack(answer, CameraInfo).source_name == "steps", "who comes late may ask"
    assert bench.messages("camera", CameraInfo) == [unpack(answer, CameraInfo)], "who was there is told"
    until(lambda: bench.receiver.roles_alive == {"agent", "channel"}, "both are there")
    until(lambda: bench.heard["status/channel"], "the channel's status")
    play.stop.set()
    play.join(30)
    assert not play.result["complete"]
    assert play.result["counts"] == {}
    assert not any(m.ended for m in bench.messages("status/agent", StatusMessage))


def test_without_waiting_whoever_subscribes_hears_it(bench, file):
    frames = bench.take(bench.play(file, wait=False))
    assert len(frames) == NUM_FRAMES


def test_frames_that_nobody_takes_are_told(file, monkeypatch):
    monkeypatch.setattr("semcast.agent.peers.READY_S", 0.1)
    with contextlib.closing(Bench("left")) as bench:
        bench.hub.declare_alive(AGENT, "server")  # which has gone deaf
        play = bench.play(file)
        play.join(30)
    assert play.result["drops"] == {"unheard": NUM_FRAMES}
    assert "played" not in play.result["counts"]
    assert play.result["counts"]["sent"] == NUM_FRAMES, "a server that comes back misses them"


def test_a_lossless_recording_is_played_live_and_each_frame_once(bench, tmp_path, codec):
    timed = list(stream_of(codec, lossless=True, lost=(3,)))
    again = [(t_s, m) for t_s, m in timed if isinstance(m, SymbolFrame)][-4:]
    bench.begin_server()
    play = bench.play(write(tmp_path / "run.mcap", timed + again))
    frames = bench.take(play)
    assert [f.message.frame_id for f in frames] == [0, 1, 2, 4, 5]
    assert not any(f.message.lossless for f in frames)
    assert not frames[0].camera.lossless
    assert play.result["drops"] == {"lost": 1}
    assert bench.metrics.drops == {"missing": 1}


def test_a_part_begins_with_number_0(bench, file):
    bench.begin_server()
    play = bench.play(file, start_s=0.035, end_s=0.085)
    frames = bench.take(play, count=3)
    assert [(f.message.frame_id, f.message.seq) for f in frames] == [(2, 0), (3, 1), (4, 2)]
    assert play.result["counts"]["sent"] == 3


def test_a_frame_on_its_way_when_a_part_begins_is_left_out(bench, tmp_path, codec):
    late = [
        (t_s + 0.03 * (getattr(m, "direction", "tx") == "rx"), m) for t_s, m in stream_of(codec)
    ]  # frame 1 arrives 51 ms after the first was sent, frame 2 is sent after 40 ms
    late.sort(key=lambda timed: timed[0])
    bench.begin_server()
    play = bench.play(write(tmp_path / "run.mcap", late), start_s=0.035)
    frames = bench.take(play)
    assert [f.message.frame_id for f in frames] == list(range(2, NUM_FRAMES))
    assert play.result["drops"] == {"stale": 1}


def test_what_another_agent_sent_is_left_out(bench, tmp_path, codec):
    another = [replace(rx, seq=rx.seq + 10) for _, rx in frames_of(codec)]
    file = write(tmp_path / "run.mcap", stream_of(codec), of_another=another)
    play = bench.play(file, wait=False)
    play.join(30)
    assert play.result["counts"]["played"] == NUM_FRAMES


def test_an_unreadable_message_is_told_once_and_another_agents_is_not(tmp_path, codec, caplog):
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = RecordingWriter(file, recording_metadata("", "test"))
        writer.add(camera_key(AGENT), "camera", EPOCH, 0, pack(camera_of(codec)))
        writer.add(rx_key("right"), "symbols", EPOCH, 0, b"junk")
        writer.add(rx_key(AGENT), "symbols", EPOCH, 0, b"junk")
        for count, (_, rx) in enumerate(frames_of(codec), start=1):
            writer.add(rx_key(AGENT), "symbols", EPOCH, count, pack(rx))
        writer.finish()
    settings = PlaySettings(file=path, wait=False, network=NetworkSettings(listen=(free_endpoint(),)))
    assert run_play(settings, threading.Event())["counts"]["played"] == NUM_FRAMES
    told = [r.getMessage() for r in caplog.records if "is left out" in r.getMessage()]
    assert len(told) == 1
    assert told[0].startswith(f"a message of {rx_key(AGENT)} in {path} is left out")


def test_a_part_that_holds_nothing_is_told_with_the_length_before_anybody_is_waited_for(file, capsys):
    assert main(["play", str(file), "--start-s", "5"]) == 1
    said = f"semcast play: nothing of {file} lies after 5 s: it is 0.1 s long\n"
    assert capsys.readouterr().err == said


def test_the_stream_asked_for_is_played_under_the_name_asked_for(tmp_path, codec):
    later = [(t_s + 1.0, m) for t_s, m in stream_of(codec, EPOCH + 10**9)]
    first = list(stream_of(codec, lost=(1,)))
    file = write(tmp_path / "run.mcap", first + later)
    for number, ids in ((1, [0, 2, 3, 4, 5]), (None, list(range(NUM_FRAMES)))):
        with contextlib.closing(Bench("left")) as bench:
            bench.begin_server()
            frames = bench.take(bench.play(file, stream=number, agent_id="left"))
            assert [f.message.frame_id for f in frames] == ids
            assert frames[0].camera.agent_id == "left"


def test_the_recorded_times_are_kept_at_a_pace(bench, tmp_path, codec):
    file = write(tmp_path / "run.mcap", stream_of(codec, period_s=10.0))
    began_s = time.monotonic()
    play = bench.play(file, pace=100.0, wait=False)
    play.join(40)
    assert play.result["complete"]
    assert 0.5 <= time.monotonic() - began_s < 40.0, "50 s, sped up"


def test_a_play_that_is_stopped_in_a_pause_ends_without_saying_that_it_was_all(bench, tmp_path, codec):
    play = bench.play(write(tmp_path / "run.mcap", stream_of(codec, period_s=50.0)), wait=False)
    until(lambda: bench.heard["source"], "the first frame")
    until(lambda: any(m.counts.get("played") for m in bench.messages("status/agent", StatusMessage)), "it")
    play.stop.set()
    play.join(30)
    assert not play.result["complete"]
    assert play.result["counts"]["played"] == 1
    assert not any(m.ended for m in bench.messages("status/agent", StatusMessage))


def test_a_clock_that_was_set_while_recording_holds_nothing_up(bench, tmp_path, codec):
    timed = list(stream_of(codec))
    half = len(timed) // 2
    year_s = 365 * 86400.0
    ahead = timed[:half] + [(t_s + year_s, m) for t_s, m in timed[half:]]
    back = timed[:half] + [(t_s - year_s, m) for t_s, m in timed[half:]]
    for name, moved in (("ahead", ahead), ("back", back)):
        play = bench.play(write(tmp_path / f"{name}.mcap", moved), pace=100.0, wait=False)
        play.join(30)
        assert play.result["counts"]["played"] == NUM_FRAMES


def test_a_recording_that_was_cut_off_is_played_to_where_it_goes(bench, tmp_path, codec, caplog):
    file = write(tmp_path / "run.mcap", list(stream_of(codec))[:-4], finish=False)
    bench.begin_server()
    play = bench.play(file)
    frames = bench.take(play, count=NUM_FRAMES - 1)
    assert [f.message.frame_id for f in frames] == list(range(NUM_FRAMES - 1))
    assert play.result["complete"], "nothing more is to come"
    assert "was cut off" in caplog.text


def test_a_damaged_recording_is_refused_before_anybody_is_waited_for(file):
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0xFF
    file.write_bytes(content)
    with pytest.raises(SourceError, match="is damaged: .*semcast recover"):
        run_play(PlaySettings(file=file), threading.Event())


def test_a_number_from_far_ahead_does_not_count_as_sent(bench, tmp_path, codec):
    timed = list(stream_of(codec))
    far = next(m for _, m in timed if isinstance(m, SymbolFrame) and m.seq == 2)
    timed.insert(len(timed) // 2, (0.05, replace(far, seq=2**40)))
    play = bench.play(write(tmp_path / "run.mcap", timed), wait=False)
    play.join(30)
    assert play.result["counts"]["sent"] == NUM_FRAMES


def test_a_second_play_under_a_name_warns_and_its_stream_is_the_one_followed(bench, tmp_path, codec, caplog):
    slow = write(tmp_path / "slow.mcap", stream_of(codec, period_s=20.0))
    file = write(tmp_path / "run.mcap", stream_of(codec))
    first = bench.play(slow, wait=False)
    until(lambda: bench.heard["source"], "the first stream")
    bench.begin_server()
    second = bench.play(file)
    frames = bench.take(second)
    assert "agent of 'agent0' is there already" in caplog.text
    assert frames[-1].message.agent_epoch == second.result["agent_epoch"]
    assert first.is_alive()


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"pace": 0.0}, r"pace must be in \[0.01, 100\], got 0"),
        ({"pace": float("nan")}, r"pace must be in \[0.01, 100\], got nan"),
        ({"start_s": -1.0}, "start_s must be at least 0 and finite, got -1"),
        ({"start_s": 2.0, "end_s": 1.0}, r"end_s must be later than start_s \(2\), got 1"),
        ({"agent_id": "a b"}, "agent_id must be 1 to 64 of"),
    ],
)
def test_settings_out_of_range_are_refused(tmp_path, given, text):
    with pytest.raises(ValueError, match=text):
        PlaySettings(file=tmp_path / "run.mcap", **given)
