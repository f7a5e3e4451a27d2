"""Records messages beside a running system: a bounded queue and a thread, so the live path never waits."""

import contextlib
import logging
import os
import struct
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from pathlib import Path

from semcast.common.errors import SourceError, tell_nobody
from semcast.common.file_lock import is_locked, lock
from semcast.common.former_file import keep_former
from semcast.common.recording_writer import FLUSH_INTERVAL_S, RecordingWriter
from semcast.common.run_folder import shortage

logger = logging.getLogger(__name__)

QUEUE_BYTES = 64 * 1024**2
#: What an entry of the queue takes beside its payload, about: empty ones would be without end.
ENTRY_BYTES = 500
#: Keys of one agent, which are about twenty; each takes room in the index, which has 65535 numbers for them.
MAX_TOPICS = 1000
#: Why messages are left out, in words.
_REASONS = {
    "queue": "the disk is too slow, or more comes than it can take",
    "topics": f"they come under more than {MAX_TOPICS} keys",
}
#: What a disk, or a number the format has no room for, ends a recording with; the rest is logged in full.
_EXPECTED = (OSError, ValueError, struct.error)


class Recorder:
    """Takes messages from any thread and writes them on its own.

    When the disk is too slow, newest messages are dropped and counted, as are those under more keys than an
    agent has. When the disk is full, that is reported once, and messages that it did not take, and later
    ones, are counted as dropped.

    Args:
        path: File to write. One that is there and not empty is kept under another name: it may be the
            recording of a process that was killed, whose restart this is. Without a message no file is left,
            and no folder made for it.
        header: See ``recording_metadata``.
        queue_bytes: What may wait for the disk.
        results: Folder of a run's results, None without: where they are on the same disk, the recording ends
            while there is room for them.
        on_error: Is told in a line why recording ended before it was closed.

    Raises:
        SourceError: The file can't be opened, another recorder is writing it, or there is no room for more
            than the results.
    """

    def __init__(
        self,
        path: Path,
        header: Mapping[str, str],
        *,
        queue_bytes: int = QUEUE_BYTES,
        results: Path | None = None,
        on_error: Callable[[str], None] = tell_nobody,
    ) -> None:
        self._path = path
        self._limit_bytes = queue_bytes
        self._on_error = on_error
        self._queue: deque[tuple[str, str, int, int, bytes] | tuple[str, Mapping[str, str]]] = deque()
        self._queued_bytes = 0
        self._sequence: Counter[str] = Counter()
        self._condition = threading.Condition()
        self._closed = False
        self._num_taken = 0
        self.drops: Counter[str] = Counter()
        self.error: str | None = None
        self._former: Path | None = None
        if is_locked(path):
            raise SourceError(f"{path} can't be written: something else is being recorded into it")
        self._new_folders = [folder for folder in path.parents if not folder.exists()]
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._shares_disk = results is not None and os.stat(results).st_dev == os.stat(path.parent).st_dev
            if (why := self._shortage()) is not None:
                raise OSError(why)
            self._former = keep_former(path)
            self._stream = path.open("wb")
            if path.is_file():  # not a device, such as /dev/null
                lock(self._stream.fileno())
            self._writer = self._begun(header)
        except OSError as err:
            self._remove_new_folders()
            raise SourceError(f"{path} can't be written: {_why(err)}") from err
        self._thread = threading.Thread(target=self._run, name="semcast-recorder", daemon=True)
        self._thread.start()

    def _begun(self, header: Mapping[str, str]) -> RecordingWriter:
        """Write the first record; where the disk does not take it, all is left as it was."""
        try:
            return RecordingWriter(self._stream, header)
        except OSError:
            with contextlib.suppress(OSError):  # it has no room for what is left to write, either
                self._stream.close()
            self._leave_as_it_was()
            raise

    @property
    def num_written(self) -> int:
        """Messages the disk has taken."""
        return self._writer.num_written

    @property
    def bytes_written(self) -> int:
        """Their payload."""
        return self._writer.bytes_written

    def put(self, topic: str, kind: str, data: bytes) -> None:
        """Queue one message; returns at once.

        Args:
            topic: Its key expression.
            kind: Kind of message.
            data: Wire bytes.
        """
        now_ns = time.time_ns()
        with self._condition:
            if topic not in self._sequence and len(self._sequence) >= MAX_TOPICS:
                self._drop("topics")
                return
            sequence = self._sequence[topic]
            self._sequence[topic] += 1
            if self._closed or self.error is not None:
                self.drops["closed" if self._closed else "disk"] += 1
            elif self._has_room(len(data)):
                self._queue.append((topic, kind, now_ns, sequence, data))
                self._num_taken += 1
                self._condition.notify()

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Queue a named set of texts."""
        with self._condition:
            size = sum(len(key) + len(value) for key, value in values.items())
            if not self._closed and self.error is None and self._has_room(size):
                self._queue.append((name, dict(values)))
                self._condition.notify()

    def _has_room(self, num_bytes: int) -> bool:
        """Take room in the queue for so many bytes, or count what finds none."""
        if self._queued_bytes + num_bytes + ENTRY_BYTES > self._limit_bytes:
            self._drop("queue")
            return False
        self._queued_bytes += num_bytes + ENTRY_BYTES
        return True

    def _drop(self, reason: str) -> None:
        if not self.drops[reason]:
            logger.warning("messages are left out of %s: %s", self._path, _REASONS[reason])
        self.drops[reason] += 1

    def _run(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: bool(self._queue) or self._closed, FLUSH_INTERVAL_S)
                batch, self._queue = self._queue, deque()
                self._queued_bytes = 0
                ending = self._closed
            try:
                if (why := self._shortage()) is not None:
                    self._writer.finish()
                    raise OSError(why)
                for item in batch:
                    if len(item) == 2:
                        self._writer.add_metadata(*item)
                    else:
                        self._writer.add(*item)
                self._writer.flush_if_due()
                if ending:
                    self._writer.finish()
            except Exception as err:
                self._fail(err)
                return
            if ending:
                return

    def _shortage(self) -> str | None:
        """Say that the disk has no room for more than results; what waits is less than is kept for them."""
        return shortage(self._path.parent) if self._shares_disk else None

    def _fail(self, err: Exception) -> None:
        """Say once that recording ended; what was written up to here stays readable."""
        with contextlib.suppress(OSError):  # nobody is to take the file for one that is being recorded
            self._stream.close()
        why = _why(err)
        text = f"recording into {self._path} ended: {why}"
        logger.error(
            "%s; the stream goes on, %d messages were recorded",
            text,
            self.num_written,
            exc_info=None if isinstance(err, _EXPECTED) else err,
        )
        self._on_error(text)
        with self._condition:
            self.error = why
            self.drops["disk"] += self._num_taken - self.num_written
            self._queue.clear()
            self._queued_bytes = 0

    def close(self) -> None:
        """Write what waits, the index and the end mark, and close the file. Idempotent."""
        with self._condition:
            already, self._closed = self._closed, True
            self._condition.notify()
        self._thread.join(10.0)
        if not already and (num_left_out := sum(self.drops[reason] for reason in _REASONS)):
            logger.warning("%d messages were left out of %s", num_left_out, self._path)
        if not already and self.error is None and not self._thread.is_alive():
            try:
                self._stream.close()
                if self.num_written == 0:
                    self._leave_as_it_was()
            except OSError as err:
                logger.error("closing %s failed: %s", self._path, err)

    def _leave_as_it_was(self) -> None:
        """Take the file away again: a start that fails must not move a good recording."""
        if self._path.is_file():  # not a device, such as /dev/null
            self._path.unlink()
        if self._former is not None:
            self._former.rename(self._path)
        self._remove_new_folders()

    def _remove_new_folders(self) -> None:
        for folder in self._new_folders:  # the innermost first
            with contextlib.suppress(OSError):  # somebody else put something in
                folder.rmdir()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _why(err: Exception) -> str:
    return (isinstance(err, OSError) and err.strerror) or str(err) or type(err).__name__
