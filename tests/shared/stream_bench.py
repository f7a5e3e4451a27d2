"""Agents and channels in threads at one hub, and what a receiver takes of them."""

import threading
import time

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


class Thread(threading.Thread):
    """A process function in a thread, with its own stop event and its result."""

    def __init__(self, work):
        super().__init__()
        self.stop = threading.Event()
        self.result = None
        self.error = None
        self._work = work
        self.start()

    def run(self):
        try:
            self.result = self._work(self.stop)
        except Exception as err:
            self.error = err

    def end(self):
        self.stop.set()
        self.join(60)
        assert not self.is_alive()


class Bench:
    """A hub with agents and channels in threads."""

    def __init__(self, recording, codec):
        self.recording, self.codec = recording, codec
        self.hub, self.endpoint = open_hub()
        self.network = NetworkSettings(connect=(self.endpoint,))
        self.metrics = Metrics("server")
        self.threads = []
        self.receivers = []

    def agent(self, mode="live", source=None, **changes):
        pace = {"pace": "receiver"} if mode == "replay" else {}
        source = SourceSettings(source=str(self.recording), **{**pace, **(source or {})})
        settings = AgentSettings(source=source, mode=mode, network=self.network, **changes)
        return self._thread(lambda stop: run_agent(settings, stop, self.codec))

    def channel(self, **link):
        settings = EmulatorSettings(link=ChannelSettings(**link), network=self.network)
        return self._thread(lambda stop: run_channel(settings, stop))

    def _thread(self, work):
        self.threads.append(Thread(work))
        return self.threads[-1]

    def receiver(self, mode="live"):
        self.receivers.append(Receiver(self.hub, "agent0", mode, self.metrics))
        self.hub.declare_alive("agent0", "server")
        return self.receivers[-1]

    def close(self):
        for thread in self.threads:
            thread.end()
        for receiver in self.receivers:
            receiver.close()
        self.hub.close()


def take(receiver, count=None, deadline_s=60.0, pause_s=0.0):
    """Take frames until the final one, or so many."""
    frames = []
    end_s = time.monotonic() + deadline_s
    tick = threading.Event()
    while time.monotonic() < end_s:
        frame = receiver.next(0.05)
        if frame is None:
            for epoch in list(receiver._cameras):  # what a server says once its decoder is loaded
                receiver.announce_ready(epoch)
        else:
            frames.append(frame)
            receiver.done(frame.message)
            if frame.message.final or len(frames) == count:
                return frames
            tick.wait(pause_s)
    raise AssertionError(f"only {len(frames)} frames came: {[f.message.frame_id for f in frames]}")
