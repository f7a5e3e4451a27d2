"""Hubs of one's own on loopback, each on a free port: for demonstrations, checks of a machine and tests."""

import socket
import time

from semcast.common.errors import TransportError
from semcast.common.network_settings import NetworkSettings
from semcast.common.transport import Session, open_client, open_session

#: Another program may take a port that was free a moment ago.
_ATTEMPTS = 5


def free_endpoint() -> str:
    """Return a loopback endpoint with a port that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def open_hub() -> tuple[Session, str]:
    """Open a hub on a free loopback port, and return it with its endpoint.

    Raises:
        TransportError: No port could be opened.
    """
    num_failed = 0
    while True:
        endpoint = free_endpoint()
        try:
            session = open_session(NetworkSettings(listen=(endpoint,), connect=()))
        except TransportError:
            num_failed += 1
            if num_failed == _ATTEMPTS:
                raise
            continue
        assert session is not None, "a hub does not wait"
        return session, endpoint


def loopback_round_trip_ms(timeout_s: float = 3.0) -> float:
    """Send a request through a hub and back, all in this process, and return how long it took.

    Raises:
        TransportError: It did not come back.
    """
    hub, endpoint = open_hub()
    with hub:
        network = NetworkSettings(connect=(endpoint,))
        with open_client(network, timeout_s) as asking, open_client(network, timeout_s) as answering:
            answering.answer("semcast/doctor/echo", lambda payload: payload)
            deadline_s = time.monotonic() + timeout_s
            while time.monotonic() < deadline_s:
                started_ns = time.perf_counter_ns()
                if asking.request("semcast/doctor/echo", b"there and back", 0.5) == b"there and back":
                    return (time.perf_counter_ns() - started_ns) * 1e-6
    raise TransportError(f"a request over loopback did not come back within {timeout_s:g} s")
