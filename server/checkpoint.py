"""Map checkpoints: what a restarted server needs to go on with the same map.

One uncompressed ``.npz`` (a zip of plain arrays with a CRC each, read without pickle), replaced atomically.
"""

import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import CheckpointError, tell_nobody
from semcast.common.mailbox import Mailbox
from semcast.common.npz_file import read_npz, write_npz
from semcast.server.stream_identity import StreamIdentity

logger = logging.getLogger(__name__)

FORMAT = 1
MAX_BYTES = 2 * 1024**3
_MAP = "map."


@dataclass(frozen=True)
class CheckpointHeader:
    """What the map belongs to.

    Attributes:
        agent_id: The camera's name.
        agent_epoch: Start of the agent that sent the frames; a restarted agent is another one.
        codec_digest: Digest of the codec that decoded them.
        camera: Intrinsics of the decoded images.
        frame_id: Newest frame in the map; frames up to it are not processed again.
        t_source_ns: Recorded time of that frame.
        map_epoch: Counts new maps within one run.
        drops: Frames of the stream that were left out up to then, by reason.
    """

    agent_id: str
    agent_epoch: int
    codec_digest: str
    camera: Intrinsics
    frame_id: int
    t_source_ns: int
    map_epoch: int
    drops: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, identity: StreamIdentity, **rest: Any) -> Self:
        """Return the header of a map of a stream; ``rest`` is what the stream's identity does not tell."""
        return cls(**_owner(identity), **rest)


def _owner(identity: StreamIdentity) -> dict[str, Any]:
    """Return the fields of a header that say whose map it is."""
    return {
        "agent_id": identity.agent_id,
        "agent_epoch": identity.agent_epoch,
        "codec_digest": identity.digest,
        "camera": identity.camera,
    }


@dataclass(frozen=True)
class Checkpoint:
    """A map with what it belongs to; ``arrays`` is what ``Reconstruction.restore`` takes."""

    header: CheckpointHeader
    arrays: dict[str, NDArray[Any]]


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint so that at any moment the file is the old one or the new one, whole.

    Raises:
        CheckpointError: An array needs pickling, or the file can't be written.
    """
    for name, array in checkpoint.arrays.items():
        if not isinstance(array, np.ndarray) or array.dtype.hasobject:
            raise CheckpointError(
                f"checkpoint array {name!r} must be a plain array, got {type(array).__name__}"
            )
    header = {"format": FORMAT, **asdict(checkpoint.header)}
    header["camera"] = checkpoint.header.camera.to_dict()
    content = {_MAP + name: array for name, array in checkpoint.arrays.items()}
    try:
        write_npz(path, header, content, compressed=False, durable=True)
    except OSError as err:
        raise CheckpointError(f"{path} can't be written: {err}") from err


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint; never executes what is in the file.

    Raises:
        CheckpointError: The file is missing, damaged, too large or of another format.
    """
    try:
        header, arrays = read_npz(path, MAX_BYTES)
    except OSError as err:
        raise CheckpointError(f"{path} can't be read as a checkpoint: {err}") from err
    except ValueError as err:
        raise CheckpointError(f"{path} can't be read as a checkpoint: it {err}") from err
    if header.pop("format", None) != FORMAT:
        raise CheckpointError(f"{path} is a checkpoint of another version of semcast")
    try:
        header["camera"] = Intrinsics.from_dict(header["camera"])
        header["drops"] = {str(reason): int(num) for reason, num in header.get("drops", {}).items()}
        maps = {name.removeprefix(_MAP): array for name, array in arrays.items() if name.startswith(_MAP)}
        return Checkpoint(CheckpointHeader(**header), maps)
    except Exception as err:  # what is in place of a field fails in many ways
        raise CheckpointError(f"{path} can't be read as a checkpoint: {err}") from err


def mismatch(header: CheckpointHeader, wanted: Mapping[str, Any]) -> str | None:
    """Return why a checkpoint does not belong to a stream, or None when it does.

    Args:
        header: Of the checkpoint.
        wanted: Header fields with the values of the stream.
    """
    for name, value in wanted.items():
        found = getattr(header, name)
        if found != value:
            return f"{name} is {found!r}, the stream has {value!r}"
    return None


def checkpoint_of(identity: StreamIdentity, path: Path) -> Checkpoint | None:
    """Read the checkpoint of a stream; None where there is none, or one of another stream, which is told.

    Raises:
        CheckpointError: See ``load_checkpoint``.
    """
    if not path.exists():
        return None
    checkpoint = load_checkpoint(path)
    reason = mismatch(checkpoint.header, _owner(identity))
    if reason is not None:
        logger.info("a new map is started, the checkpoint is of another stream: %s", reason)
        return None
    return checkpoint


class CheckpointWriter:
    """Writes checkpoints on its own thread; of several waiting only the newest is written.

    One that can't be written is counted in ``num_failed``, and the next one is tried. Of several in a row the
    first is logged.

    Args:
        path: The checkpoint file.
        on_error: Is told in a line, each time, that it can't be written.
    """

    def __init__(self, path: Path, on_error: Callable[[str], None] = tell_nobody) -> None:
        self._path = path
        self._on_error = on_error
        self._box: Mailbox[Checkpoint] = Mailbox(1, "newest")
        self.num_written = 0
        self.num_failed = 0
        self._thread = threading.Thread(target=self._run, name="semcast-checkpoint", daemon=True)
        self._thread.start()

    def submit(self, checkpoint: Checkpoint) -> None:
        """Write this one next, instead of any that still waits."""
        self._box.put(checkpoint)

    def _run(self) -> None:
        is_failing = False
        while (checkpoint := self._box.get()) is not None:
            try:
                save_checkpoint(self._path, checkpoint)
            except Exception as err:
                self._fail(err, is_first=not is_failing)
                is_failing = True
                continue
            self.num_written += 1
            if is_failing:
                logger.warning("checkpoints are written again")
            is_failing = False

    def _fail(self, err: Exception, *, is_first: bool) -> None:
        self.num_failed += 1
        text = str(err) or type(err).__name__
        if is_first:
            logger.warning(
                "%s; the stream goes on, and the next checkpoint is tried",
                text,
                exc_info=None if isinstance(err, CheckpointError) else err,
            )
        self._on_error(f"no checkpoint: {text}")

    def close(self) -> None:
        """Write what waits and end the thread. Idempotent."""
        self._box.close()
        self._thread.join(10.0)
