"""The way into ``run.rrd``: everything the scene gets, as long as the disk has room for it."""

import logging
import time
from collections.abc import Callable
from pathlib import Path

from semcast.common.errors import tell_nobody
from semcast.common.run_folder import shortage
from semcast.server.view.rerun_viewer import Delivery, RerunStream
from semcast.server.view.scene import Changes, Cursor

logger = logging.getLogger(__name__)

_FLUSH_INTERVAL_S = 1.0
_FLUSH_TIMEOUT_S = 1.0
#: Longest wait at the end for a slow disk.
_CLOSE_DEADLINE_S = 5.0


class FileStream:
    """Writes what a file lacks. Used from one thread at a time.

    While the disk has no more room than results need, what is new waits in the scene. A write that fails ends
    the file.

    Args:
        stream: Writes to the file.
        path: The file, for messages.
        changes_since: Returns what is not in the file yet and moves the cursor on.
        on_error: Is told in a line why the run goes on without the file; of a failed write once.
    """

    def __init__(
        self,
        stream: RerunStream,
        path: Path,
        changes_since: Callable[[Cursor], Changes],
        on_error: Callable[[str], None] = tell_nobody,
    ) -> None:
        self._stream = stream
        self._path = path
        self._changes_since = changes_since
        self._on_error = on_error
        self._cursor = Cursor()
        self._flushed_s = time.monotonic()
        self._has_failed = self._is_short = False

    def write(self) -> None:
        """Write what is new; about once a second, see that it has reached the disk, and has room there."""
        if self._has_failed:
            return
        if not self._is_short:
            self._stream.write(self._changes_since(self._cursor))
        if time.monotonic() - self._flushed_s >= _FLUSH_INTERVAL_S:
            # Rerun writes on a thread of its own, which ends at the first write that fails.
            if self._stream.flush(_FLUSH_TIMEOUT_S) is Delivery.SEVERED:
                self._fail()
            else:
                self._look_for_room()
            self._flushed_s = time.monotonic()

    def _look_for_room(self) -> None:
        was_short, why = self._is_short, shortage(self._path.parent)
        self._is_short = why is not None
        if self._is_short and not was_short:
            text = f"{self._path} is not written any further: {why}"
            logger.warning("%s; the run goes on, and what is new waits for room", text)
            self._on_error(text)
        elif was_short and not self._is_short:
            logger.warning("%s is written again, with what waited", self._path)

    def _fail(self) -> None:
        if self._has_failed:
            return
        self._has_failed = True
        text = f"{self._path} can't be written to its end (is there room on the disk?)"
        logger.error("%s, the run goes on without it", text)
        self._on_error(text)

    def close(self) -> None:
        """Finish the file."""
        if not self._has_failed:
            self._stream.write_held()
        # A thread that ends while it is asked never answers, however often: that looks like a stalled disk.
        if self._stream.flush(_CLOSE_DEADLINE_S) is not Delivery.DONE:
            self._fail()
        self._stream.close(_CLOSE_DEADLINE_S)
