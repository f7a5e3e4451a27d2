"""A channel that runs in a thread, for who talks to it."""

import threading
import time
from contextlib import contextmanager

from semcast.channel.emulator import run_channel
from semcast.channel.emulator_settings import EmulatorSettings
from semcast.channel.settings import ChannelSettings
from semcast.common.loopback import open_hub
from semcast.common.network_settings import NetworkSettings


@contextmanager
def running_channel():
    """The endpoint of a running channel with long bursts, of agent "a"."""
    hub, endpoint = open_hub()
    stop = threading.Event()
    link = ChannelSettings(burst_slots=20.0)
    settings = EmulatorSettings(agent_id="a", link=link, network=NetworkSettings(connect=(endpoint,)))
    thread = threading.Thread(target=run_channel, args=(settings, stop))
    thread.start()
    end_s = time.monotonic() + 15.0
    while "channel" not in hub.alive_roles("a"):
        assert time.monotonic() < end_s, "the channel did not start"
    yield endpoint
    stop.set()
    thread.join(60)
    hub.close()
