"""The original of what was sent, where it is known: image quality and true path while the run goes on."""

import logging
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError
from semcast.common.sequence import open_sequence
from semcast.common.trajectory import Trajectory

logger = logging.getLogger(__name__)


def psnr_db(x: NDArray[np.uint8], x_hat: NDArray[np.uint8]) -> float:
    """Peak signal-to-noise ratio of two uint8 images of one shape; infinite where they are equal.

    Raises:
        ValueError: The shapes differ.
    """
    if x.shape != x_hat.shape:
        raise ValueError(f"images must have one shape, got {x.shape} and {x_hat.shape}")
    squared = float(cv2.norm(x, x_hat, cv2.NORM_L2SQR))
    return float(10.0 * np.log10(255.0**2 * x.size / squared)) if squared > 0 else float("inf")


class Reference:
    """Compares decoded frames with the recorded sequence they came from, on a thread of its own.

    Args:
        folder: The sequence the agent reads, in any layout ``open_sequence`` knows.
        camera: Intrinsics of the decoded images; originals are brought to this camera.

    Raises:
        SourceError: The folder is no sequence.
    """

    def __init__(self, folder: Path, camera: Intrinsics) -> None:
        self._sequence = open_sequence(folder)
        self._camera = camera
        self._failed = False
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="semcast-reference")

    @property
    def truth(self) -> Trajectory | None:
        """True path in metres, None where the sequence has none."""
        return self._sequence.groundtruth()

    def psnr_db(self, frame_id: int, x_hat: NDArray[np.uint8]) -> "Future[float | None]":
        """Compare a decoded image with its original; None where that can't be read."""
        return self._pool.submit(self._compare, frame_id, x_hat)

    def _compare(self, frame_id: int, x_hat: NDArray[np.uint8]) -> float | None:
        try:
            return psnr_db(self._sequence.image(frame_id, self._camera), x_hat)
        except (SourceError, ValueError, IndexError) as err:
            if not self._failed:
                logger.warning("no PSNR: %s", err)
            self._failed = True
            return None

    def close(self) -> None:
        """End the thread. Idempotent."""
        self._pool.shutdown(wait=True, cancel_futures=True)
