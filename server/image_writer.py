"""Keeps decoded images of a run, on a thread of its own, so that tracking does not wait for the disk."""

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.errors import SourceError, tell_nobody
from semcast.common.mailbox import Mailbox
from semcast.common.run_folder import IMAGES_NAME, image_name, shortage

logger = logging.getLogger(__name__)

#: Frames that may wait for a map to begin, whose start can make keyframes of them.
MAX_PROVISIONAL = 300
#: How long no image is written after one that could not be.
RETRY_S = 5.0
_JPEG_QUALITY = 95


@dataclass(frozen=True)
class _Image:
    frame_id: int
    image: NDArray[np.uint8]
    provisional: bool


class ImageWriter:
    """Writes decoded images into ``images/``.

    A disk with less free than is kept for results, or whatever else keeps an image from being written, is
    reported; the stream goes on, images are left out and counted as dropped, and it is tried again every
    ``RETRY_S``.

    Args:
        folder: The run folder.
        lossless: Wait when the queue is full; otherwise the image is dropped and counted.
        capacity: Images that may wait.
        on_error: Is told in a line, once until one is written again, why the run goes on without images.
        clock_s: Monotonic clock.

    Raises:
        SourceError: The folder can't be made.
    """

    def __init__(
        self,
        folder: Path,
        *,
        lossless: bool,
        capacity: int = 8,
        on_error: Callable[[str], None] = tell_nobody,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._images = folder / IMAGES_NAME
        self._wait_s = None if lossless else 0.0
        self._on_error = on_error
        self._clock_s = clock_s
        self._box: Mailbox[_Image] = Mailbox(capacity, "all")
        #: What is kept of the provisional images written so far; not in the queue, which may be full.
        self._settled: deque[tuple[int, frozenset[int]]] = deque()
        self._num_put = 0
        self.num_written = 0
        # Each belongs to one thread: that of the caller, and that of the writer.
        self._num_refused = self._num_left_out = self._num_told = 0
        self._failed_s: float | None = None
        try:
            self._images.mkdir(parents=True, exist_ok=True)
        except OSError as err:
            raise SourceError(f"{self._images} can't be written: {err}") from err
        self._provisional: deque[int] = deque()
        self._thread = threading.Thread(target=self._run, name="semcast-images", daemon=True)
        self._thread.start()

    @property
    def num_dropped(self) -> int:
        """Images that found no room in the queue, or could not be written."""
        return self._num_refused + self._num_left_out

    def put(self, frame_id: int, image: NDArray[np.uint8], *, provisional: bool = False) -> None:
        """Queue one image; the caller must not change it afterwards. After ``close`` it is ignored.

        Args:
            frame_id: Names the file.
            image: ``(H, W, 3)`` uint8 RGB.
            provisional: ``settle`` will say whether it is kept; of many only the newest are.
        """
        if self._box.put(_Image(frame_id, image, provisional), self._wait_s) is not None:
            self._num_put += 1
        elif not self._box.closed:
            self._num_refused += 1

    def settle(self, kept: Collection[int]) -> None:
        """Remove the provisional images of all other frames put so far. Returns at once."""
        self._settled.append((self._num_put, frozenset(kept)))

    def _run(self) -> None:
        num_taken = 0
        while (item := self._box.get()) is not None:
            while self._settled and self._settled[0][0] <= num_taken:
                self._drop_provisional(self._settled.popleft()[1])
            num_taken += 1
            if self._failed_s is not None and self._clock_s() - self._failed_s < RETRY_S:
                self._num_left_out += 1
                continue
            try:
                self._write(item)
            except Exception as err:
                self._remove(item.frame_id)  # a part of it may be there
                self._fail(err)
            else:
                self._note_written(item)
        while self._settled:
            self._drop_provisional(self._settled.popleft()[1])
        self._drop_provisional(frozenset())

    def _write(self, item: _Image) -> None:
        if (why := shortage(self._images)) is not None:
            raise OSError(why)
        bgr = cv2.cvtColor(item.image, cv2.COLOR_RGB2BGR)
        good, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        if not good:
            raise OSError("OpenCV could not encode the image")
        (self._images / image_name(item.frame_id)).write_bytes(data.tobytes())

    def _note_written(self, item: _Image) -> None:
        self.num_written += 1
        if item.provisional:
            self._provisional.append(item.frame_id)
            if len(self._provisional) > MAX_PROVISIONAL:
                self._remove(self._provisional.popleft())
        if self._failed_s is not None:
            self._failed_s = None
            logger.warning("%s is written again; %d images were left out", self._images, self._num_left_out)

    def _fail(self, err: Exception) -> None:
        is_first, self._failed_s = self._failed_s is None, self._clock_s()
        self._num_left_out += 1
        if not is_first:
            return
        text = f"{self._images} can't be written: {str(err) or type(err).__name__}"
        logger.warning(
            "%s; the run goes on without images, and it is tried again every %g s",
            text,
            RETRY_S,
            exc_info=None if isinstance(err, OSError | cv2.error) else err,
        )
        self._on_error(text)

    def _drop_provisional(self, kept: Collection[int]) -> None:
        for frame_id in self._provisional:
            if frame_id not in kept:
                self._remove(frame_id)
        self._provisional.clear()

    def _remove(self, frame_id: int) -> None:
        with contextlib.suppress(OSError):
            (self._images / image_name(frame_id)).unlink()

    def close(self, deadline_s: float = 30.0) -> None:
        """Write what waits, end the thread and say how many images are missing. Idempotent.

        Args:
            deadline_s: What is not written by then is dropped.
        """
        self._box.close()
        self._thread.join(deadline_s)
        self._num_refused += self._box.clear()
        if self.num_dropped > self._num_told:
            self._num_told = self.num_dropped
            logger.warning(
                "%d images are not in %s: the disk was too slow or could not be written",
                *(self._num_told, self._images),
            )

    def __enter__(self) -> "ImageWriter":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
