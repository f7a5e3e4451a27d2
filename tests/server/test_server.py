"""The server over real loopback Zenoh: an agent's stream in, poses and files out."""

import contextlib
import hashlib
import json
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from semcast.agent.agent import camera_info
from semcast.agent.settings import AgentSettings
from semcast.agent.source import RecordedSource
from semcast.agent.source_settings import SourceSettings
from semcast.common.codec import DecodedImage, EncodedImage
from semcast.common.codecs import load_codec
from semcast.common.errors import SemcastError
from semcast.common.keys import camera_key, control_key, flow_key, pose_key, rx_key
from semcast.common.messages import (
    ControlReply,
    ControlRequest,
    FlowMessage,
    PoseMessage,
    SymbolFrame,
)
from semcast.common.network_settings import NetworkSettings
from semcast.common.phy.pilots import insert_pilots
from semcast.common.phy.slots import layout_for
from semcast.common.run_folder import read_run
from semcast.common.sequence import open_sequence
from semcast.common.symbol_payload import pack_iq, pack_lost
from semcast.common.trajectory import read_tum
from semcast.common.transport import open_client, open_hub
from semcast.common.wire import pack, unpack
from semcast.server.export.outputs import read_ply, write_ply
from semcast.server.mapping.bundle_process import GIVEN_UP
from semcast.server.server import Server
from semcast.server.settings import ServerSettings, ViewSettings

DEMO = Path(__file__).resolve().parents[2] / "deploy" / "demo" / "kitti_06"
RESIZE = 0.5
AGENT = "cam0"
DEADLINE_S = 60.0


class IndexCodec:
    """Sends a picture's number in the signs of its symbols; the receiver has the pictures."""

    name = "index"
    digest = hashlib.sha256(b"index").hexdigest()[:16]

    def __init__(self, pictures):
        self.pictures = pictures

    def encode_number(self, number, shape_hw):
        layout = layout_for(shape_hw)
        signs = np.array([1 - 2 * (number >> bit & 1) for bit in range(8)], np.complex64)
        symbols = np.resize(signs, (layout.num_slots, layout.data_per_slot)).astype(np.complex64)
        return EncodedImage(shape_hw, symbols, "16qam")

    def decode(self, received):
        arrived = received.effective_snr_db > -10
        height, width = received.shape_hw
        confidence = np.full((height, width), 0.9, np.float32)
        if not arrived.any():
            return DecodedImage(np.full((height, width, 3), 127, np.uint8), confidence * 0, outage=True)
        row = received.symbols[arrived][0].real
        bits = [row[bit::8].sum() < 0 for bit in range(8)]
        number = sum(int(bit) << k for k, bit in enumerate(bits))
        return DecodedImage(self.pictures(number), confidence)


@pytest.fixture(scope="module")
def sequence():
    return open_sequence(DEMO, resize=RESIZE, max_frames=24)


@pytest.fixture(scope="module")
def pictures(sequence):
    images = [sequence.image(k) for k in range(len(sequence))]
    return lambda number: images[number]


class Radio:
    """Agent and channel in one: what a server hears."""

    def __init__(self, endpoint, sequence, codec, epoch, *, lossless=False):
        self.sequence, self.codec, self.epoch, self.lossless = sequence, codec, epoch, lossless
        self.session = open_client(NetworkSettings(connect=(endpoint,)), DEADLINE_S)
        settings = AgentSettings(
            agent_id=AGENT, mode="replay" if lossless else "live", source=SourceSettings(source=str(DEMO))
        )
        self.camera = camera_info(settings, RecordedSource(sequence, settings.source), codec, epoch)
        self.poses, self.changed = [], threading.Condition()
        self.allowed = 0
        self.session.answer(camera_key(AGENT), lambda request: pack(self.camera))
        self.session.subscribe(pose_key(AGENT), "every", self._on_pose)
        self.session.subscribe(flow_key(AGENT), "newest", self._on_flow)
        self.session.declare_alive(AGENT, "agent")
        self._symbols = self.session.publisher(rx_key(AGENT), "every")
        self._announce = self.session.publisher(camera_key(AGENT), "every")
        self.announce()

    def announce(self):
        self._announce.put(pack(self.camera))

    def _on_pose(self, payload):
        with self.changed:
            self.poses.append(unpack(payload, PoseMessage))
            self.changed.notify_all()

    def _on_flow(self, payload):
        flow = unpack(payload, FlowMessage)
        with self.changed:
            if flow.agent_epoch in (0, self.epoch):
                self.allowed = max(self.allowed, flow.next_seq + flow.window)
            self.changed.notify_all()

    def wait(self, condition, what):
        with self.changed:
            assert self.changed.wait_for(condition, DEADLINE_S), f"not within {DEADLINE_S} s: {what}"

    def posed_ids(self):
        return [p.frame_id for p in self.poses if p.agent_epoch == self.epoch]

    def send(self, k, picture=None, **changes):
        shape_hw = self.sequence.size_wh[::-1]
        layout = layout_for(shape_hw)
        slots = insert_pilots(self.codec.encode_number(k if picture is None else picture, shape_hw).symbols)
        rng = np.random.default_rng(k)
        noise = rng.normal(0, 0.1, (*slots.shape, 2)).astype(np.float32).view(np.complex64)[..., 0]
        values = {
            "agent_epoch": self.epoch,
            "seq": k,
            "frame_id": k,
            "t_capture_ns": time.monotonic_ns(),
            "t_source_ns": int(self.sequence.times_ns[k]),
            "codec": self.codec.name,
            "digest": self.codec.digest,
            "image_hw": shape_hw,
            "modulation": "16qam",
            "num_slots": layout.num_slots,
            "uses_per_slot": layout.uses_per_slot,
            "direction": "rx",
            "payload_format": "iq16",
            "payload": pack_iq(slots + noise),
            "slot_lost": pack_lost(np.zeros(layout.num_slots, bool)),
            "lossless": self.lossless,
            "final": k == len(self.sequence) - 1,
        }
        self._symbols.put(pack(SymbolFrame(**{**values, **changes})))

    def stream(self, ids, **changes):
        """Send frames one by one, each when the one before was answered."""
        for k in ids:
            if self.lossless:
                self.wait(lambda k=k: self.allowed > k, f"room for frame {k}")
                self.send(k, **changes)
            else:
                self.send(k, **changes)
                self.wait(lambda k=k: k in self.posed_ids(), f"an answer to frame {k}")

    def ask(self, op):
        answer = self.session.request(control_key(AGENT, "server"), pack(ControlRequest(op=op)), DEADLINE_S)
        return unpack(answer, ControlReply)

    def close(self):
        self.session.close()


def centre(pose):
    return np.array(pose.T_world_cam)[[3, 7, 11]]


class Running:
    """A server on its own thread."""

    def __init__(self, hub, codec, load=None, **settings):
        values = {"agent_id": AGENT, "view": ViewSettings(view="none"), "bundle": "inline"}
        self.settings = ServerSettings(**{**values, **settings})
        self.stop = threading.Event()
        self.summary, self.error = None, None
        self.server = Server(self.settings, hub, load or (lambda name, modulation: codec))
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self):
        try:
            self.summary = self.server.run(self.stop)
        except Exception as err:
            self.error = err

    def wait_for_drop(self, reason):
        deadline_s = time.monotonic() + DEADLINE_S
        while not self.server._metrics.drops.get(reason):
            assert time.monotonic() < deadline_s, f"no {reason} within {DEADLINE_S} s"
            self.stop.wait(0.01)

    def finish(self, *, stop=False):
        if stop:
            self.stop.set()
        self.thread.join(DEADLINE_S)
        assert not self.thread.is_alive()
        self.server.close()
        if self.error is not None:
            raise self.error
        return self.summary


@pytest.fixture
def hub():
    session, endpoint = open_hub()
    yield session, endpoint
    session.close()


def test_a_lossless_stream_leaves_every_promised_file_and_repeats_bit_for_bit(tmp_path, sequence, pictures):
    trajectories = []
    for run in ("a", "b"):
        session, endpoint = open_hub()
        codec, out = IndexCodec(pictures), tmp_path / run
        running = Running(
            session, codec, mode="replay", out=out, reference=DEMO, view=ViewSettings(view="file")
        )
        radio = Radio(endpoint, sequence, codec, 100, lossless=True)
        radio.stream(range(24))
        summary = running.finish()
        radio.close()
        session.close()
        trajectories.append((out / "trajectory.tum").read_bytes())
        assert summary["frames"]["tracked"] == 24
        assert summary["completeness"] >= 0.9
        assert summary["ate_percent"] < 5.0
        assert summary["psnr_db"] == 100.0, "the pictures are exact"
        assert json.loads((out / "summary.json").read_text())["frames"] == summary["frames"]
        assert len(read_tum(out / "trajectory.tum")) == summary["num_posed"]
        assert len(read_ply(out / "map.ply")) == summary["num_landmarks"] > 50
        assert len(read_run(out).frame_ids) == summary["num_posed"]
        assert (out / "run.rrd").stat().st_size > 10_000
        assert "[reconstruction]" in (out / "settings.toml").read_text()
        answered = radio.posed_ids()
        assert set(answered) == set(range(24))
    assert trajectories[0] == trajectories[1]


def test_bad_frames_are_counted_and_never_stop_the_stream(hub, sequence, pictures):
    session, endpoint = hub
    codec = IndexCodec(pictures)
    running = Running(session, codec)
    radio = Radio(endpoint, sequence, codec, 100)
    radio.stream([0, 1])
    radio._symbols.put(b"\x93garbage")
    radio.send(2, digest="0" * 16)
    running.wait_for_drop("codec")  # live: a newer frame would replace it unseen
    layout = layout_for(sequence.size_wh[::-1])
    radio.send(3, slot_lost=pack_lost(np.ones(layout.num_slots, bool)))
    running.wait_for_drop("outage")
    radio.stream([4, 5])
    summary = running.finish(stop=True)
    assert summary["drops"]["protocol"] == 1
    assert summary["drops"]["codec"] == 1
    assert summary["drops"]["outage"] == 1
    assert summary["frames"]["tracked"] == 4
    radio.close()


def test_a_restarted_agent_begins_a_new_map_and_the_former_run_is_kept(tmp_path, hub, sequence, pictures):
    session, endpoint = hub
    codec = IndexCodec(pictures)
    running = Running(session, codec, out=tmp_path)
    first = Radio(endpoint, sequence, codec, 100)
    first.stream(range(8))
    first.close()
    second = Radio(endpoint, sequence, codec, 200)
    second.stream(range(4))
    summary = running.finish(stop=True)
    second.close()
    assert summary["frames"]["tracked"] == 4
    former = json.loads((tmp_path / "previous-1" / "summary.json").read_text())
    assert former["frames"]["tracked"] == 8
    assert len((tmp_path / "previous-1" / "frames.jsonl").read_text().splitlines()) == 8
    assert len((tmp_path / "frames.jsonl").read_text().splitlines()) == 4


def test_a_restarted_server_goes_on_with_the_map_of_its_checkpoint(tmp_path, sequence, pictures):
    codec = IndexCodec(pictures)
    session, endpoint = open_hub()
    running = Running(session, codec, out=tmp_path, checkpoint_interval_s=0.1)
    radio = Radio(endpoint, sequence, codec, 100)
    radio.stream(range(16))
    before = {p.frame_id: p for p in radio.poses if p.T_world_cam is not None}
    assert len(before) > 10
    running.finish(stop=True)
    radio.close()
    session.close()
    (tmp_path / "summary.json").unlink()

    session, endpoint = open_hub()
    radio = Radio(endpoint, sequence, codec, 100)
    running = Running(session, codec, out=tmp_path)
    for k in range(16, 24):  # the camera turns back and sees what it saw before
        radio.send(k, picture=30 - k)
        radio.wait(lambda k=k: k in radio.posed_ids(), f"an answer to frame {k}")
    summary = running.finish()
    radio.close()
    session.close()
    after = {p.frame_id: p for p in radio.poses if p.T_world_cam is not None}
    assert summary["resumed"]
    assert summary["frames"]["tracked"] == 24
    assert len(after) >= 6
    # The same world: a place seen again has the place it had before the restart.
    step = np.linalg.norm(centre(before[14]) - centre(before[13]))
    for k in after:
        assert np.linalg.norm(centre(after[k]) - centre(before[30 - k])) < 0.5 * step


def test_another_agent_epoch_does_not_inherit_the_checkpoint(tmp_path, sequence, pictures):
    codec = IndexCodec(pictures)
    for epoch in (100, 200):
        session, endpoint = open_hub()
        running = Running(session, codec, out=tmp_path, checkpoint_interval_s=0.1)
        radio = Radio(endpoint, sequence, codec, epoch)
        radio.stream(range(6))
        summary = running.finish(stop=True)
        radio.close()
        session.close()
        assert not summary["resumed"]
        assert summary["frames"]["tracked"] == 6


def test_control_requests_reset_and_save(tmp_path, hub, sequence, pictures):
    session, endpoint = hub
    codec = IndexCodec(pictures)
    running = Running(session, codec, out=tmp_path)
    radio = Radio(endpoint, sequence, codec, 100)
    radio.stream(range(10))

    epoch = radio.poses[-1].map_epoch
    assert radio.ask("get").settings["mode"] == "live"
    assert not radio.ask("explode").ok
    assert radio.ask("save").ok
    deadline = time.monotonic() + DEADLINE_S
    while not (tmp_path / "map.ply").exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert not (tmp_path / "summary.json").exists()
    assert radio.ask("reset").ok
    radio.stream(range(10, 14))
    assert radio.poses[-1].map_epoch == epoch + 1
    running.finish(stop=True)
    radio.close()


def test_a_save_that_fails_is_answered_and_the_stream_goes_on(
    tmp_path, hub, sequence, pictures, caplog, monkeypatch
):
    monkeypatch.setattr("semcast.server.server.SERVE_WAIT_S", DEADLINE_S)
    session, endpoint = hub
    codec = IndexCodec(pictures)
    (tmp_path / "map.ply").mkdir()
    running = Running(session, codec, out=tmp_path)
    radio = Radio(endpoint, sequence, codec, 100)
    radio.stream([0, 1])
    reply = radio.ask("save")
    assert not reply.ok
    assert reply.error.startswith(f"outputs can't be written to {tmp_path}: ")
    assert "map.ply" in reply.error
    assert reply.error in caplog.text
    assert running.server._metrics.status(100).last_error == reply.error
    radio.stream([2, 3])
    with pytest.raises(SemcastError, match="map.ply"):
        running.finish(stop=True)
    radio.close()


def test_a_former_start_that_cannot_be_written_does_not_stop_the_new_one(
    tmp_path, hub, sequence, pictures, caplog, monkeypatch
):
    def full(path, *rest):
        if path.parent.name == "previous-1":
            raise OSError(28, "No space left on device")
        write_ply(path, *rest)

    monkeypatch.setattr("semcast.server.session.write_ply", full)
    session, endpoint = hub
    codec = IndexCodec(pictures)
    running = Running(session, codec, out=tmp_path)
    for epoch, num_frames in ((100, 6), (200, 4)):
        radio = Radio(endpoint, sequence, codec, epoch)
        radio.stream(range(num_frames))
        radio.close()
    assert running.finish(stop=True)["frames"]["tracked"] == 4
    former = tmp_path / "previous-1"
    assert f"outputs can't be written to {former}: [Errno 28] No space left on device" in caplog.text
    assert len((former / "frames.jsonl").read_text().splitlines()) == 6, "what was written is kept"
    assert len((tmp_path / "frames.jsonl").read_text().splitlines()) == 4
    assert running.server._metrics.counts["errors"] == 1


def test_a_new_start_that_cannot_be_written_is_kept_in_memory(tmp_path, hub, sequence, pictures, caplog):
    session, endpoint = hub
    codec = IndexCodec(pictures)
    running = Running(session, codec, out=tmp_path, bundle="process")
    first = Radio(endpoint, sequence, codec, 100)
    first.stream(range(6))
    first.close()
    (tmp_path / "frames.jsonl.part").mkdir()
    second = Radio(endpoint, sequence, codec, 200)
    second.stream(range(4))
    second.close()
    assert running.finish(stop=True)["frames"]["tracked"] == 4
    assert "frames.jsonl can't be written" in caplog.text
    assert json.loads((tmp_path / "summary.json").read_text())["frames"]["tracked"] == 4
    assert not (tmp_path / "frames.jsonl").exists()


def test_a_late_frame_of_the_former_start_does_not_end_the_new_one(tmp_path, hub, sequence, pictures):
    session, endpoint = hub
    codec = IndexCodec(pictures)
    running = Running(session, codec, out=tmp_path)
    first = Radio(endpoint, sequence, codec, 100)
    first.stream(range(4))
    second = Radio(endpoint, sequence, codec, 200)
    second.wait(lambda: second.allowed > 0, "the server is ready for the new start")
    first.send(4)
    running.wait_for_drop("epoch")
    second.stream(range(4))
    summary = running.finish(stop=True)
    first.close()
    second.close()
    assert summary["frames"]["tracked"] == 4
    assert summary["drops"]["epoch"] == 1
    assert not (tmp_path / "previous-2").exists()


def test_a_former_start_that_goes_on_sending_is_taken_up_again(hub, sequence, pictures, monkeypatch):
    monkeypatch.setattr("semcast.server.server.STRAGGLER_NS", 0)
    session, endpoint = hub
    codec = IndexCodec(pictures)
    running = Running(session, codec)
    first = Radio(endpoint, sequence, codec, 100)
    first.stream(range(4))
    second = Radio(endpoint, sequence, codec, 200)
    second.wait(lambda: second.allowed > 0, "the server is ready for the new start")
    second.close()
    first.stream(range(4, 8))
    assert running.finish(stop=True)["frames"]["tracked"] == 4
    first.close()


def test_a_start_with_an_earlier_clock_is_followed_after_a_silence(hub, sequence, pictures, monkeypatch):
    monkeypatch.setattr("semcast.server.arrival._SILENCE_NS", 0)
    session, endpoint = hub
    codec = IndexCodec(pictures)
    running = Running(session, codec)
    for epoch, num_frames in ((200, 4), (100, 6)):
        radio = Radio(endpoint, sequence, codec, epoch)
        radio.stream(range(num_frames))
        radio.close()
    assert running.finish(stop=True)["frames"]["tracked"] == 6


def test_a_bundle_adjustment_that_gave_up_is_in_the_status(hub):
    session, _ = hub
    running = Running(session, None, bundle="process", duration_s=0.1)
    running.server._spare_bundle._give_up()
    assert running.server._metrics.status(0).last_error == GIVEN_UP
    running.finish()


def test_a_server_that_hears_nothing_ends_with_its_time_limit(hub):
    session, _ = hub
    running = Running(session, None, duration_s=0.2)
    assert running.finish() == {}


def test_a_silent_stream_ends_with_the_idle_limit_and_its_outputs(tmp_path, hub, sequence, pictures):
    session, endpoint = hub
    codec = IndexCodec(pictures)
    running = Running(session, codec, out=tmp_path, idle_timeout_s=0.3)
    radio = Radio(endpoint, sequence, codec, 100)
    radio.stream(range(3))
    assert running.finish()["frames"]["tracked"] == 3
    assert (tmp_path / "summary.json").exists()
    radio.close()


def test_a_server_decodes_with_weights_of_ones_own(tiny_weights):
    hub, _ = open_hub()
    own = load_codec(str(tiny_weights))
    settings = ServerSettings(agent_id=AGENT, bundle="inline", codec=str(tiny_weights))
    with hub, contextlib.closing(Server(settings, hub)) as server:
        decoder = server._decoder
        assert decoder.codec_for("3dcsc", "16qam", own.digest).digest == own.digest
        with pytest.raises(SemcastError, match="or give both the same weights"):
            decoder.codec_for("3dcsc", "16qam", load_codec("3dcsc").digest)
        shipped = load_codec("3dcsc-lite").digest
        assert decoder.codec_for("3dcsc-lite", "16qam", shipped).digest == shipped
