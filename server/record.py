"""Records everything a running system sends, beside it: nobody waits for the recorder."""

import contextlib
import logging
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from semcast import SourceError, TransportError, __version__
from semcast.common.config import to_toml
from semcast.common.errors import tell_nobody
from semcast.common.keys import DEFAULT_AGENT_ID, agent_of, all_keys, camera_key, check_agent_id
from semcast.common.messages import CameraInfo, StatusMessage
from semcast.common.network_settings import NetworkSettings
from semcast.common.recorder import Recorder
from semcast.common.recording_writer import recording_metadata
from semcast.common.transport import Session, open_session
from semcast.common.whole_file import check_writable
from semcast.common.wire import WireError, pack, unpack
from semcast.server.announcement import answered_camera

logger = logging.getLogger(__name__)

#: How often a recorder with nothing else to do looks whether it still records.
_LOOK_INTERVAL_S = 0.5
#: Starts of an agent whose cameras are noted: more are no agent's, and each would be remembered.
MAX_STREAMS = 1000
#: Name of the metadata record of a stream, followed by its epoch.
STREAM_METADATA = "semcast.stream"


@dataclass(frozen=True, kw_only=True)
class RecordSettings:
    """What is recorded, and where to.

    Raises:
        ValueError: The agent's name is not well formed.
    """

    file: Path = field(
        default=Path("run.mcap"), metadata={"help": "recording to write (MCAP)", "positional": True}
    )
    agent_id: str = field(default=DEFAULT_AGENT_ID, metadata={"help": "name of the agent to record"})
    network: NetworkSettings = field(default=NetworkSettings(), metadata={"help": "where the hub is"})

    def __post_init__(self) -> None:
        check_agent_id(self.agent_id)


def kind_of_key(key: str) -> str:
    """Return the kind of message a key carries: ``symbols`` for both directions, else the key's own word.

    Empty for one that ends with the agent's name, where only a stranger sends.
    """
    word = next(iter(key.split("/")[2:3]), "")
    return "symbols" if word in ("tx", "rx") else word


class StreamNotes:
    """Puts messages into a recording and, for each stream, what decodes it: a metadata record of its own.

    An agent announces its camera once, and maybe not to us: it was there before, or came back to a hub that
    was started again. Its status, once a second, tells of it too, and then it is asked.

    Args:
        recorder: Where to.
        ask: Returns the camera of a start of an agent, or of any where that is None; None without an answer.
    """

    def __init__(self, recorder: Recorder, ask: Callable[[str, int | None], CameraInfo | None]) -> None:
        self._recorder = recorder
        self._ask = ask
        self._epochs: set[int] = set()

    def put(self, key: str, payload: bytes) -> None:
        """Record a message that arrived under a key."""
        kind = kind_of_key(key)
        with contextlib.suppress(WireError):
            if kind == "camera":
                self._note(unpack(payload, CameraInfo))
            elif kind == "status":
                self._look_for_camera(key, unpack(payload, StatusMessage))
        self._recorder.put(key, kind, payload)

    def _look_for_camera(self, key: str, status: StatusMessage) -> None:
        is_new = status.agent_epoch not in self._epochs and len(self._epochs) < MAX_STREAMS
        if status.role == "agent" and is_new:
            self.put_camera(agent_of(key), status.agent_epoch)

    def put_camera(self, agent_id: str, agent_epoch: int | None = None) -> None:
        """Ask for the camera of an agent's start and record that; nothing happens where nobody answers."""
        camera = self._ask(agent_id, agent_epoch)
        if camera is not None:
            self.put(camera_key(agent_id), pack(camera))

    def _note(self, camera: CameraInfo) -> None:
        if camera.agent_epoch in self._epochs or len(self._epochs) >= MAX_STREAMS:
            return
        self._epochs.add(camera.agent_epoch)
        if len(self._epochs) == MAX_STREAMS:
            logger.warning("%d starts of agents are noted in the recording; of more no codec is", MAX_STREAMS)
        values = {
            "agent_id": camera.agent_id,
            "codec": camera.codec,
            "weights_digest": camera.digest,
            "modulation": camera.modulation,
            "source": camera.source_name,
            "image_wh": "{}x{}".format(*camera.image_wh),
        }
        self._recorder.add_metadata(f"{STREAM_METADATA}.{camera.agent_epoch}", values)


@contextlib.contextmanager
def recording(
    session: Session,
    agent_id: str,
    file: Path,
    settings_toml: str,
    on_error: Callable[[str], None] = tell_nobody,
    results: Path | None = None,
) -> Iterator[Recorder]:
    """Record all that is sent about one agent while the context lasts.

    Args:
        session: Open network session; what it sends itself is recorded too.
        agent_id: Whose stream.
        file: Recording to write; one that is there is kept under another name.
        settings_toml: Resolved settings of the program, kept in the recording.
        on_error: Is told at once, in a line, why the file can't be written any more.
        results: Folder of results that the recording leaves room for, or None.

    Raises:
        SourceError: The file can't be written, said before anything else; or it could not be written to its
            end, said when the context ends.
    """
    header = recording_metadata(settings_toml, __version__)
    with Recorder(file, header, results=results, on_error=on_error) as recorder:

        def ask(agent_id: str, agent_epoch: int | None) -> CameraInfo | None:
            with contextlib.suppress(TransportError):  # the session ends while we are at it
                return answered_camera(session, agent_id, agent_epoch)
            return None

        notes = StreamNotes(recorder, ask)
        session.subscribe_keyed(all_keys(agent_id), notes.put)
        notes.put_camera(agent_id)
        yield recorder
    if recorder.error is not None:
        raise SourceError(f"{file} is not complete: {recorder.error}")


def _warn_of_absence(session: Session, agent_id: str) -> None:
    """Say that there is nothing to record yet, and whose processes are there: the name may be a wrong one."""
    others = session.alive_agents()
    if agent_id not in others:
        there = f"; there are those of {', '.join(others)} (--agent-id)" if others else ""
        logger.warning("no process of agent '%s' is there yet%s", agent_id, there)


def run_record(settings: RecordSettings, stop: threading.Event) -> dict[str, Any]:
    """Record until ``stop`` is set.

    Returns:
        ``messages``, ``bytes`` and ``drops`` by reason.

    Raises:
        ConfigError: The file can't be written, said before anything is waited for.
        SourceError: It can't be written any more, as on a full disk.
        TransportError: The session failed.
    """
    check_writable(settings.file, "file")
    session = open_session(settings.network, stop)
    if session is None:
        return {"messages": 0, "bytes": 0, "drops": {}}
    with (
        session,
        recording(session, settings.agent_id, settings.file, to_toml(settings)) as recorder,
    ):
        _warn_of_absence(session, settings.agent_id)
        while not stop.wait(_LOOK_INTERVAL_S) and recorder.error is None:
            pass
    return {
        "messages": recorder.num_written,
        "bytes": recorder.bytes_written,
        "drops": dict(recorder.drops),
    }
