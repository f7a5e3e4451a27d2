"""Agent and channel as processes of their own that are killed and started again."""

import os
import signal
import subprocess
import sys
import time

import pytest
from waiting import until

from semcast.common.loopback import free_endpoint
from semcast.common.metrics import Metrics
from semcast.common.network_settings import NetworkSettings
from semcast.common.transport import open_session
from semcast.server.receiver import Receiver
from tests.agent.test_stream import take

pytestmark = pytest.mark.xdist_group("real-time")

PROGRAM = """
import dataclasses, signal, sys, threading
stop = threading.Event()
signal.signal(signal.SIGTERM, lambda *_: stop.set())
from semcast.common.network_settings import NetworkSettings
network = NetworkSettings(connect=(sys.argv[2],))
if sys.argv[1] == "agent":
    from semcast.agent.agent import run_agent
    from semcast.agent.settings import AgentSettings
    from semcast.agent.source_settings import SourceSettings
    source = SourceSettings(source=sys.argv[3], repeat="loop")
    run_agent(AgentSettings(source=source, codec="jpeg-ldpc", network=network), stop)
else:
    from semcast.channel.emulator import run_channel
    from semcast.channel.emulator_settings import EmulatorSettings
    run_channel(EmulatorSettings(network=network), stop)
print("ended", flush=True)
"""


def test_real_processes_survive_each_others_death_in_any_order(recording):
    endpoint = free_endpoint()
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    running = {}

    def start(role):
        running[role] = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, role, endpoint, str(recording)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip

    def serve():
        hub = open_session(NetworkSettings(listen=(endpoint,), connect=()))
        receiver = Receiver(hub, "agent0", "live", Metrics("server"))
        hub.declare_alive("agent0", "server")
        return hub, receiver

    try:
        # The server comes last, and is still found.
        start("agent")
        start("channel")
        hub, receiver = serve()
        epoch = take(receiver, count=3)[-1].message.agent_epoch
        for role in ("channel", "agent"):
            running[role].kill()
            running[role].communicate(timeout=60)
            until(lambda role=role: role not in receiver.roles_alive)
            start(role)
            until(lambda role=role: role in receiver.roles_alive)
            frames = take(receiver, count=3)
        assert frames[-1].message.agent_epoch > epoch
        receiver.close()
        hub.close()
        hub, receiver = serve()
        started_s = time.monotonic()
        take(receiver, count=1)
        assert time.monotonic() - started_s < 10.0
        for process in running.values():
            process.send_signal(signal.SIGTERM)
            assert process.communicate(timeout=60) == ("ended\n", "")
            assert process.returncode == 0
        receiver.close()
        hub.close()
    finally:
        for process in running.values():
            process.kill()
            process.communicate()
