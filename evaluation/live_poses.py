"""Poses as they were published with their frames: how far off they are, and whether they say so."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import project_to_so3
from semcast.common.trajectory import Trajectory
from semcast.common.trajectory_error import ate, completeness, match_times, rotation_angles_rad
from semcast.server.export.outputs import trajectory_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LivePose:
    """What was published for one frame.

    Attributes:
        T_world_cam: ``(4, 4)``.
        covariance: ``(6, 6)`` in the camera's frame, rotation before translation, or None.
    """

    T_world_cam: Array
    covariance: Array | None


def live_figures(
    published: Mapping[int, LivePose],
    frame_times_ns: Mapping[int, int],
    truth: Trajectory | None,
    num_sent: int,
) -> dict[str, float | None]:
    """Return the figures of the poses as they were published, before any later image corrected them.

    Args:
        published: By frame, for those that had a pose at once, all taken for one world.
        frame_times_ns: Time of each frame.
        truth: Reference poses, or None.
        num_sent: Frames that were sent.

    Returns:
        ``ate_at_once_percent``, after one similarity like ``ate_percent``, and those of ``stated_ratios``,
        None where they have no meaning; ``completeness_at_once``, the share of sent frames with such a pose.
    """
    path = trajectory_of({k: pose.T_world_cam for k, pose in published.items()}, frame_times_ns)
    absolute = ate(path, truth) if truth is not None else None
    return {
        "ate_at_once_percent": None if absolute is None else absolute.percent,
        "completeness_at_once": completeness(len(path), num_sent),
        **stated_ratios(published, frame_times_ns, truth),
    }


def stated_ratios(
    published: Mapping[int, LivePose], frame_times_ns: Mapping[int, int], truth: Trajectory | None
) -> dict[str, float | None]:
    """Compare errors of poses with the covariances they were published with.

    Both are root mean squares over the poses that have a covariance, so that those that claim to be known
    exactly don't outweigh all others. Places are compared after the similarity of the ATE, turns after the
    rotation that fits all of them best: a straight path says nothing about the roll around it.

    Args:
        published: By frame, for those that had a pose at once.
        frame_times_ns: Time of each frame.
        truth: Reference poses, or None.

    Returns:
        ``stated_ratio_trans`` and ``stated_ratio_rot``, error over stated standard deviation: 1 is right, 2
        says that errors are twice what was stated. None where the ATE has no meaning.
    """
    covariance_at = {
        frame_times_ns[k]: pose.covariance for k, pose in published.items() if pose.covariance is not None
    }
    poses = {k: pose.T_world_cam for k, pose in published.items() if pose.covariance is not None}
    path = trajectory_of(poses, frame_times_ns)
    absolute = ate(path, truth) if truth is not None else None
    if truth is None or absolute is None or path.times_ns is None:
        return {"stated_ratio_trans": None, "stated_ratio_rot": None}
    mine, theirs = match_times(path.t_s, truth.t_s)
    variances = np.mean([np.diagonal(covariance_at[int(t)]) for t in path.times_ns[mine]], axis=0)
    R_true, R_found = truth.T_world_cam[theirs, :3, :3], path.T_world_cam[mine, :3, :3]
    R_truth_map = project_to_so3(np.einsum("nij,nkj->ik", R_true, R_found))
    angle_rad = rotation_angles_rad(R_true.transpose(0, 2, 1) @ R_truth_map @ R_found)
    return {
        "stated_ratio_trans": absolute.rmse / absolute.scale / float(np.sqrt(variances[3:].sum())),
        "stated_ratio_rot": float(np.sqrt(np.mean(angle_rad**2) / variances[:3].sum())),
    }
