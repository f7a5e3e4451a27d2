"""Trajectories as text: TUM with times, KITTI odometry without."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semcast.common.run_folder import RunData
from semcast.common.times import ns_to_seconds
from semcast.common.trajectory import Trajectory, seconds_of, write_tum
from semcast.common.whole_file import write_whole


def rising_times(times_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mark the times ``(N,)`` that are later than all before them: a source may have begun anew."""
    return np.concatenate([[True], times_ns[1:] > np.maximum.accumulate(times_ns)[:-1]])[: len(times_ns)]


def write_run_tum(path: Path, data: RunData) -> list[Path]:
    """Write ``t tx ty tz qx qy qz qw`` of all posed frames; returns the file.

    Frames whose time does not increase are left out: the format is ordered by time.
    """
    rising = rising_times(data.t_source_ns)
    path.parent.mkdir(parents=True, exist_ok=True)
    times_ns = data.t_source_ns[rising]
    write_tum(path, Trajectory(ns_to_seconds(times_ns), data.T_world_cam[rising], times_ns))
    return [path]


def write_run_kitti(path: Path, data: RunData) -> list[Path]:
    """Write the upper 3x4 of ``T_world_cam``, row by row, one line a posed frame.

    The format has neither times nor frame numbers: ``<name>.times.txt`` (seconds) and ``<name>.frames.txt``
    (frame ids) go beside it. Returns the files.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    times, frames = (path.with_name(f"{path.stem}.{what}.txt") for what in ("times", "frames"))
    poses = data.T_world_cam[:, :3].reshape(-1, 12)
    write_whole(path, "".join(" ".join(f"{v:.12e}" for v in row) + "\n" for row in poses.tolist()))
    write_whole(times, "".join(f"{seconds_of(t)}\n" for t in data.t_source_ns.tolist()))
    write_whole(frames, "".join(f"{k}\n" for k in data.frame_ids.tolist()))
    return [path, times, frames]
