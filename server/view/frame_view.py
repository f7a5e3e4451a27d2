"""What one frame contributes to what the viewer shows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: State of a frame of which no image came: it says nothing of the tracker.
MISSING = "missing"


@dataclass(frozen=True)
class FrameView:
    """What one processed frame contributes.

    Attributes:
        frame_id: Index of the frame in its source.
        t_source_ns: Recorded time of the frame.
        T_world_cam: 4x4, or None where the frame has no pose.
        state: Tracking state in words, or ``MISSING``.
        scalars: Plot path, such as ``link/snr_set_db``, to value.
        image: ``(H, W, 3)`` uint8 RGB as decoded; None once it was replaced by a newer one, or where the one
            before stays.
        confidence: ``(H, W)`` float32 in [0, 1], or None.
        keypoints_xy: ``(N, 2)`` pixels.
        keypoint_inlier: ``(N,)`` bool.
        backfilled: Poses found later for earlier frames: ``(frame_id, t_source_ns, T_world_cam)``.
        after_gaps: Those of them before which the camera was lost.
    """

    frame_id: int
    t_source_ns: int
    T_world_cam: Array | None
    state: str
    scalars: dict[str, float]
    image: NDArray[np.uint8] | None
    confidence: NDArray[np.float32] | None
    keypoints_xy: NDArray[np.float32]
    keypoint_inlier: NDArray[np.bool_]
    backfilled: Sequence[tuple[int, int, Array]] = ()
    after_gaps: frozenset[int] = frozenset()

    def without_image(self) -> "FrameView":
        """Return the light part: pose and plot values, all of which come into the scene."""
        none = np.zeros((0, 2), dtype=np.float32)
        return replace(
            self, image=None, confidence=None, keypoints_xy=none, keypoint_inlier=np.zeros(0, dtype=bool)
        )
