"""Writes recordings: MCAP with uncompressed chunks, wire bytes unchanged. The only home of ``mcap``."""

import contextlib
import datetime
import platform
import sys
import time
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import BinaryIO

from mcap.writer import CompressionType, Writer

from semcast.common.errors import SourceError
from semcast.common.file_lock import is_locked
from semcast.common.recording_reader import (
    FORMAT,
    MESSAGE_ENCODING,
    RECORDING_METADATA,
    SCHEMA_PREFIX,
    RecordedMetadata,
    RecordingInfo,
    RecordingScan,
    scan_info,
)
from semcast.common.whole_file import whole_file

CHUNK_BYTES = 1024**2
FLUSH_INTERVAL_S = 0.5


def recording_metadata(settings_toml: str, semcast_version: str) -> dict[str, str]:
    """Return what the first record of a recording says about where it comes from.

    Args:
        settings_toml: Resolved settings of the program that records.
        semcast_version: Version of semcast.
    """
    values = {
        "format": FORMAT,
        "semcast": semcast_version,
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "settings": settings_toml,
    }
    for package in ("torch", "eclipse-zenoh", "mcap", "numpy"):
        with contextlib.suppress(metadata.PackageNotFoundError):
            values[package] = metadata.version(package)
    return values


class RecordingWriter:
    """Writes messages into a stream. Used from one thread; errors of the stream come through as ``OSError``.

    Args:
        stream: Opened for writing.
        header: Values of the first metadata record, see ``recording_metadata``.
        chunk_bytes: Size of a chunk; a chunk also ends after ``flush``.

    Attributes:
        num_written: Messages of whole chunks, which the stream has taken.
        bytes_written: Their payload.
    """

    def __init__(
        self, stream: BinaryIO, header: Mapping[str, str], *, chunk_bytes: int = CHUNK_BYTES
    ) -> None:
        self._stream = stream
        # The library would end a chunk without a word, and nobody knew what the stream has taken.
        self._writer = Writer(stream, chunk_size=sys.maxsize, compression=CompressionType.NONE)
        self._chunk_bytes = chunk_bytes
        self._writer.start(profile="semcast", library=f"semcast {header.get('semcast', '')}".strip())
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._flushed_s = time.monotonic()
        self._num_pending = self._bytes_pending = 0
        self.num_written = self.bytes_written = 0
        self.add_metadata(RECORDING_METADATA, header)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a named set of texts; it is on disk when this returns."""
        self._writer.add_metadata(name, dict(values))
        self._stream.flush()

    def add(self, topic: str, kind: str, log_time_ns: int, sequence: int, data: bytes) -> None:
        """Write one message.

        Args:
            topic: Its key expression.
            kind: Kind of message.
            log_time_ns: Wall time of arrival.
            sequence: Counts the messages of the topic.
            data: Wire bytes.
        """
        channel = self._channels.get((topic, kind))
        if channel is None:
            schema = self._schemas.get(kind)
            if schema is None:
                schema = self._writer.register_schema(SCHEMA_PREFIX + kind, "", b"")
                self._schemas[kind] = schema
            channel = self._writer.register_channel(topic, MESSAGE_ENCODING, schema)
            self._channels[(topic, kind)] = channel
        self._writer.add_message(channel, log_time_ns, data, log_time_ns, sequence)
        self._num_pending += 1
        self._bytes_pending += len(data)
        if self._bytes_pending >= self._chunk_bytes:
            self.flush()

    def flush_if_due(self) -> None:
        """End the chunk when it has been open for half a second, so that a kill loses no more than that."""
        if self._num_pending and time.monotonic() - self._flushed_s >= FLUSH_INTERVAL_S:
            self.flush()

    def flush(self) -> None:
        """End the chunk and hand everything to the operating system."""
        # The library has no public way to ask for the end of a chunk.
        self._writer._Writer__finalize_chunk()  # type: ignore[attr-defined]
        self._stream.flush()
        self.num_written += self._num_pending
        self.bytes_written += self._bytes_pending
        self._num_pending = self._bytes_pending = 0
        self._flushed_s = time.monotonic()

    def finish(self) -> None:
        """Write index and end mark; the stream stays open."""
        self.flush()
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.flush()


def recover_stream(source: BinaryIO, target: BinaryIO, name: str) -> RecordingInfo:
    """Copy every whole message of a cut or damaged recording into a new, complete one.

    Returns:
        What was copied; ``complete`` and ``num_damaged_chunks`` tell about the source.

    Raises:
        SourceError: ``source`` is no recording, or was cut before its first record.
    """
    scan = RecordingScan(source, name, strict=False)
    writer: RecordingWriter | None = None
    for record in scan.records():
        if isinstance(record, RecordedMetadata):
            if writer is None and record.name == RECORDING_METADATA:
                writer = RecordingWriter(target, record.values)
            elif writer is not None:
                writer.flush()  # the chunk before it goes first, as in the source
                writer.add_metadata(record.name, record.values)
        elif writer is not None:
            writer.add(record.topic, record.kind, record.log_time_ns, record.sequence, record.data)
    if writer is None:
        raise SourceError(f"{name} was cut off before its first record; there is nothing to recover")
    writer.finish()
    target.seek(0)
    info = scan_info(target, name)
    info.complete = scan.complete
    info.num_damaged_chunks = scan.num_damaged_chunks
    return info


def recover_file(path: Path, out: Path) -> RecordingInfo:
    """Rewrite a recording; ``out`` may be ``path``, which is replaced only when the new file is whole.

    Raises:
        SourceError: See ``recover_stream``; or a file can't be read or written, or ``out`` is still being
            recorded.
    """
    if is_locked(out):
        raise SourceError(f"{out} can't be replaced: it is still being recorded, end that first")
    try:
        source = path.open("rb")
    except OSError as err:
        raise SourceError(f"{path} can't be read: {err.strerror}") from err
    try:
        with source, whole_file(out) as target:
            return recover_stream(source, target, str(path))
    except OSError as err:
        raise SourceError(f"{path} can't be recovered into {out}: {err}") from err
