"""Rows of frames as runs write them, and a straight path."""

import numpy as np

from semcast.common.trajectory import Trajectory
from semcast.server.frame_rows import FrameRow


def frame_row(frame_id, **changes):
    """The row of a frame that was tracked, ten frames a second; every fifth one is a keyframe."""
    values = {
        "frame_id": frame_id,
        "t_source_ns": frame_id * 100_000_000,
        "state": "tracking",
        "posed": True,
        "num_tracked": 120,
        "num_inliers": 100,
        "reprojection_error_px": 0.5,
        "is_keyframe": frame_id % 5 == 0,
        "map_epoch": 0,
        "snr_set_db": 10.0,
        "snr_estimated_db": 9.5,
        "psnr_db": 30.0,
        "confidence_mean": 0.9,
        "age_ms": 50.0,
        "stage_ms": {"decode": 20.0, "track": 10.0},
    }
    return FrameRow(**{**values, **changes})


def straight_path(frame_ids):
    """Poses of these frames, a unit forwards from one to the next."""
    poses = np.tile(np.eye(4), (len(frame_ids), 1, 1))
    poses[:, 2, 3] = frame_ids
    return Trajectory(np.array(frame_ids) * 0.1, poses)
