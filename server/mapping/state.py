"""What goes into the reconstruction, what comes out of it, and the states it can be in."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from semcast.common.shapes import check_shape

Array = NDArray[np.float64]


class TrackingState(str, Enum):
    """Where the tracker stands after a frame."""

    INITIALIZING = "initializing"
    TRACKING = "tracking"
    LOST = "lost"


@dataclass(frozen=True)
class DecodedFrame:
    """One received frame.

    Attributes:
        frame_id: Index in the source; gaps are frames that were lost.
        t_source_ns: Recorded time of the frame.
        image: ``(H, W, 3)`` uint8 RGB without distortion.
        confidence: ``(H, W)`` float32 in [0, 1], or None where the codec gives none.
        keypoint_confidence: ``(H, W)`` float32 in [0, 1] trained on keypoint displacement, or None.
        slot_snr_db: ``(num_slots,)`` SNR of each 16-pixel band, ``ReceivedImage.row_snr_db``, or None.
    """

    frame_id: int
    t_source_ns: int
    image: NDArray[np.uint8]
    confidence: NDArray[np.float32] | None = None
    keypoint_confidence: NDArray[np.float32] | None = None
    slot_snr_db: NDArray[np.float32] | None = None

    def check(self, shape_hw: tuple[int, int]) -> None:
        """Check that image and confidence maps are of a camera's size, and that all hold what they should.

        Raises:
            ValueError: An array has another shape or number type.
        """
        height, width = shape_hw
        check_shape(self.image, f"{height} {width} 3", "image")
        if self.image.dtype != np.uint8:
            raise ValueError(f"image must be uint8, got {self.image.dtype}")
        for name in ("confidence", "keypoint_confidence"):
            values = getattr(self, name)
            if values is not None:
                check_shape(values, f"{height} {width}", name)
                if values.dtype.kind != "f":
                    raise ValueError(f"{name} must be floating point in [0, 1], got {values.dtype}")
        if self.slot_snr_db is not None:
            check_shape(self.slot_snr_db, "num_slots", "slot_snr_db")


@dataclass(frozen=True)
class FrameResult:
    """What one frame led to.

    Attributes:
        frame_id: As received.
        t_source_ns: As received.
        state: After the frame.
        T_world_cam: ``(4, 4)``, or None where the frame has no pose (yet).
        num_tracked: Keypoints in sight: followed into the frame, or begun in it.
        num_inliers: Landmark observations that agree with the pose.
        reprojection_error_px: Median over inliers, or None without a pose.
        covariance: ``(6, 6)`` of the pose in the camera frame, rotation before translation (gtsam's order),
            or None; see ``pose_covariance``.
        is_keyframe: Whether it became a keyframe.
        map_epoch: Counts resets; poses of two epochs have unrelated world frames.
        submap: Part of the map the frame belongs to. A new part's place and scale in the world are guessed
            until it meets an older one and becomes part of it.
        keypoints_xy: ``(N, 2)`` float32 pixels.
        keypoint_inlier: ``(N,)`` bool, agrees with the pose.
        backfilled: ``(frame_id, t_source_ns, T_world_cam)`` of earlier frames that got their pose only now.
        stage_ms: Duration of each stage that ran.
    """

    frame_id: int
    t_source_ns: int
    state: TrackingState
    T_world_cam: Array | None
    num_tracked: int
    num_inliers: int
    reprojection_error_px: float | None
    covariance: Array | None
    is_keyframe: bool
    map_epoch: int
    submap: int
    keypoints_xy: NDArray[np.float32]
    keypoint_inlier: NDArray[np.bool_]
    backfilled: tuple[tuple[int, int, Array], ...] = ()
    stage_ms: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Marker:
    """A printed marker in the map, that tells what a unit of it is.

    Attributes:
        corners_map: ``(4, 3)`` round its square, ``(0, 3)`` where none tells anything any more.
        words: What it tells.
    """

    corners_map: Array
    words: str


@dataclass(frozen=True)
class MapUpdate:
    """What changed in the map since the last update was taken.

    Attributes:
        map_epoch: Of the map.
        ids: ``(N,)`` int64, landmarks added or moved.
        xyz: ``(N, 3)`` their positions in the world frame.
        rgb: ``(N, 3)`` uint8 colours.
        confidence: ``(N,)`` float32 in [0, 1].
        removed: ``(M,)`` int64, landmarks that are gone.
        keyframe_ids: ``(K,)`` int64 frame ids of keyframes added or moved.
        keyframe_poses: ``(K, 4, 4)`` their ``T_world_cam``.
        frame_ids: ``(F,)`` int64, frames that moved otherwise than with their keyframe: in scale, too.
        frame_poses: ``(F, 4, 4)`` their ``T_world_cam``.
        withdrawn: ``(W,)`` int64, frames whose pose was taken back.
        marker: As the map has it now; None while none tells anything.
    """

    map_epoch: int
    ids: NDArray[np.int64]
    xyz: Array
    rgb: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    removed: NDArray[np.int64]
    keyframe_ids: NDArray[np.int64]
    keyframe_poses: Array
    frame_ids: NDArray[np.int64]
    frame_poses: Array
    withdrawn: NDArray[np.int64]
    marker: Marker | None = None
