"""Frames as they arrive at a receiver, and a client that plays agent and channel."""

import time

import numpy as np
from announced import announced_camera
from waiting import until

from semcast.channel.awgn import complex_noise
from semcast.common.keys import camera_key, rx_key
from semcast.common.loopback import open_hub
from semcast.common.messages import SymbolFrame
from semcast.common.metrics import Metrics
from semcast.common.network_settings import NetworkSettings
from semcast.common.phy.pilots import insert_pilots
from semcast.common.phy.qam import constellation
from semcast.common.symbol_payload import pack_iq, pack_lost
from semcast.common.transport import open_client
from semcast.common.wire import pack
from semcast.server.receiver import Receiver

HW = (64, 128)
EPOCH = 10**18


def camera(epoch=EPOCH, lossless=False):
    return announced_camera(agent_epoch=epoch, image_wh=(128, 64), lossless=lossless)


def sent_and_received():
    """Symbols of a frame of four slots, and what a little noise makes of them with their pilots."""
    rng = np.random.default_rng(1)
    symbols = constellation()[rng.integers(0, 16, (4, 47 * 8))]
    slots = insert_pilots(symbols)
    noise = complex_noise(slots.shape, np.full((4, 1), 0.01, np.float32), rng)
    return symbols, slots + noise


def frame_maker(received):
    """What makes frames of received slots, of which some are ``lost``."""

    def make_frame(seq, epoch=EPOCH, lost=(), **changes):
        mask = np.isin(np.arange(4), lost)
        values = {
            "agent_epoch": epoch, "seq": seq, "frame_id": 2 * seq, "t_capture_ns": time.monotonic_ns(),
            "t_source_ns": seq * 10**8, "codec": "x", "digest": "", "image_hw": HW, "modulation": "16qam",
            "num_slots": 4, "uses_per_slot": 48 * 8, "direction": "rx", "payload_format": "iq16",
            "payload": pack_iq(np.where(mask[:, None], 0, received)), "slot_lost": pack_lost(mask),
        }  # fmt: skip
        return SymbolFrame(**{**values, **changes})

    return make_frame


class Ends:
    """A receiver on a hub, and a client that plays agent and channel."""

    def __init__(self, mode, **changes):
        self.hub, self.endpoint = open_hub()
        self.metrics = Metrics("server")
        self.receiver = Receiver(self.hub, "a", mode, self.metrics, **changes)
        self.client = open_client(NetworkSettings(connect=(self.endpoint,)), 60)
        self.rx = self.client.publisher(rx_key("a"), "every")
        until(lambda: self.rx.has_receiver)

    def put(self, *frames):
        for frame in frames:
            self.rx.put(pack(frame))

    def answer_camera(self, info):
        data = pack(info)
        self.client.answer(camera_key("a"), lambda request: data)

    def close(self):
        self.receiver.close()
        self.client.close()
        self.hub.close()
