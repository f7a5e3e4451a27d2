import asyncio
import contextlib
import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest
from waiting import came_true, until

from semcast.common import transport
from semcast.common.errors import ConfigError, TransportError
from semcast.common.loopback import free_endpoint, loopback_round_trip_ms, open_hub
from semcast.common.network_settings import HubSettings, NetworkSettings, is_loopback
from semcast.common.transport import open_client, open_session, zenoh_config

pytestmark = pytest.mark.xdist_group("real-time")

HUB_PROGRAM = """
import sys, threading
from semcast.common.network_settings import NetworkSettings
from semcast.common.transport import open_session
session = open_session(NetworkSettings(listen=(sys.argv[1],), connect=()))
print("up", flush=True)
threading.Event().wait()
"""


def start_hub(endpoint):
    process = subprocess.Popen(
        [sys.executable, "-c", HUB_PROGRAM, endpoint], stdout=subprocess.PIPE, text=True
    )
    with process.stdout:
        assert process.stdout.readline() == "up\n"
    return process


def alive_roles(endpoint, agent_id, zenoh_config=None):
    with open_client(NetworkSettings(connect=(endpoint,), zenoh_config=zenoh_config), 2.0) as session:
        return session.alive_roles(agent_id)


@pytest.fixture
def pair(hub):
    network = NetworkSettings(connect=(hub[1],))
    with open_client(network, 60) as one, open_client(network, 60) as other:
        yield one, other


def test_two_clients_of_a_hub_reach_each_other_in_order(pair):
    sender, receiver = pair
    received = []
    receiver.subscribe("semcast/a/map", "every", received.append)
    publisher = sender.publisher("semcast/a/map", "every")
    until(lambda: publisher.has_receiver)
    sent = [bytes([k % 256]) * 1000 for k in range(300)]
    for payload in sent:
        publisher.put(payload)
    until(lambda: len(received) == 300)
    assert received == sent


def test_newest_wins_while_the_receiver_is_busy(pair):
    sender, receiver = pair
    received = []
    busy, go_on = threading.Event(), threading.Event()

    def deliver(payload):
        received.append(payload)
        busy.set()
        go_on.wait(10)

    receiver.subscribe("semcast/a/rx/symbols", "newest", deliver)
    arrived = []
    receiver.subscribe("semcast/a/rx/symbols", "every", arrived.append)
    publisher = sender.publisher("semcast/a/rx/symbols", "every")
    until(lambda: publisher.has_receiver)
    publisher.put(b"0")
    assert busy.wait(10)
    for k in range(1, 50):
        publisher.put(b"%d" % k)
    until(lambda: len(arrived) == 50)
    go_on.set()
    until(lambda: len(received) == 3)
    assert received == [b"0", b"48", b"49"]


def test_a_failing_handler_loses_its_message_only(pair, caplog):
    sender, receiver = pair
    received = []

    def deliver(payload):
        if payload == b"bad":
            raise ValueError("no good")
        received.append(payload)

    receiver.subscribe("semcast/a/pose", "every", deliver)
    publisher = sender.publisher("semcast/a/pose", "every")
    until(lambda: publisher.has_receiver)
    for payload in (b"bad", b"bad", b"good"):
        publisher.put(payload)
    until(lambda: received == [b"good"])
    assert [record.getMessage() for record in caplog.records] == ["handling a message failed: no good"]


def test_requests_are_answered_or_time_out(pair):
    asking, answering = pair
    answering.answer("semcast/a/camera", lambda payload: payload.upper())
    until(lambda: asking.request("semcast/a/camera", b"hello", 1.0) == b"HELLO")
    started_s = time.monotonic()
    assert asking.request("semcast/b/camera", b"hello", 0.5) is None
    assert time.monotonic() - started_s < 9.0, "Zenoh itself waits for 10 s"


def test_presence_is_seen_from_anywhere_and_ends_with_the_session(hub, pair):
    one, other = pair
    changes = []
    other.watch_alive("a", lambda role, alive: changes.append((role, alive)))
    hub[0].declare_alive("a", "server")
    with open_client(NetworkSettings(connect=(hub[1],)), 60) as third:
        third.declare_alive("a", "agent")
        until(lambda: one.alive_roles("a") == {"agent", "server"})
        assert one.alive_agents() == ["a"]
        assert alive_roles(hub[1], "a") == {"agent", "server"}
        assert alive_roles(hub[1], "b") == set()
    until(lambda: ("agent", False) in changes)
    assert alive_roles(hub[1], "a") == {"server"}


def test_a_second_agent_of_the_same_name_is_warned_of(pair, caplog):
    one, other = pair
    one.declare_alive("a", "agent")
    other.declare_alive("a", "channel")
    other.declare_alive("b", "agent")
    until(lambda: other.alive_roles("a") == {"agent", "channel"})
    assert not caplog.records
    other.declare_alive("a", "agent")
    assert "agent of 'a' is there already" in caplog.text


def test_clients_survive_a_hub_that_is_killed_and_say_so_once(caplog):
    caplog.set_level("INFO")
    endpoint = free_endpoint()
    network = NetworkSettings(connect=(endpoint,))

    def told():
        return [r.message for r in caplog.records if "touch" in r.message]

    process = start_hub(endpoint)
    try:
        with open_client(network, 60) as sender, open_client(network, 60) as receiver:
            received = []
            receiver.subscribe("semcast/a/rx/symbols", "newest", received.append)
            seen = []
            receiver.watch_alive("a", lambda role, alive: seen.append((role, alive)))
            sender.declare_alive("a", "agent")
            publisher = sender.publisher("semcast/a/rx/symbols", "newest")

            def passes():
                publisher.put(b"x")
                return bool(received)

            until(passes)
            process.kill()
            process.wait(10)
            until(lambda: not publisher.has_receiver)
            lost = f"lost touch with {endpoint}: nothing is sent or heard until it is back"
            until(lambda: told() == [lost] * 2)  # one of each client
            until(lambda: seen == [("agent", True), ("agent", None)])
            received.clear()
            publisher.put(b"into the void")
            process = start_hub(endpoint)
            started_s = time.monotonic()
            until(passes)
            assert time.monotonic() - started_s < 15.0
            assert alive_roles(endpoint, "a") == {"agent"}
            until(lambda: told() == [lost] * 2 + [f"in touch with {endpoint} again"] * 2)
        assert len(told()) == 4, "who closes has not lost touch"
    finally:
        process.kill()
        process.wait(10)


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="Windows can't freeze a process so")
def test_a_hub_that_was_frozen_is_lost_once_and_back_once(caplog):
    caplog.set_level("INFO")
    endpoint = free_endpoint()
    process = start_hub(endpoint)

    def told():
        return [r.message.split(" tcp/")[0] for r in caplog.records if "touch" in r.message]

    try:
        with open_client(NetworkSettings(connect=(endpoint,)), 60):
            process.send_signal(signal.SIGSTOP)
            until(lambda: told() == ["lost touch with"])
            process.send_signal(signal.SIGCONT)
            until(lambda: told() == ["lost touch with", "in touch with"])
            # It is met, lost and met again. What is told too often is told within this time.
            assert not came_true(lambda: len(told()) > 2, 2 * transport._LOST_AFTER_S)
    finally:
        process.kill()
        process.wait(10)
    assert told() == ["lost touch with", "in touch with"]


def test_a_client_waits_for_its_hub_until_it_is_stopped():
    stop = threading.Event()
    result = []
    network = NetworkSettings(connect=(free_endpoint(),))
    thread = threading.Thread(target=lambda: result.append(open_session(network, stop)))
    thread.start()
    stop.set()
    thread.join(60)
    assert result == [None]


def test_a_client_started_first_finds_a_hub_started_later():
    endpoint = free_endpoint()
    result = []
    thread = threading.Thread(
        target=lambda: result.append(open_session(NetworkSettings(connect=(endpoint,)), deadline_s=60))
    )
    thread.start()
    with open_session(NetworkSettings(listen=(endpoint,), connect=())) as hub:
        hub.declare_alive("a", "server")
        thread.join(60)
        assert "server" in result[0].alive_roles("a")
        result[0].close()


def test_nobody_there_and_a_port_in_use_are_said(hub):
    with pytest.raises(TransportError, match=r"nothing answers at tcp/127.0.0.1:\d+ within 0.2 s"):
        open_client(NetworkSettings(connect=(free_endpoint(),)), 0.2)
    with pytest.raises(TransportError, match="within 0.2 s; no address is known for 'a{70}': is 'semcast"):
        open_client(NetworkSettings(connect=(f"tcp/{'a' * 70}:7447",)), 0.2)
    with pytest.raises(TransportError, match=r"can't listen on tcp/.*perhaps something already") as taken:
        open_session(NetworkSettings(listen=(hub[1],), connect=()))
    assert str(taken.value).count("[") == str(taken.value).count("]")


def test_what_answers_but_is_no_hub_is_said_once(caplog, monkeypatch):
    monkeypatch.setattr("semcast.common.transport._LONGEST_TRY_MS", 600)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        network = NetworkSettings(connect=(f"tcp/127.0.0.1:{listening.getsockname()[1]}",))
        stop = threading.Event()
        waiting = threading.Thread(target=lambda: open_session(network, stop))
        with caplog.at_level("INFO"):
            waiting.start()
            until(lambda: "something answers at tcp/127.0.0.1" in caplog.text)
        with pytest.raises(
            TransportError, match=r"something answers at .* is the protocol right .* Or it hangs"
        ):
            open_client(network, 0.5)
        stop.set()
        waiting.join(60)
    assert caplog.text.count("something answers") == 1


def test_a_hub_behind_a_slow_network_is_met(hub):
    hub[0].declare_alive("a", "server")
    host, port = hub[1].removeprefix("tcp/").split(":")

    async def pass_on(reader, writer):
        with contextlib.suppress(OSError), contextlib.closing(writer):
            while received := await reader.read(65536):
                await asyncio.sleep(0.1)  # of the network, in each direction
                writer.write(received)
                await writer.drain()

    async def on_connection(reader, writer):
        far_reader, far_writer = await asyncio.open_connection(host, port)
        await asyncio.gather(pass_on(reader, far_writer), pass_on(far_reader, writer))

    async def meet():
        async with await asyncio.start_server(on_connection, "127.0.0.1", 0) as network:
            endpoint = f"tcp/127.0.0.1:{network.sockets[0].getsockname()[1]}"
            session = await asyncio.to_thread(open_client, NetworkSettings(connect=(endpoint,)), 60)
            assert "server" in await asyncio.to_thread(session.alive_roles, "a", 5)
            session.close()

    asyncio.run(meet())


def test_only_an_address_in_use_is_said_to_be_in_use(tmp_path):
    # An address kept for documentation (RFC 5737), which is no machine's.
    with pytest.raises(TransportError, match="^can't listen on tcp/192.0.2.1:7447: (?!.*in use)"):
        open_session(NetworkSettings(listen=("tcp/192.0.2.1:7447",), connect=()))
    socket_file = NetworkSettings(listen=(f"unixsock-stream/{tmp_path / 'hub'}",), connect=())
    with (
        open_session(socket_file),
        pytest.raises(TransportError, match="can't listen on unixsock-.*perhaps something already does"),
    ):
        open_session(socket_file)


def test_a_program_that_forgets_to_close_still_ends_cleanly():
    program = (
        "from semcast.common.loopback import open_hub\n"
        "session, _ = open_hub()\n"
        "session.subscribe('semcast/a/pose', 'every', print)\n"
        "session.watch_alive('a', print)\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")


def test_closing_frees_port_and_threads():
    before = threading.active_count()
    session, endpoint = open_hub()
    session.subscribe("semcast/a/pose", "every", lambda payload: None)
    session.answer("semcast/a/camera", lambda payload: payload)
    session.watch_alive("a", lambda role, alive: None)
    assert threading.active_count() > before
    session.close()
    session.close()
    until(lambda: threading.active_count() == before)
    with pytest.raises(TransportError):
        session.publisher("semcast/a/pose", "every")
    with open_session(NetworkSettings(listen=(endpoint,), connect=())):
        pass


def test_sessions_open_nothing_beyond_what_is_named():
    client = zenoh_config(NetworkSettings())
    assert client.get_json("mode") == '"client"'
    assert client.get_json("connect/endpoints") == '["tcp/127.0.0.1:7447"]'
    hub = zenoh_config(HubSettings())
    assert hub.get_json("mode") == '"router"'
    assert hub.get_json("listen/endpoints") == '["tcp/127.0.0.1:7447"]'
    for config in (client, hub):
        assert config.get_json("scouting/multicast/enabled") == "false"
        assert config.get_json("scouting/gossip/enabled") == "false"
        assert config.get_json("transport/link/tx/lease") == "2000"
        # A process that waits for a core must not cost a frame; half a frame's time at most, though.
        wait_us = config.get_json("transport/link/tx/queue/congestion_control/drop/wait_before_drop")
        assert 10_000 <= int(wait_us) <= 17_000
        assert config.get_json("transport/shared_memory/enabled") == "false"


def test_endpoints_are_checked():
    with pytest.raises(
        ValueError, match="connect must be an endpoint such as tcp/127.0.0.1:7447, got 'local"
    ):
        NetworkSettings(connect=("localhost:7447",))
    for endpoint in (
        "tcp/127.0.0.1",
        "tcp/127.0.0.1:",
        "tcp/127.0.0.1:99999",
        "tls/host:port",
        "tcp/::1",
        "tcp/127.0.0.1:0",
        "tcp/[::1",
        "tcp/::1]:7447",
        "unixsock-stream/",
    ):
        with pytest.raises(ValueError, match=f"listen must be an endpoint .*, got '{re.escape(endpoint)}'"):
            NetworkSettings(listen=(endpoint,))
    for endpoint in (
        "tcp/[::1]:7447",
        "tcp/::1:7447",
        "udp/host:1?rel=1",
        "tcp/0.0.0.0:7447#iface=eth0",
        "unixsock-stream/a:b",
    ):
        assert NetworkSettings(connect=(endpoint,)).connect == (endpoint,)
    with pytest.raises(ValueError, match="listen or connect must name an endpoint"):
        NetworkSettings(connect=())
    assert all(map(is_loopback, ("tcp/127.0.0.1:1", "tcp/localhost:1", "tcp/[::1]:1", "tls/127.3.2.1:5")))
    assert not any(
        map(is_loopback, ("tcp/0.0.0.0:1", "tcp/192.168.0.1:1", "tcp/[::]:1", "tcp/127.0.0.1.x:1"))
    )


def test_listening_beyond_loopback_is_warned_about(caplog):
    with open_session(NetworkSettings(listen=(free_endpoint().replace("127.0.0.1", "0.0.0.0"),), connect=())):
        assert "whoever reaches it can send and receive" in caplog.text


def test_a_round_trip_over_loopback_takes_milliseconds():
    assert 0.0 < loopback_round_trip_ms(60.0) < 500.0


def test_a_hub_with_users_lets_only_them_in(tmp_path):
    (tmp_path / "users.txt").write_text("alice:secret\n")

    def file(name, **usrpwd):
        path = tmp_path / name
        path.write_text(json.dumps({"transport": {"auth": {"usrpwd": usrpwd}}}))
        return path

    endpoint = free_endpoint()
    hub = file("hub.json5", dictionary_file=str(tmp_path / "users.txt"))
    alice, mallory = file("a.json5", user="alice", password="secret"), file("m.json5", user="m", password="x")
    with open_session(NetworkSettings(listen=(endpoint,), connect=(), zenoh_config=hub)):
        with open_client(NetworkSettings(connect=(endpoint,), zenoh_config=alice), 60) as session:
            session.declare_alive("a", "agent")
            assert alive_roles(endpoint, "a", alice) == {"agent"}
        for stranger in (mallory, None):
            with pytest.raises(TransportError, match="something answers at .* users"):
                open_client(NetworkSettings(connect=(endpoint,), zenoh_config=stranger), 0.6)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_endpoints_stay_as_they_were_asked_for(tmp_path, encoding):
    path = tmp_path / "all.json5"
    path.write_text('{mode: "peer", listen: {endpoints: ["tcp/0.0.0.0:7000"]}} // JSON5', encoding)
    config = zenoh_config(NetworkSettings(connect=("tcp/127.0.0.1:7447",), zenoh_config=path))
    assert config.get_json("mode") == '"client"'
    assert config.get_json("listen/endpoints") == "[]"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "can't be read"),
        ("hello", "no Zenoh configuration: --> 1:1 .* = expected array"),
        ("{", "no Zenoh configuration"),
        ("{tarnsport: 1}", "no Zenoh configuration"),
    ],
)
def test_a_bad_configuration_of_zenoh_is_one_clear_line(tmp_path, content, message):
    path = tmp_path / "z.json5"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ConfigError, match=rf"zenoh_config .*z\.json5.* {message}") as raised:
        zenoh_config(NetworkSettings(zenoh_config=path))
    assert "\n" not in str(raised.value)


def test_of_two_that_answer_a_request_each_can_be_heard():
    hub, endpoint = open_hub()
    with hub, contextlib.ExitStack() as stack:
        for answer in (b"0", b"1"):
            client = stack.enter_context(open_client(NetworkSettings(connect=(endpoint,)), 60))
            client.answer("semcast/a/camera", lambda request, answer=answer: answer)
            deadline_s = time.monotonic() + 10.0
            while hub.request("semcast/a/camera", b"", 1.0, lambda got, answer=answer: got == answer) is None:
                assert time.monotonic() < deadline_s
        for answer in (b"0", b"1"):
            assert (
                hub.request("semcast/a/camera", b"", 5.0, lambda got, answer=answer: got == answer) == answer
            )
