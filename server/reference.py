"""The original of what was sent, where it is known: image quality and true path while the run goes on."""

import logging
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.camera_settings import CameraSettings
from semcast.common.errors import SourceError
from semcast.common.image import psnr_db
from semcast.common.image_header import stated_size_wh
from semcast.common.messages import SourceImage
from semcast.common.recorded_streams import RecordedStream, stream_messages
from semcast.common.recording_reader import RecordingReader
from semcast.common.sequence import open_sequence, retimed
from semcast.common.trajectory import Trajectory

logger = logging.getLogger(__name__)

#: Frame id to the original image, None where there is none.
Originals = Callable[[int], NDArray[np.uint8] | None]


class Reference:
    """Compares decoded frames with their originals, on a thread of its own.

    Args:
        originals: Asked on that thread, with increasing frame ids.
        truth: True path, None where it is not known.
        times_ns: ``(N,)`` times by frame id on the clock of ``truth``; None where that is the stream's.
    """

    def __init__(
        self,
        originals: Originals,
        truth: Trajectory | None = None,
        times_ns: NDArray[np.int64] | None = None,
    ) -> None:
        self.truth = truth
        self.times_ns = times_ns
        self._originals = originals
        self._failed = False
        self._job: Future[float | None] | None = None
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="semcast-reference")

    def truth_of(self, t_source_ns: Mapping[int, int]) -> Trajectory | None:
        """Return the true path on the clock of a stream, given the times of its frames by frame id."""
        if self.truth is None or self.times_ns is None:
            return self.truth
        return retimed(self.truth, self.times_ns, t_source_ns)

    def psnr_db(self, frame_id: int, x_hat: NDArray[np.uint8]) -> "Future[float | None] | None":
        """Compare a decoded image with its original.

        Returns:
            The PSNR, of which None says that there is no original or it can't be read. No future while the
            comparison before is still under way: waiting images would pile up where originals are read
            slower than frames come. Belongs to one thread.
        """
        if self._job is not None and not self._job.done():
            return None
        self._job = self._pool.submit(self._compare, frame_id, x_hat)
        return self._job

    def _compare(self, frame_id: int, x_hat: NDArray[np.uint8]) -> float | None:
        try:
            original = self._originals(frame_id)
            return psnr_db(original, x_hat) if original is not None else None
        except (SourceError, ValueError, IndexError, cv2.error) as err:
            if not self._failed:
                logger.warning("no PSNR; is the reference what was sent? %s", err)
            self._failed = True
            return None

    def close(self) -> None:
        """End the thread. Idempotent."""
        self._pool.shutdown(wait=True, cancel_futures=True)


def sequence_reference(folder: Path, camera: Intrinsics, given: CameraSettings | None = None) -> Reference:
    """Compare with the recorded sequence the agent reads.

    Args:
        folder: In any layout ``open_sequence`` knows.
        camera: Intrinsics of the decoded images; originals are brought to this camera.
        given: What the agent was told about the sequence's camera, None or empty: the sequence's own.

    Raises:
        SourceError: The folder is no sequence.
    """
    sequence = open_sequence(folder, given)
    is_told = False

    def original(frame_id: int) -> NDArray[np.uint8] | None:
        nonlocal is_told
        if frame_id < len(sequence):
            return sequence.image(frame_id, camera)
        if not is_told:
            logger.warning(
                "the reference has %d frames: those of a second pass (--repeat) are not compared with it",
                len(sequence),
            )
        is_told = True
        return None

    return Reference(original, sequence.groundtruth(), sequence.times_ns)


def recording_reference(reader: RecordingReader, stream: RecordedStream) -> Reference | None:
    """Compare with the originals an agent shared (``--share-source``); None where the recording has none."""
    images = _recorded_images(reader, stream)
    newest = next(images, None)
    if newest is None:
        return None

    def original(frame_id: int) -> NDArray[np.uint8] | None:
        nonlocal newest
        while newest is not None and newest.frame_id < frame_id:
            newest = next(images, None)
        return _pixels(newest) if newest is not None and newest.frame_id == frame_id else None

    return Reference(original)


def _recorded_images(reader: RecordingReader, stream: RecordedStream) -> Iterator[SourceImage]:
    """Yield the originals of a stream; what is no valid one is left out."""
    shape_hw = stream.camera.intrinsics.shape_hw
    messages = stream_messages(reader, stream, {"source": SourceImage})
    return (image for _, image in messages if image.image_hw == shape_hw)


def _pixels(image: SourceImage) -> NDArray[np.uint8]:
    if stated_size_wh(image.data) != image.image_hw[::-1]:
        height, width = image.image_hw
        raise ValueError(f"the original of frame {image.frame_id} is no image of {width}x{height}")
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    bgr = cv2.imdecode(np.frombuffer(image.data, np.uint8), flags)
    if bgr is None:
        raise ValueError(f"the original of frame {image.frame_id} is no {image.image_format} image")
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
