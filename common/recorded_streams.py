"""The streams in a recording: one per start of an agent, with how many frames of each there are."""

import logging
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, TypeVar

from semcast.common.errors import SourceError
from semcast.common.keys import agent_of
from semcast.common.messages import CameraInfo, ChannelReport, SourceImage, SymbolFrame
from semcast.common.recording_reader import RecordingReader
from semcast.common.wire import WireError, unpack

logger = logging.getLogger(__name__)

M = TypeVar("M", bound=SymbolFrame | ChannelReport | SourceImage)

#: Received: what the link made of the frames. Transmitted: what the agent sent.
Symbols = Literal["received", "transmitted"]


@dataclass(frozen=True)
class RecordedStream:
    """What one start of an agent left in a recording.

    Attributes:
        agent_id: Its name.
        camera: As last announced.
        num_received: Frames after the link; one that was sent again counts once.
        num_transmitted: Frames before it.
    """

    agent_id: str
    camera: CameraInfo
    num_received: int
    num_transmitted: int

    def num_frames(self, symbols: Symbols) -> int:
        """Frames of one kind."""
        return self.num_received if symbols == "received" else self.num_transmitted


def recorded_streams(reader: RecordingReader) -> list[RecordedStream]:
    """Return the streams of a recording whose camera is known, in the order they begin in it.

    The order is the file's: the clock of an agent may have been set back between two starts. Messages that
    can't be read count for nothing.
    """
    cameras: dict[tuple[str, int], CameraInfo] = {}
    frames: defaultdict[tuple[str, int, str], set[int]] = defaultdict(set)
    for message in reader.messages(frozenset({"camera", "symbols"})):
        agent_id = agent_of(message.topic)
        if not agent_id:
            logger.debug("messages of %s are left out: it names no agent", message.topic)
            continue
        try:
            if message.kind == "camera":
                camera = unpack(message.data, CameraInfo)
                cameras[agent_id, camera.agent_epoch] = camera
            else:
                frame = unpack(message.data, SymbolFrame)
                frames[agent_id, frame.agent_epoch, frame.direction].add(frame.frame_id)
        except WireError as err:
            logger.debug("a message of %s is left out: %s", message.topic, err)
    return [
        RecordedStream(
            agent_id, camera, len(frames[agent_id, epoch, "rx"]), len(frames[agent_id, epoch, "tx"])
        )
        for (agent_id, epoch), camera in cameras.items()
    ]


def choose_stream(reader: RecordingReader, number: int | None, symbols: Symbols) -> RecordedStream:
    """Return one stream of a recording.

    Args:
        reader: The recording.
        number: Counts the streams from 1; None for the last one that has frames.
        symbols: Kind of frames it must have.

    Raises:
        SourceError: There is no such stream, or it has no frames of that kind.
    """
    streams = recorded_streams(reader)
    if not streams:
        raise SourceError(f"{reader.path} says nothing about a camera, so its frames can't be placed")
    if number is not None and not 1 <= number <= len(streams):
        raise SourceError(f"stream must be in [1, {len(streams)}] for {reader.path}, got {number}")
    counts = [s.num_frames(symbols) for s in streams]
    told = ", ".join(f"stream {k}: {count}" for k, count in enumerate(counts, start=1))
    wanted = range(len(streams)) if number is None else [number - 1]
    with_frames = [k for k in wanted if counts[k]]
    if not with_frames:
        which = "" if number is None else f" of stream {number}"
        raise SourceError(f"{reader.path} holds no {symbols} frames{which} ({told})")
    last = with_frames[-1]
    if number is None and sum(count > 0 for count in counts) > 1:
        logger.warning("stream %d of %s is taken; frames by stream: %s", last + 1, reader.path, told)
    return streams[last]


def stream_messages(
    reader: RecordingReader, stream: RecordedStream, classes: Mapping[str, type[M]]
) -> Iterator[tuple[int, M]]:
    """Yield the messages of one stream in the order they were recorded, each with the recorder's time in ns.

    One of its agent that can't be read is left out with a warning; what others sent has no say.

    Args:
        reader: The recording.
        stream: One of it.
        classes: Kinds of messages, and what they are read as.
    """
    for message in reader.messages(frozenset(classes)):
        if agent_of(message.topic) != stream.agent_id:
            continue
        try:
            found = unpack(message.data, classes[message.kind])
        except WireError as err:
            logger.warning("a message of %s in %s is left out: %s", message.topic, reader.path, err)
            continue
        if found.agent_epoch == stream.camera.agent_epoch:
            yield message.log_time_ns, found
