"""What the viewer is shown of a frame: one that was tracked, or one of which no image came."""

from collections.abc import Mapping

import numpy as np

from semcast.common.codec import OUTAGE_GREY
from semcast.common.metrics import DUPLICATE
from semcast.server.decoder import DecodedArrival
from semcast.server.frame_rows import FrameRow
from semcast.server.mapping.state import DecodedFrame, FrameResult
from semcast.server.view.frame_view import MISSING, FrameView

#: Stages in the viewer's plot; all of them are in ``frames.jsonl`` and the summary.
PLOTTED_STAGES = ("decode", "track", "map", "bundle")


def frame_view(
    frame: DecodedFrame, result: FrameResult, row: FrameRow, drops: Mapping[str, int]
) -> FrameView:
    """Return what the viewer shows of a tracked frame; unknown values have no point in the plots.

    Args:
        frame: As decoded.
        result: What the tracker made of it.
        row: The frame's row.
        drops: Frames that were dropped up to now, by reason.
    """
    scalars: dict[str, float | None] = {
        "link/snr_set_db": row.snr_set_db,
        "link/snr_estimated_db": row.snr_estimated_db,
        "link/psnr_db": row.psnr_db,
        "tracking/tracked": float(row.num_tracked),
        "tracking/inliers": float(row.num_inliers),
        "error/reprojection_error_px": row.reprojection_error_px,
        "latency/arrival_to_pose_ms": row.age_ms,
        **{f"latency/{stage}_ms": row.stage_ms.get(stage) for stage in PLOTTED_STAGES},
        **_dropped(drops),
    }
    return FrameView(
        frame_id=frame.frame_id,
        t_source_ns=frame.t_source_ns,
        T_world_cam=result.T_world_cam,
        state=result.state.value,
        scalars=_known(scalars),
        image=frame.image,
        confidence=frame.confidence,
        keypoints_xy=result.keypoints_xy,
        keypoint_inlier=result.keypoint_inlier,
        backfilled=result.backfilled,
    )


def missing_view(decoded: DecodedArrival, drops: Mapping[str, int]) -> FrameView:
    """Return what the viewer shows of a frame without an image.

    Of one that could not be decoded that is grey without confidence; of one that was lost on the air only the
    counts, and the image before it stays.

    Args:
        decoded: The frame, whose ``frame`` is None.
        drops: Frames that were dropped up to now, by reason.
    """
    arrival = decoded.arrival
    height, width = arrival.camera.intrinsics.shape_hw
    arrived = arrival.received is not None
    scalars = {
        "link/snr_set_db": arrival.snr_db_set,
        "link/snr_estimated_db": arrival.snr_db,
        **_dropped(drops),
    }
    return FrameView(
        frame_id=arrival.message.frame_id,
        t_source_ns=arrival.message.t_source_ns,
        T_world_cam=None,
        state=MISSING,
        scalars=_known(scalars),
        image=np.full((height, width, 3), OUTAGE_GREY, np.uint8) if arrived else None,
        confidence=np.zeros((height, width), np.float32) if arrived else None,
        keypoints_xy=np.zeros((0, 2), np.float32),
        keypoint_inlier=np.zeros(0, bool),
    )


def _dropped(drops: Mapping[str, int]) -> dict[str, float]:
    """Return the counts in the plot of drops: of a frame that came twice nothing is lost."""
    lost = {reason: float(count) for reason, count in drops.items() if reason != DUPLICATE}
    return {"drops/all": sum(lost.values(), 0.0), **{f"drops/{reason}": n for reason, n in lost.items()}}


def _known(scalars: Mapping[str, float | None]) -> dict[str, float]:
    return {path: value for path, value in scalars.items() if value is not None and np.isfinite(value)}
