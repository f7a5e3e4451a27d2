"""Reads recordings, whole or cut off anywhere: every record that arrived on disk whole is given back.

The container is MCAP (https://mcap.dev/spec) with uncompressed chunks. Its own readers need an intact end or
take a cut message for a whole one, so the framing is read here: opcode, length, content, and inside an
unfinished chunk the same again.
"""

import logging
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from semcast.common.errors import SourceError
from semcast.common.file_lock import is_locked
from semcast.common.ros_bag_files import MCAP_MAGIC, check_no_ros_bag

logger = logging.getLogger(__name__)

MESSAGE_ENCODING = "msgpack"
SCHEMA_PREFIX = "semcast."
#: Name of the metadata record every recording starts with.
RECORDING_METADATA = "semcast.recording"
#: Of one that stands where something damaged was left out, in a recovered recording too.
DAMAGE_METADATA = "semcast.damage"
FORMAT = "1"
MAX_RECORD_BYTES = 256 * 1024**2

_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
_METADATA = 0x0C
_FRAME = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
#: Times, size and checksum of the records, length of the name of their compression, length of the records.
_CHUNK_HEAD = struct.Struct("<QQQIIQ")
_COMPRESSIONS = (b"lz4", b"zstd")
_U16, _U32 = struct.Struct("<H"), struct.Struct("<I")


@dataclass(frozen=True)
class RecordedMessage:
    """One message as it crossed the network.

    Attributes:
        topic: Its key expression.
        kind: Kind of message, such as ``symbols``.
        log_time_ns: Wall time at the recorder.
        sequence: Counts the messages of a topic from 0; a gap means the recorder dropped some.
        data: Wire bytes, unchanged.
    """

    topic: str
    kind: str
    log_time_ns: int
    sequence: int
    data: bytes


@dataclass(frozen=True)
class RecordedMetadata:
    """A named set of texts."""

    name: str
    values: dict[str, str]


@dataclass
class RecordingInfo:
    """What a recording holds.

    Attributes:
        metadata: Name to values; of a name given twice the later one.
        counts: Topic to number of messages.
        num_bytes: Topic to bytes of payload.
        kinds: Topic to kind.
        missed: Topic to messages the recorder dropped, where it did; what was lost with a damaged chunk is
            not among them.
        start_ns: Wall time of the first message, None without messages.
        end_ns: Wall time of the last message.
        complete: The file was closed; otherwise it was cut off.
        num_damaged_chunks: Chunks and records that were damaged and left out.
    """

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    num_bytes: Counter[str] = field(default_factory=Counter)
    kinds: dict[str, str] = field(default_factory=dict)
    missed: dict[str, int] = field(default_factory=dict)
    start_ns: int | None = None
    end_ns: int | None = None
    complete: bool = False
    num_damaged_chunks: int = 0


class _CutError(Exception):
    """The bytes end inside a record."""


class _Text:
    """Reads fields from the content of one record."""

    def __init__(self, content: bytes | memoryview) -> None:
        self._content = memoryview(content)
        self._place = 0

    def take(self, size: int) -> memoryview:
        end = self._place + size
        if end > len(self._content):
            raise _CutError
        part = self._content[self._place : end]
        self._place = end
        return part

    def u16(self) -> int:
        return int(_U16.unpack(self.take(2))[0])

    def u32(self) -> int:
        return int(_U32.unpack(self.take(4))[0])

    def text(self) -> str:
        return bytes(self.take(self.u32())).decode("utf-8", "replace")

    def texts(self) -> dict[str, str]:
        end = self.u32() + self._place
        found = {}
        while self._place < end:
            key = self.text()
            found[key] = self.text()
        return found


class RecordingScan:
    """One pass over a recording, from its start.

    Args:
        stream: Positioned at the start of the file.
        name: What to call it in messages.
        strict: Raise on a chunk whose checksum does not match; otherwise leave it out, count it, and yield
            ``DAMAGE_METADATA`` in its place.

    Attributes:
        complete: After the pass: the file was closed and has its end mark.
        num_damaged_chunks: Chunks and records left out so far.
    """

    def __init__(self, stream: BinaryIO, name: str, *, strict: bool = True) -> None:
        self._stream = stream
        self._name = name
        self._strict = strict
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, str]] = {}
        self.complete = False
        self.num_damaged_chunks = 0

    def records(self) -> Iterator[RecordedMessage | RecordedMetadata]:
        """Yield messages and metadata in the order they were written.

        Raises:
            SourceError: The file is no recording, or a chunk is damaged.
        """
        if self._stream.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            raise SourceError(f"{self._name} is not a recording: it does not start as an MCAP file")
        try:
            while True:
                opcode, size = _FRAME.unpack(self._exactly(_FRAME.size))
                if opcode in (_FOOTER, _DATA_END):
                    self.complete = opcode == _DATA_END
                    return
                if opcode == _CHUNK:
                    yield from self._chunk(size)
                elif opcode == 0 or size > MAX_RECORD_BYTES:
                    # Zeros after a power cut, or garbage: nothing behind can be trusted.
                    return
                else:
                    yield from self._record(opcode, self._exactly(size))
        except _CutError:
            return

    def _exactly(self, size: int) -> bytes:
        data = self._stream.read(size)
        if len(data) < size:
            raise _CutError
        return data

    def _chunk(self, size: int) -> Iterator[RecordedMessage | RecordedMetadata]:
        """Yield the records of a chunk; of an unfinished one those that are whole."""
        if not _CHUNK_HEAD.size <= size <= MAX_RECORD_BYTES:
            raise _CutError
        data = self._stream.read(size)
        if len(data) < _CHUNK_HEAD.size:
            raise _CutError
        _, _, _, crc, name_size, _ = _CHUNK_HEAD.unpack_from(data)
        name = data[_CHUNK_HEAD.size - 8 :][:name_size]
        if name in _COMPRESSIONS:
            raise SourceError(f"{self._name} is compressed ({name.decode()}); semcast writes and reads none")
        # Records reach to the end of the chunk: of its head, damage to the checksum alone matters.
        inner = memoryview(data)[_CHUNK_HEAD.size :]
        whole = len(data) == size
        if whole and (crc or name_size) and zlib.crc32(inner) != crc:
            damage = self._damage()
            if self._strict:
                raise SourceError(
                    f"{self._name} is damaged: a checksum does not match; 'semcast recover' keeps the rest"
                )
            # Topics are defined where they first occur. Without them later, sound chunks say nothing.
            for opcode, record in _records_in(inner):
                if opcode in (_SCHEMA, _CHANNEL):
                    yield from self._record(opcode, record)
            yield damage
            return
        for opcode, record in _records_in(inner):
            yield from self._record(opcode, record)
        if not whole:
            raise _CutError

    def _record(
        self, opcode: int, content: bytes | memoryview
    ) -> Iterator[RecordedMessage | RecordedMetadata]:
        try:
            if opcode == _MESSAGE:
                channel_id, sequence, log_time_ns, _ = _MESSAGE_HEAD.unpack_from(content)
                if channel_id in self._channels:
                    topic, kind = self._channels[channel_id]
                    yield RecordedMessage(
                        topic, kind, log_time_ns, sequence, bytes(content[_MESSAGE_HEAD.size :])
                    )
            elif opcode == _SCHEMA:
                fields = _Text(content)
                schema_id = fields.u16()
                self._schemas[schema_id] = fields.text()
            elif opcode == _CHANNEL:
                fields = _Text(content)
                channel_id, schema_id = fields.u16(), fields.u16()
                topic, encoding = fields.text(), fields.text()
                name = self._schemas.get(schema_id, "")
                if encoding == MESSAGE_ENCODING and name.startswith(SCHEMA_PREFIX):
                    self._channels[channel_id] = (topic, name.removeprefix(SCHEMA_PREFIX))
            elif opcode == _METADATA:
                fields = _Text(content)
                yield RecordedMetadata(fields.text(), fields.texts())
        except (struct.error, _CutError) as err:
            damage = self._damage()
            if self._strict:
                raise SourceError(f"{self._name} is damaged: a record of type {opcode} is too short") from err
            yield damage

    def _damage(self) -> RecordedMetadata:
        """Count what is left out, and return what stands in its place."""
        self.num_damaged_chunks += 1
        return RecordedMetadata(DAMAGE_METADATA, {"num_left_out": str(self.num_damaged_chunks)})


def _records_in(chunk: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield opcode and content of the whole records of a chunk."""
    place = 0
    while place + _FRAME.size <= len(chunk):
        opcode, size = _FRAME.unpack_from(chunk, place)
        place += _FRAME.size
        if place + size > len(chunk):
            return
        yield opcode, chunk[place : place + size]
        place += size


class RecordingReader:
    """A recording on disk.

    Args:
        path: The file.

    Attributes:
        metadata: Name to values, as far as they stand before the first message.

    Raises:
        SourceError: The file can't be read, is no recording of semcast, or is of another version.
    """

    def __init__(self, path: Path) -> None:
        check_no_ros_bag(path)
        self.path = path
        self.metadata: dict[str, dict[str, str]] = {}
        self._is_cut_told = False
        with self._open() as stream:
            for record in RecordingScan(stream, str(path)).records():
                if isinstance(record, RecordedMessage):
                    break
                self.metadata[record.name] = record.values
        header = self.metadata.get(RECORDING_METADATA)
        if header is None:
            raise SourceError(f"{path} holds no recording of semcast, or was cut off before its first record")
        if header.get("format") != FORMAT:
            raise SourceError(
                f"{path} is a recording of format {header.get('format')} by semcast {header.get('semcast')}, "
                f"this semcast reads format {FORMAT}"
            )

    def _open(self) -> BinaryIO:
        try:
            return self.path.open("rb")
        except OSError as err:
            raise SourceError(f"{self.path} can't be read: {err}") from err

    def messages(self, kinds: frozenset[str] | None = None) -> Iterator[RecordedMessage]:
        """Yield messages in the order they were recorded, of these kinds or of all.

        Of a file that was cut off, or is still being written, the first pass warns.

        Raises:
            SourceError: The file is damaged in the middle; a cut end only ends the iteration.
        """
        with self._open() as stream:
            scan = RecordingScan(stream, str(self.path))
            for record in scan.records():
                if isinstance(record, RecordedMessage) and (kinds is None or record.kind in kinds):
                    yield record
            if not scan.complete and not self._is_cut_told:
                self._is_cut_told = True
                why = "is still being recorded" if is_locked(self.path) else "was cut off"
                logger.warning("%s %s; everything up to its last whole record was read", self.path, why)

    def info(self) -> RecordingInfo:
        """Read the whole file and count what it holds."""
        with self._open() as stream:
            return scan_info(stream, str(self.path))

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        return os.stat(self.path).st_size


def scan_info(stream: BinaryIO, name: str) -> RecordingInfo:
    """Count what a recording holds; damaged chunks are counted and left out."""
    info = RecordingInfo()
    next_sequence: dict[str, int] = {}
    is_known = True
    scan = RecordingScan(stream, name, strict=False)
    for record in scan.records():
        if isinstance(record, RecordedMetadata):
            info.metadata[record.name] = record.values
            if record.name == DAMAGE_METADATA:
                # How many messages of a topic were lost here can't be told.
                next_sequence.clear()
                is_known = False
            continue
        info.counts[record.topic] += 1
        info.num_bytes[record.topic] += len(record.data)
        info.kinds[record.topic] = record.kind
        gap = record.sequence - next_sequence.get(record.topic, 0 if is_known else record.sequence)
        if gap > 0:
            info.missed[record.topic] = info.missed.get(record.topic, 0) + gap
        next_sequence[record.topic] = record.sequence + 1
        if info.start_ns is None:
            info.start_ns = record.log_time_ns
        info.end_ns = record.log_time_ns
    info.complete = scan.complete
    info.num_damaged_chunks = scan.num_damaged_chunks
    return info
