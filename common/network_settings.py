"""Where a process meets the others. One of them, the hub, listens; the others connect to it.

The hub is the server by default. It runs as a Zenoh router, the others as clients of it: so every process can
be killed and started again in any order, and only one port is open, on loopback. Peers that meet through a
common peer would not see each other, and a peer by default listens on all interfaces.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
#: A name or address, an IPv6 one best in brackets; ``::1`` alone is no address ``:`` with port 1.
_HOST = r"(\[[^\[\]\s]+\]|[^\[\]\s]*?[^\[\]\s:])"
_ENDPOINT = re.compile(rf"(tcp|udp|quic|tls|ws)/{_HOST}:(?P<port>\d+)([?#]\S*)?|unixsock-stream/\S+")
_MAX_PORT = 65535
_LOOPBACK = re.compile(r"\w+/(127\.\d+\.\d+\.\d+|localhost|\[::1\]):\d+.*|unixsock-stream/.*")


def is_loopback(endpoint: str) -> bool:
    """Tell whether an endpoint is reachable from this machine only."""
    return _LOOPBACK.fullmatch(endpoint) is not None


def check_endpoint(text: str) -> None:
    """Check that a text names an endpoint, with its port: Zenoh would try for ever to reach one without.

    Raises:
        ValueError: It does not.
    """
    found = _ENDPOINT.fullmatch(text)
    if found is None or not 1 <= int(found["port"] or 1) <= _MAX_PORT:
        raise ValueError(f"must be an endpoint such as {DEFAULT_ENDPOINT}, got {text!r}")


@dataclass(frozen=True, kw_only=True)
class NetworkSettings:
    """How a process that connects to the hub finds it.

    Raises:
        ValueError: An endpoint is not well formed, or there is none at all.
    """

    listen: tuple[str, ...] = field(
        default=(),
        metadata={
            "help": f"be the hub the others connect to, on these endpoints, such as {DEFAULT_ENDPOINT}",
            "takes": check_endpoint,
        },
    )
    connect: tuple[str, ...] = field(
        default=(DEFAULT_ENDPOINT,),
        metadata={"help": "endpoints of the hub to connect to", "takes": check_endpoint},
    )
    zenoh_config: Path | None = field(
        default=None,
        metadata={"help": "file of Zenoh's own configuration (JSON5), for certificates and users"},
    )

    def __post_init__(self) -> None:
        for name in ("listen", "connect"):
            for endpoint in getattr(self, name):
                try:
                    check_endpoint(endpoint)
                except ValueError as err:
                    raise ValueError(f"{name} {err}") from err
        if not self.listens_on and not self.connect:
            raise ValueError("listen or connect must name an endpoint, got neither")

    @property
    def listens_on(self) -> tuple[str, ...]:
        """Endpoints to listen on; a process with any is the hub."""
        return self.listen

    @property
    def where(self) -> str:
        """Say in words where the process is to be met."""
        if self.listens_on:
            return f"listening on {', '.join(self.listens_on)}"
        return f"connected to {', '.join(self.connect)}"


@dataclass(frozen=True, kw_only=True)
class HubSettings(NetworkSettings):
    """The same for the process that is the hub unless told to connect to one: the server."""

    listen: tuple[str, ...] = field(
        default=(),
        metadata={
            "help": "endpoints agent and channel connect to "
            f"(default {DEFAULT_ENDPOINT}, none with --connect)",
            "takes": check_endpoint,
        },
    )
    connect: tuple[str, ...] = field(
        default=(),
        metadata={
            "help": "endpoints of the hub to connect to instead; with --listen those of another Zenoh router "
            "to join",
            "takes": check_endpoint,
        },
    )

    @property
    def listens_on(self) -> tuple[str, ...]:
        """Endpoints to listen on: the default one where none is named to connect to either."""
        return self.listen if self.listen or self.connect else (DEFAULT_ENDPOINT,)
