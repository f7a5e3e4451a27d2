"""A recording of the demo's first frames, and how it is replayed without depth."""

import contextlib
import threading
import time
from pathlib import Path

from semcast.agent.agent import run_agent
from semcast.agent.settings import AgentSettings
from semcast.agent.source_settings import SourceSettings
from semcast.channel.emulator import run_channel
from semcast.channel.emulator_settings import EmulatorSettings
from semcast.channel.settings import ChannelSettings
from semcast.common.loopback import open_hub
from semcast.common.metrics import Metrics
from semcast.common.network_settings import NetworkSettings
from semcast.server.receiver import Receiver
from semcast.server.record import RecordSettings, run_record
from semcast.server.replay import ReplaySettings

SEQUENCE = Path(__file__).resolve().parents[2] / "deploy" / "demo" / "kitti_06"
FRAMES = 10


def record_demo(path):
    """Record a stream beside a running agent and channel, of which a slow machine loses nothing either."""
    hub, endpoint = open_hub()
    network = NetworkSettings(connect=(endpoint,))
    stop = threading.Event()
    radio = EmulatorSettings(network=network, link=ChannelSettings(snr_db=15.0))
    others = [
        threading.Thread(target=run_channel, args=(radio, stop)),
        threading.Thread(target=run_record, args=(RecordSettings(file=path, network=network), stop)),
    ]
    for thread in others:
        thread.start()
    source = SourceSettings(source=str(SEQUENCE), resize=0.4, max_frames=FRAMES, pace="receiver")
    agent = AgentSettings(
        source=source, mode="replay", codec="jpeg-ldpc", share_source="png", network=network
    )
    with contextlib.closing(Receiver(hub, "agent0", "replay", Metrics("server"))) as receiver:
        hub.declare_alive("agent0", "server")
        sender = threading.Thread(target=run_agent, args=(agent, stop))
        sender.start()
        end_s = time.monotonic() + 60.0
        is_last = False
        while not is_last:
            assert time.monotonic() < end_s
            if (frame := receiver.next(0.05)) is not None:
                receiver.done(frame.message)
                is_last = frame.message.final
        sender.join(20)
    stop.set()
    for thread in others:
        thread.join(20)
    hub.close()


def without_depth(file, **changes):
    """Settings of a replay that leaves out depth, which takes longer than all else of it."""
    return ReplaySettings(file=file, dense_cloud="none", **changes)
