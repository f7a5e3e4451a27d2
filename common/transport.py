"""Zenoh sessions: who connects to whom, and the two services. The only home of ``zenoh``.

*Newest wins* for symbols and feedback: the sender drops under congestion, the receiver keeps the last few in
a ring that no Python code has to empty. *Every one* for poses, map, camera and lossless symbols: reliable, in
order, the sender waits. All payloads are bytes; what they mean is ``wire``'s business.
"""

import atexit
import contextlib
import errno
import json
import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, Self

import zenoh

from semcast.common.errors import ConfigError, TransportError
from semcast.common.keys import agent_of, alive_agents, alive_key, alive_keys, role_of
from semcast.common.messages import ROLES
from semcast.common.network_settings import NetworkSettings, is_loopback
from semcast.common.reachability import Knocks
from semcast.common.wire import MAX_MESSAGE_BYTES
from semcast.common.worker_guard import WorkerGuard

logger = logging.getLogger(__name__)

Service = Literal["newest", "every"]

#: A frozen or unreachable peer is noticed after this long.
LEASE_MS = 2000
RING_CAPACITY = 2
#: The same where frames come in: more than a lossless stream ever has under way.
FRAME_RING_CAPACITY = 16
_FIFO_CAPACITY = 64
_CONNECT_TRY_MS = 300
#: Where something answers, the next try may take twice as long: meeting takes several round trips, and over
#: a slow network these take longer than the first. After one of this length it is none of ours that answers.
_LONGEST_TRY_MS = 8 * _CONNECT_TRY_MS
#: Roles that are started together are there within a second, and a demo asks for one: neither need be told.
_TELL_AFTER_S = 1.0
#: How long it takes to tell who is gone: a hub that was frozen is met, lost and met again within milliseconds
#: when it goes on, and of one that ends clients hear first that the others are gone.
_LOST_AFTER_S = 0.2
#: How long a sender that drops under congestion waits for room first: half a frame's time at 30 a second.
#: A process on a busy machine waits for its turn for longer than the 1 ms that Zenoh gives it.
_WAIT_FOR_ROOM_US = 15_000
_JOIN_S = 2.0


def zenoh_config(network: NetworkSettings) -> zenoh.Config:
    """Return the configuration of a session: a router where it listens, else a client.

    Nothing is discovered or opened beyond the endpoints that are named. What a configuration file of Zenoh
    says about anything else, such as certificates, holds as well.

    Raises:
        ConfigError: That file can't be read or is not one.
    """
    config = zenoh.Config() if network.zenoh_config is None else _read_config(network.zenoh_config)
    hub = bool(network.listens_on)
    values: dict[str, Any] = {
        "mode": "router" if hub else "client",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": list(network.listens_on),
        "connect/endpoints": list(network.connect),
        # A client tries for a moment and reports failure, so that the caller can be stopped in between; once
        # connected it reconnects by itself. A hub goes on without the routers it was told of.
        "connect/timeout_ms": -1 if hub else _CONNECT_TRY_MS,
        "connect/exit_on_failure": not hub,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
        # Nothing is scouted, so opening need not wait half a second for what scouting finds.
        "open/return_conditions/connect_scouted": False,
        "scouting/delay": 0,
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": _WAIT_FOR_ROOM_US,
        "transport/link/rx/max_message_size": 2 * MAX_MESSAGE_BYTES,
        "transport/shared_memory/enabled": False,
    }
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _read_config(path: Path) -> zenoh.Config:
    try:
        return zenoh.Config.from_json5(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError) as err:
        raise ConfigError(f"zenoh_config {path} can't be read: {err}") from err
    except zenoh.ZError as err:
        raise ConfigError(f"zenoh_config {path} is no Zenoh configuration: {_in_a_line(err)}") from err


class Publisher:
    """Sends to one key."""

    def __init__(self, publisher: Any, key: str) -> None:
        self._publisher = publisher
        self._key = key

    def put(self, payload: bytes) -> None:
        """Send; without a connection the payload is lost, and the next ones go through again.

        Raises:
            TransportError: The session is closed.
        """
        try:
            self._publisher.put(payload)
        except zenoh.ZError as err:
            raise TransportError(f"{self._key} can't be sent: {err}") from err

    @property
    def has_receiver(self) -> bool:
        """Whether anybody subscribes to the key now."""
        try:
            return bool(self._publisher.matching_status.matching)
        except zenoh.ZError:
            return False


class _Pump:
    """A thread that hands over what a Zenoh channel holds, until the channel is closed."""

    def __init__(self, entity: Any, deliver: Callable[[Any], None], name: str) -> None:
        self._entity = entity
        # The entity itself must not be borrowed by the thread, or it could not be undeclared.
        self._handler = entity.handler
        self._deliver = deliver
        self._guard = WorkerGuard("handling a message")
        self._thread = threading.Thread(target=self._run, name=f"semcast-{name}", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while True:
            try:
                item = self._handler.recv()
            except zenoh.ZError:
                return
            with self._guard:
                self._deliver(item)

    def close(self) -> None:
        with contextlib.suppress(zenoh.ZError):
            self._entity.undeclare()
        if self._thread is not threading.current_thread():
            self._thread.join(_JOIN_S)


class Session:
    """A connection to the hub, or the hub itself. Closing ends all that was declared on it.

    A client that loses touch with its hub says so, and again when it is back, by itself and with all that was
    declared on it.
    """

    def __init__(self, session: Any, hub: str = "") -> None:
        """Take an open Zenoh session, a client's with the endpoints of its hub; use ``open_session``."""
        self._session = session
        self._hub = hub
        self._was_in_touch = True
        self._pumps: list[_Pump] = []
        self._tokens: list[Any] = []
        self._lock = threading.Lock()
        self._closing = threading.Event()
        # A thread still inside zenoh while the interpreter ends would abort the process.
        atexit.register(self.close)
        if hub:
            events: Any = zenoh.handlers.FifoChannel(_FIFO_CAPACITY)
            listener = session.info.declare_transport_events_listener(events)
            self._add(_Pump(listener, self._on_transport, "touch"))

    def _hubs(self) -> list[str]:
        """Name the hub a client is in touch with, by the name that each start of it has; of a hub none."""
        return [str(zid) for zid in self._session.info.routers_zid()] if self._hub else []

    def _on_transport(self, event: Any) -> None:
        """Say that touch with the hub was lost, or is back, as it is now: events may come in a burst."""
        if event.kind == zenoh.SampleKind.DELETE:
            self._closing.wait(_LOST_AFTER_S)
        in_touch = bool(self._hubs())
        if in_touch == self._was_in_touch or self._closing.is_set():
            return
        self._was_in_touch = in_touch
        if in_touch:
            logger.info("in touch with %s again", self._hub)
        else:
            logger.info("lost touch with %s: nothing is sent or heard until it is back", self._hub)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def _declare(self, declare: Callable[[], Any], what: str) -> Any:
        try:
            return declare()
        except zenoh.ZError as err:
            raise TransportError(f"{what} failed: {err}") from err

    def publisher(self, key: str, service: Service) -> Publisher:
        """Return a sender.

        Args:
            key: Where to.
            service: ``newest`` drops under congestion, ``every`` waits.

        Raises:
            TransportError: The session is closed.
        """
        control = zenoh.CongestionControl.DROP if service == "newest" else zenoh.CongestionControl.BLOCK
        declared = self._declare(
            lambda: self._session.declare_publisher(key, congestion_control=control, express=True),
            f"publishing {key}",
        )
        return Publisher(declared, key)

    def subscribe(
        self, key: str, service: Service, deliver: Callable[[bytes], None], capacity: int = RING_CAPACITY
    ) -> None:
        """Call ``deliver(payload)`` for what arrives, on a thread of its own, one at a time.

        Args:
            key: Key expression.
            service: ``newest``: while ``deliver`` is busy only the last ``capacity`` are kept. ``every``:
                all are kept; a ``deliver`` that takes long makes the sender wait.
            deliver: What it raises is logged, and the message left out.
            capacity: Messages that wait for ``deliver``.

        Raises:
            TransportError: The session is closed.
        """
        self._subscribe(key, service, lambda sample: deliver(sample.payload.to_bytes()), capacity)

    def subscribe_keyed(self, key: str, deliver: Callable[[str, bytes], None]) -> None:
        """Call ``deliver(key, payload)`` as ``subscribe`` does for every one: a key may match several."""
        self._subscribe(
            key,
            "every",
            lambda sample: deliver(str(sample.key_expr), sample.payload.to_bytes()),
            _FIFO_CAPACITY,
        )

    def _subscribe(self, key: str, service: Service, deliver: Callable[[Any], None], capacity: int) -> None:
        channel: Any = (
            zenoh.handlers.RingChannel(capacity)
            if service == "newest"
            else zenoh.handlers.FifoChannel(max(capacity, _FIFO_CAPACITY))
        )
        declared = self._declare(
            lambda: self._session.declare_subscriber(key, channel), f"subscribing to {key}"
        )
        self._add(_Pump(declared, deliver, f"sub-{key.rsplit('/', 1)[-1]}"))

    def answer(self, key: str, handle: Callable[[bytes], bytes | None]) -> None:
        """Answer requests on a key with ``handle(payload)``, on a thread of its own; None is no answer.

        Raises:
            TransportError: The session is closed.
        """

        def reply(query: Any) -> None:
            with query:
                answer = handle(query.payload.to_bytes() if query.payload is not None else b"")
                if answer is not None:
                    query.reply(key, answer)

        declared = self._declare(
            lambda: self._session.declare_queryable(key, zenoh.handlers.FifoChannel(_FIFO_CAPACITY)),
            f"answering on {key}",
        )
        self._add(_Pump(declared, reply, f"answer-{key.rsplit('/', 1)[-1]}"))

    def request(
        self,
        key: str,
        payload: bytes,
        timeout_s: float,
        is_wanted: Callable[[bytes], bool] = lambda answer: True,
    ) -> bytes | None:
        """Return the first answer to a request that is wanted, None when there was none in time.

        Raises:
            TransportError: The session is closed.
        """
        try:
            each = zenoh.ConsolidationMode.NONE  # by default one answer stands for those of all
            for reply in self._session.get(key, payload=payload, timeout=timeout_s, consolidation=each):
                if reply.ok is not None and is_wanted(answer := bytes(reply.ok.payload.to_bytes())):
                    return answer
        except zenoh.ZError as err:
            raise TransportError(f"request to {key} failed: {err}") from err
        return None

    def declare_alive(self, agent_id: str, role: str) -> None:
        """Show that a role is alive, until the session is closed or its process dies.

        Warns when there is one already: two agents of one name take the receiver from each other.

        Raises:
            TransportError: The session is closed.
        """
        if role in self.alive_roles(agent_id):
            logger.warning(
                "%s of %r is there already: stop one of the two or give it another --agent-id", role, agent_id
            )
        key = alive_key(agent_id, role)
        self._tokens.append(self._declare(lambda: self._session.liveliness().declare_token(key), key))

    def watch_alive(self, agent_id: str, on_change: Callable[[str, bool | None], None]) -> None:
        """Call ``on_change(role, alive)`` for every role alive now and for each that comes or goes.

        For a client that loses touch with its hub all others go: ``alive`` is None then, as nobody knows.

        Raises:
            TransportError: The session is closed.
        """
        declared = self._declare(
            lambda: self._session.liveliness().declare_subscriber(
                alive_keys(agent_id), zenoh.handlers.FifoChannel(_FIFO_CAPACITY), history=True
            ),
            f"watching {agent_id}",
        )
        hubs = self._hubs()

        def deliver(sample: Any) -> None:
            nonlocal hubs
            alive: bool | None = sample.kind == zenoh.SampleKind.PUT
            if alive:
                hubs = self._hubs()
            elif self._hub:
                self._closing.wait(_LOST_AFTER_S)
                now = self._hubs()
                alive = False if now and now == hubs else None
            on_change(role_of(str(sample.key_expr)), alive)

        self._add(_Pump(declared, deliver, "alive"))

    def alive_roles(self, agent_id: str, timeout_s: float = 1.0) -> set[str]:
        """Return the roles that are alive now.

        Raises:
            TransportError: The session is closed.
        """
        return {role_of(key) for key in self._alive(alive_keys(agent_id), timeout_s)} & set(ROLES)

    def alive_agents(self, timeout_s: float = 1.0) -> list[str]:
        """Return the names of all agents that are alive now, sorted.

        Raises:
            TransportError: The session is closed.
        """
        return sorted({agent_of(key) for key in self._alive(alive_agents(), timeout_s)})

    def _alive(self, keys: str, timeout_s: float) -> list[str]:
        try:
            replies = self._session.liveliness().get(keys, timeout=timeout_s)
            return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
        except zenoh.ZError as err:
            raise TransportError(f"asking who is alive failed: {err}") from err

    def _add(self, pump: _Pump) -> None:
        with self._lock:
            if not self._closing.is_set():
                self._pumps.append(pump)
                return
        pump.close()

    def close(self) -> None:
        """End threads, declarations and connections; ports are free again. Idempotent."""
        with self._lock:
            if self._closing.is_set():
                return
            self._closing.set()
            pumps, self._pumps = self._pumps, []
        atexit.unregister(self.close)
        for pump in pumps:
            pump.close()
        with contextlib.suppress(zenoh.ZError):
            self._session.close()


def open_session(
    network: NetworkSettings, stop: threading.Event | None = None, deadline_s: float | None = None
) -> Session | None:
    """Open a session; a client waits until its hub is there.

    Args:
        network: Endpoints.
        stop: Ends the waiting.
        deadline_s: Ends the waiting with an error; None waits for ever.

    Returns:
        None when ``stop`` was set before there was a connection.

    Raises:
        TransportError: The port is taken, or no hub was found in time.
        ConfigError: Zenoh's configuration file is not usable.
    """
    for endpoint in network.listens_on:
        if not is_loopback(endpoint) and network.zenoh_config is None:
            logger.warning("listening on %s: whoever reaches it can send and receive", endpoint)
    config = zenoh_config(network)
    if network.listens_on:
        try:
            return Session(zenoh.open(config))
        except zenoh.ZError as err:
            where = ", ".join(network.listens_on)
            hint = ", perhaps something already does" if _says_in_use(err) else ""
            raise TransportError(f"can't listen on {where}{hint}: {_in_a_line(err)}") from err
    started_s = time.monotonic()
    knocks, try_ms, told, told_why = Knocks(network.connect), _CONNECT_TRY_MS, False, False
    while stop is None or not stop.is_set():
        config.insert_json5("connect/timeout_ms", json.dumps(try_ms))
        try:
            return Session(zenoh.open(config), ", ".join(network.connect))
        except zenoh.ZError as err:
            answering = knocks.answering()
            # What has just begun to listen may be ours.
            why = _why_not_met(answering) if answering is not None and try_ms > _CONNECT_TRY_MS else ""
            unknown = "".join(f"; no address is known for {host!r}" for host in knocks.unknown_hosts)
            waited_s = time.monotonic() - started_s
            if deadline_s is not None and waited_s >= deadline_s:
                nothing = (
                    f"nothing answers at {', '.join(network.connect)} within {deadline_s:g} s{unknown}: is "
                    f"'semcast server' running there? ({_in_a_line(err)})"
                )
                raise TransportError(why or nothing) from err
            if not told and waited_s >= _TELL_AFTER_S:
                logger.info("waiting for the server at %s%s", ", ".join(network.connect), unknown)
                told = True
            if why and try_ms == _LONGEST_TRY_MS and not told_why:
                logger.warning("%s", why)
                told_why = True
            may_be_there = answering is not None or not knocks.all_can_be_asked
            try_ms = min(2 * try_ms, _LONGEST_TRY_MS) if may_be_there else _CONNECT_TRY_MS
            _pause(stop)
    return None


def _why_not_met(endpoint: str) -> str:
    return (
        f"something answers at {endpoint}, but not as a server of semcast would: is the protocol right (tcp, "
        "tls), and are certificates and users what both ends expect (--zenoh-config)? Or it hangs"
    )


def _pause(stop: threading.Event | None) -> None:
    if stop is None:
        time.sleep(0.1)
    else:
        stop.wait(0.1)


def _says_in_use(err: zenoh.ZError) -> bool:
    """Tell whether an address is taken: a port, or the lock of a socket file."""
    return f"os error {errno.EADDRINUSE}" in str(err) or "acquire lock: EAGAIN" in str(err)


def _in_a_line(err: Exception) -> str:
    line = " ".join(str(err).split(" at /", 1)[0].split())
    return line + "]" * (line.count("[") - line.count("]"))  # the cut may have taken the end of a list


def open_client(network: NetworkSettings, deadline_s: float) -> Session:
    """Open a session that connects to a hub, for a short errand.

    Raises:
        TransportError: No hub was found in time.
    """
    session = open_session(network, deadline_s=deadline_s)
    assert session is not None, "without a stop event there is a session or an error"
    return session
