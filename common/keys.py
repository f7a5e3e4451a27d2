"""Key expressions. Nobody else builds them."""

import re

from semcast.common.messages import AGENT_ID_PATTERN, ROLES

_ROOT = "semcast"

DEFAULT_AGENT_ID = "agent0"
#: An agent that is there says within this time, when asked on ``camera_key``, what its camera is.
CAMERA_TIMEOUT_S = 0.5


def check_agent_id(agent_id: str) -> str:
    """Return the agent's name, which is one part of every key.

    Raises:
        ValueError: It has other characters than letters, digits, ``-`` and ``_``, or more than 64.
    """
    if re.fullmatch(AGENT_ID_PATTERN, agent_id) is None:
        raise ValueError(
            f"agent_id must be 1 to 64 of A-Z, a-z, 0-9, '-' and '_', the first no sign, got {agent_id!r}"
        )
    return agent_id


def _check_role(role: str) -> str:
    if role not in ROLES:
        raise ValueError(f"role must be one of {', '.join(ROLES)}, got {role!r}")
    return role


def _key(agent_id: str, rest: str) -> str:
    return f"{_ROOT}/{check_agent_id(agent_id)}/{rest}"


def camera_key(agent_id: str) -> str:
    """``CameraInfo``: put at the agent's start, and a queryable for whoever comes later."""
    return _key(agent_id, "camera")


def tx_key(agent_id: str) -> str:
    """``SymbolFrame`` from agent to channel."""
    return _key(agent_id, "tx/symbols")


def source_key(agent_id: str) -> str:
    """``SourceImage`` from agent to recorders; it does not cross the channel."""
    return _key(agent_id, "source")


def rx_key(agent_id: str) -> str:
    """``SymbolFrame`` from channel to server."""
    return _key(agent_id, "rx/symbols")


def link_key(agent_id: str) -> str:
    """``LinkReport`` from server to agent."""
    return _key(agent_id, "link")


def flow_key(agent_id: str) -> str:
    """``FlowMessage`` from server to agent."""
    return _key(agent_id, "flow")


def channel_key(agent_id: str) -> str:
    """``ChannelReport`` from channel to viewers."""
    return _key(agent_id, "channel")


def pose_key(agent_id: str) -> str:
    """``PoseMessage``."""
    return _key(agent_id, "pose")


def metric_pose_key(agent_id: str) -> str:
    """``MetricPose``, where the metre is known."""
    return _key(agent_id, "metric_pose")


def map_key(agent_id: str) -> str:
    """``MapMessage``: what changed, and a queryable that gives the whole map to whoever comes late."""
    return _key(agent_id, "map")


def status_key(agent_id: str, role: str) -> str:
    """``StatusMessage`` of one role."""
    return _key(agent_id, f"status/{_check_role(role)}")


def status_keys(agent_id: str) -> str:
    """Key expression that matches the statuses of all roles."""
    return _key(agent_id, "status/*")


def control_key(agent_id: str, role: str) -> str:
    """Queryable of one role: ``ControlRequest`` and ``ControlReply``."""
    return _key(agent_id, f"control/{_check_role(role)}")


def alive_key(agent_id: str, role: str) -> str:
    """Liveliness token of one role."""
    return _key(agent_id, f"alive/{_check_role(role)}")


def alive_keys(agent_id: str) -> str:
    """Key expression that matches the liveliness tokens of all roles."""
    return _key(agent_id, "alive/*")


def alive_agents() -> str:
    """Key expression that matches the liveliness tokens of all agents."""
    return f"{_ROOT}/*/alive/agent"


def agent_of(key: str) -> str:
    """Return the agent's name in a key; empty in one that names none, of another tool's recording perhaps."""
    parts = key.split("/")
    return parts[1] if len(parts) > 2 and re.fullmatch(AGENT_ID_PATTERN, parts[1]) is not None else ""


def all_keys(agent_id: str) -> str:
    """Key expression that matches everything of one agent but liveliness, for recording."""
    return _key(agent_id, "**")


def role_of(key: str) -> str:
    """Return the role in a key that ends in one: ``alive_key``, ``status_key``, ``control_key``."""
    return key.rsplit("/", 1)[-1]
