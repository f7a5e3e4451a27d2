"""``semcast doctor``: check this machine and, if asked, a running system; every finding says what to do.

With ``--require`` it asks the system alone and answers in seconds, for what looks after services.
"""

import argparse
import importlib.metadata
import importlib.util
import platform
import socket
import sys
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rich.table import Table
from rich.text import Text

from semcast.commands.console import plain_console
from semcast.commands.paths import named_path
from semcast.common.cores import usable_cores
from semcast.common.errors import ConfigError, TransportError
from semcast.common.keys import DEFAULT_AGENT_ID
from semcast.common.messages import ROLES, StatusMessage
from semcast.common.metrics import frames_in_words
from semcast.common.network_settings import NetworkSettings
from semcast.server.view.process import rerun_binary, window_display

if TYPE_CHECKING:
    from semcast.common.transport import Session

Verdict = Literal["good", "note", "bad"]
_STYLE = {"good": "green", "note": "yellow", "bad": "red"}

#: package -> what cannot be done without it; the first group is needed everywhere.
_PACKAGES = {
    "numpy": "nothing runs",
    "opencv-python-headless": "nothing runs",
    "eclipse-zenoh": "nothing runs",
    "msgpack": "nothing runs",
    "torch": "no server, and no learned codec in an agent without onnxruntime (extra 'agent' or 'server')",
    "onnxruntime": "no learned codec in an agent without torch (extra 'edge')",
    "gtsam": "no bundle adjustment, so no server (extra 'server')",
    "rerun-sdk": "no viewer (extra 'server')",
    "poselib": "no two-view start, so no server (extra 'server')",
}

#: How long a system may take to answer.
_CONNECT_S = 2.0
#: role -> what it does to a frame, as it counts.
_EVENTS = {"agent": "sent", "channel": "carried", "server": "tracked"}


@dataclass(frozen=True)
class Finding:
    """One checked fact.

    Attributes:
        what: The thing looked at.
        verdict: ``good``, ``note`` (works with a limit) or ``bad`` (does not work).
        text: What was seen and, unless good, what to do.
    """

    what: str
    verdict: Verdict
    text: str


def check_python() -> Iterator[Finding]:
    """Check the interpreter's version."""
    version = platform.python_version()
    good = sys.version_info >= (3, 11)
    yield Finding(
        "python", "good" if good else "bad", version if good else f"{version}: 3.11 or newer is needed"
    )


def check_packages() -> Iterator[Finding]:
    """Check that each library is installed, and say what is lost without it."""
    for package, loss in _PACKAGES.items():
        try:
            yield Finding(package, "good", importlib.metadata.version(package))
        except importlib.metadata.PackageNotFoundError:
            verdict: Verdict = "bad" if loss == "nothing runs" else "note"
            yield Finding(package, verdict, f"not installed: {loss}")


def check_processor() -> Iterator[Finding]:
    """Check cores and the instructions that make convolutions fast."""
    cores = usable_cores()
    yield Finding(
        "cores",
        "good" if cores >= 2 else "note",
        f"{cores}" if cores >= 2 else "1: agent and server need one each",
    )
    if importlib.util.find_spec("torch") is None:
        return  # exported encoders compute in eight bits or fp32
    from semcast.common.nets.int8 import has_int8
    from semcast.common.nets.precision import has_fast_bfloat16

    if has_fast_bfloat16():
        yield Finding("bfloat16", "good", "in hardware: the networks run in it")
        return
    instead = "int8, slower" if has_int8() else "float32, slowest"
    yield Finding("bfloat16", "note", f"not in hardware: {instead}; use --resize 0.5 or a conventional codec")


def check_weights() -> Iterator[Finding]:
    """Load every codec as an agent would: a learned one on torch, or else on onnxruntime.

    In one thread: several take as long, and each spins while it waits for the others.
    """
    from semcast import SemcastError
    from semcast.common.codecs import available_codecs, load_codec

    for name in available_codecs():
        try:
            codec = load_codec(name, runtime="auto", num_threads=1)
            yield Finding(f"codec {name}", "good", f"digest {codec.digest}")
        except SemcastError as err:
            yield Finding(f"codec {name}", "note", str(err))


def check_viewer() -> Iterator[Finding]:
    """Check whether a window can be opened and the viewer program that a server starts is there."""
    if importlib.util.find_spec("rerun") is None:
        return
    try:
        yield Finding("rerun program", "good", str(rerun_binary()))
    except ConfigError as err:
        yield Finding("rerun program", "note", f"--view native and web can't start: {err}")
    display = window_display()
    if display is None:
        yield Finding("display", "note", "none: use --view web, or --view file and open run.rrd elsewhere")
    else:
        yield Finding("display", "good", display)


def check_port(port: int) -> Iterator[Finding]:
    """Check that the default port on loopback is free."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
            yield Finding(f"port {port}", "good", "free")
        except OSError:
            yield Finding(
                f"port {port}", "note", "in use: a system is running here, or choose another with --listen"
            )


def check_loopback() -> Iterator[Finding]:
    """Send one message through a real Zenoh session pair on loopback."""
    from semcast.common.loopback import loopback_round_trip_ms

    try:
        yield Finding("zenoh loopback", "good", f"{loopback_round_trip_ms():.1f} ms there and back")
    except TransportError as err:
        yield Finding("zenoh loopback", "bad", str(err))


def check_system(connect: str, agent_id: str, zenoh_config: Path | None = None) -> Iterator[Finding]:
    """Ask a running system which roles are alive, and what these say of themselves."""
    from semcast.common.status_beat import hear_statuses
    from semcast.common.transport import open_client

    try:
        with open_client(_network(connect, zenoh_config), _CONNECT_S) as session:
            roles = session.alive_roles(agent_id, _CONNECT_S)
            statuses = hear_statuses(session, agent_id, roles)
            others = _others(session, agent_id, roles)
    except TransportError as err:
        yield Finding(f"system at {connect}", "bad", str(err))
        return
    for role in ROLES:
        what = f"{role} ({agent_id})"
        if role in statuses:
            yield Finding(what, "note" if statuses[role].last_error else "good", _in_words(statuses[role]))
        elif role in roles:
            yield Finding(what, "note", "alive, but says nothing of itself: it hangs, or is just ending")
        else:
            yield Finding(what, "note", f"not seen: start it with '{_start(role, agent_id)}'")
    if others:
        yield Finding("other agents", "note", others)


def _start(role: str, agent_id: str) -> str:
    """Return the command that starts a role, short of what only its user knows."""
    named = "" if agent_id == DEFAULT_AGENT_ID else f" --agent-id {agent_id}"
    return f"semcast {role}{named}"


def _others(session: "Session", agent_id: str, roles: Collection[str]) -> str:
    """Name the agents that are there under other names, where a role of the one asked for is not seen."""
    others = [] if len(roles) == len(ROLES) else session.alive_agents(_CONNECT_S)
    names = [name for name in others if name != agent_id]
    return f"{', '.join(names)}: --agent-id says which of them is meant" if names else ""


def _in_words(status: StatusMessage) -> str:
    """Say what a role says of itself, its last error included."""
    event = _EVENTS[status.role]
    frames = frames_in_words(event, status.counts.get(event, 0), status.drops)
    rate_hz = status.rates_hz.get(event, 0.0)
    text = f"alive for {status.uptime_s:.0f} s, {rate_hz:.1f} frames a second, {frames}"
    text += f"; is at: {status.activity}" if status.activity else ""
    return text + (f"; last error: {status.last_error}" if status.last_error else "")


def _network(connect: str, zenoh_config: Path | None) -> NetworkSettings:
    """Return the way to a hub.

    Raises:
        TransportError: It is none.
    """
    try:
        return NetworkSettings(connect=(connect,), zenoh_config=zenoh_config)
    except ValueError as err:
        raise TransportError(str(err)) from err


def print_required(connect: str, agent_id: str, required: Iterable[str], zenoh_config: Path | None) -> int:
    """Print each role that is required and not alive, else those that are; exit code 1 where one is missing.

    Raises:
        TransportError: Nothing answers there.
    """
    from semcast.common.transport import open_client

    with open_client(_network(connect, zenoh_config), _CONNECT_S) as session:
        roles = session.alive_roles(agent_id, _CONNECT_S)
    missing = [role for role in required if role not in roles]
    for role in missing:
        plain_console().print(
            f"{role} ({agent_id}) is not seen: start it with '{_start(role, agent_id)}'", soft_wrap=True
        )
    if not missing:
        plain_console().print(f"alive ({agent_id}): {', '.join(required)}", soft_wrap=True)
    return 1 if missing else 0


def required_roles(text: str) -> tuple[str, ...]:
    """Take the names of roles for argparse.

    Raises:
        argparse.ArgumentTypeError: One is no role.
    """
    roles = tuple(text.split(","))
    if not set(roles) <= set(ROLES):
        raise argparse.ArgumentTypeError(f"must be some of {','.join(ROLES)}, got {text!r}")
    return roles


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--connect",
        metavar="ENDPOINT",
        help="also check a running system, such as tcp/127.0.0.1:7447: what its roles count, and last errors",
    )
    parser.add_argument(
        "--agent-id",
        default=DEFAULT_AGENT_ID,
        metavar="NAME",
        help=f"whose roles to look for (default {DEFAULT_AGENT_ID})",
    )
    parser.add_argument(
        "--require",
        type=required_roles,
        metavar="ROLES",
        help=f"only check that these of {','.join(ROLES)} are alive there; exit code 1 where one is not",
    )
    parser.add_argument(
        "--zenoh-config",
        type=named_path,
        metavar="PATH",
        help="file of Zenoh's own configuration (JSON5), where that system wants certificates or users",
    )


def run(arguments: argparse.Namespace) -> int:
    """Print all findings, or only whether required roles are alive; exit code 1 when one is bad."""
    if arguments.connect is None:
        for flag, value in (("--zenoh-config", arguments.zenoh_config), ("--require", arguments.require)):
            if value is not None:
                raise ConfigError(f"{flag} is of the system that --connect names, and there is none")
    elif arguments.require is not None:
        return print_required(
            arguments.connect, arguments.agent_id, arguments.require, arguments.zenoh_config
        )
    checks = [
        check_python(),
        check_packages(),
        check_processor(),
        check_weights(),
        check_viewer(),
        check_port(7447),
    ]
    checks.append(check_loopback())
    if arguments.connect is not None:
        checks.append(check_system(arguments.connect, arguments.agent_id, arguments.zenoh_config))
    table = Table(show_header=False, box=None, pad_edge=False)
    bad = False
    for check in checks:
        for finding in check:
            bad |= finding.verdict == "bad"
            table.add_row(Text(finding.verdict, style=_STYLE[finding.verdict]), finding.what, finding.text)
    plain_console().print(table)
    return 1 if bad else 0
