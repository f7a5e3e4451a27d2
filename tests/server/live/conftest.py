"""A server on real loopback Zenoh, and agents that send it pictures of which it gets exactly these."""

import contextlib
import hashlib
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from waiting import until

from semcast.agent.agent import camera_info
from semcast.agent.settings import AgentSettings
from semcast.agent.source import RecordedSource
from semcast.agent.source_settings import SourceSettings
from semcast.common.codec import DecodedImage, EncodedImage
from semcast.common.keys import camera_key, control_key, flow_key, pose_key, rx_key
from semcast.common.loopback import open_hub
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
from semcast.common.sequence import open_sequence
from semcast.common.symbol_payload import pack_iq, pack_lost
from semcast.common.transport import open_client
from semcast.common.wire import pack, unpack
from semcast.server.server import Server
from semcast.server.settings import ServerSettings
from semcast.server.view.settings import ViewSettings

DEMO = Path(__file__).resolve().parents[3] / "deploy" / "demo" / "kitti_06"
RESIZE = 0.5
AGENT = "cam0"
DEADLINE_S = 60.0


class IndexCodec:
    """Sends a picture's number in the signs of its symbols; the receiver has the pictures."""

    name, modulation = "index", "16qam"
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


class Running:
    """A server on its own thread."""

    def __init__(self, hub, codec, load=None, **settings):
        # Without depth, which takes longer than all else of a run; on a busy machine no frame gets too old.
        values = {
            "agent_id": AGENT,
            "bundle": "inline",
            "dense_cloud": "none",
            "max_age_ms": 1e3 * DEADLINE_S,
        }
        values["view"] = ViewSettings(view="none")
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
        until(lambda: self.server.metrics.drops.get(reason), f"a drop by reason {reason}")

    def end(self):
        self.stop.set()
        self.thread.join(DEADLINE_S)
        self.server.close()

    def finish(self, *, stop=False):
        if stop:
            self.stop.set()
        self.thread.join(DEADLINE_S)
        assert not self.thread.is_alive()
        self.server.close()
        if self.error is not None:
            raise self.error
        return self.summary


class Air:
    """A network with one server at a time and any agents; ends what is left at its end."""

    def __init__(self, sequence, pictures):
        self.sequence, self.codec = sequence, IndexCodec(pictures)
        self.session, self.endpoint = open_hub()
        self.agents, self.servers = [], []

    def serve(self, **settings):
        self.servers.append(Running(self.session, self.codec, **settings))
        return self.servers[-1]

    def agent(self, epoch, *, lossless=False):
        self.agents.append(Radio(self.endpoint, self.sequence, self.codec, epoch, lossless=lossless))
        return self.agents[-1]

    def close(self):
        for agent in self.agents:
            agent.close()
        for running in self.servers:
            running.end()
        self.session.close()


@pytest.fixture(scope="session")
def sequence():
    return open_sequence(DEMO, resize=RESIZE, max_frames=24)


@pytest.fixture(scope="session")
def pictures(sequence):
    images = [sequence.image(k) for k in range(len(sequence))]
    return lambda number: images[number]


@pytest.fixture
def open_air(sequence, pictures):
    """Return a context in which there is a network."""

    @contextlib.contextmanager
    def opened():
        with contextlib.closing(Air(sequence, pictures)) as air:
            yield air

    return opened


@pytest.fixture
def air(open_air):
    with open_air() as opened:
        yield opened
