"""Records everything a running system sends, beside it: nobody waits for the recorder."""

import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from semcast import __version__
from semcast.common.config import to_toml
from semcast.common.keys import DEFAULT_AGENT_ID, all_keys, camera_key, check_agent_id
from semcast.common.network_settings import NetworkSettings
from semcast.common.recorder import Recorder
from semcast.common.recording import recording_metadata
from semcast.common.transport import open_session

CAMERA_TIMEOUT_S = 0.5


@dataclass(frozen=True, kw_only=True)
class RecordSettings:
    """What is recorded, and where to.

    Raises:
        ValueError: The agent's name is not well formed.
    """

    file: Path = field(default=Path("run.mcap"), metadata={"help": "recording to write (MCAP)"})
    agent_id: str = field(default=DEFAULT_AGENT_ID, metadata={"help": "name of the agent to record"})
    network: NetworkSettings = field(default=NetworkSettings(), metadata={"help": "where the hub is"})

    def __post_init__(self) -> None:
        check_agent_id(self.agent_id)


def kind_of_key(key: str) -> str:
    """Return the kind of message a key carries: ``symbols`` for both directions, else the key's own word."""
    word = key.split("/")[2]
    return "symbols" if word in ("tx", "rx") else word


def run_record(settings: RecordSettings, stop: threading.Event) -> dict[str, Any]:
    """Record until ``stop`` is set.

    Returns:
        ``messages``, ``bytes`` and ``drops`` by reason.

    Raises:
        SourceError: The file can't be written.
        TransportError: The session failed.
    """
    session = open_session(settings.network, stop)
    if session is None:
        return {"messages": 0, "bytes": 0, "drops": {}}
    header = recording_metadata(to_toml(settings), __version__)
    with session, Recorder(settings.file, header) as recorder:

        def take(key: str, payload: bytes) -> None:
            recorder.put(key, kind_of_key(key), payload)

        session.subscribe_keyed(all_keys(settings.agent_id), "every", take)
        # The camera was announced before we came.
        camera = session.request(camera_key(settings.agent_id), b"", CAMERA_TIMEOUT_S)
        if camera is not None:
            take(camera_key(settings.agent_id), camera)
        stop.wait()
    return {
        "messages": recorder.num_written,
        "bytes": recorder.bytes_written,
        "drops": dict(recorder.drops),
    }
