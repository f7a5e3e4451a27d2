"""A finished run in a frame and unit other than the map's own: metres, and axes that mean something.

A single moving camera knows neither metre nor upright. Both come from outside: a path of the camera in a
known frame (satellites, wheels, motion capture), or a marker of known size (``markers``).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.errors import SourceError
from semcast.common.geometry import (
    align_umeyama,
    exp_so3,
    project_to_so3,
    quat_wxyz_from_rotation,
    rotation_angle_deg,
)
from semcast.common.run_folder import RunData
from semcast.common.sequence import truth_at_frames
from semcast.common.times import ns_to_seconds
from semcast.common.trajectory import Trajectory
from semcast.common.trajectory_error import MIN_MATCHES, match_times
from semcast.server.export.poses import rising_times

Array = NDArray[np.float64]

#: Standard deviations to either side that hold 95 % of a normal distribution.
TWO_SIDED_95 = 1.96
#: A path that is this much longer than wide says nothing about the rotation about itself.
STRAIGHT = 50.0
#: Directions of cameras that differ by more than this from those the positions give are not of the cameras.
_AGREEING_DEG = 15.0


@dataclass(frozen=True)
class Placement:
    """A similarity: ``p_placed = scale * R @ p_map + t``.

    Attributes:
        scale: Units of the placed frame, in general metres, per map unit.
        R: 3x3 rotation from the map's axes to the placed ones.
        t: Where the map's origin is, length 3.
        frame: What the placed axes and unit are.
        words: One line that says what it was taken from, and how well that fits.
    """

    scale: float
    R: Array
    t: Array
    frame: str
    words: str

    def points(self, xyz: Array) -> Array:
        """Return ``(N, 3)`` points of the map in the placed frame."""
        return self.scale * np.asarray(xyz, dtype=np.float64) @ self.R.T + self.t

    def run(self, data: RunData) -> RunData:
        """Return the run in the placed frame: poses and landmarks; what was seen in images stays as it is."""
        T_placed_cam = data.T_world_cam.copy()
        T_placed_cam[:, :3, :3] = self.R @ data.T_world_cam[:, :3, :3]
        T_placed_cam[:, :3, 3] = self.points(data.T_world_cam[:, :3, 3])
        return replace(data, T_world_cam=T_placed_cam, xyz=self.points(data.xyz))


def place_by_run(data: RunData) -> Placement:
    """Return the way to metres, and to the frame of a marker, that the run itself found (``--marker-m``).

    Args:
        data: The run, of one part.

    Raises:
        SourceError: The run does not know the metre of this part.
    """
    part = int(data.frame_submap[0]) if len(data.frame_submap) else 0
    known = next((metres for metres in data.metres if metres.part == part), None)
    if known is None:
        others = ", ".join(str(metres.part) for metres in data.metres)
        there = f", only of part {others}" if others else ""
        raise SourceError(
            f"the run does not know the metre of part {part}{there}: run again with --marker-m, or export "
            "with --marker-m or --align"
        )
    T = known.T_marker_world
    return Placement(
        known.m_per_unit,
        T[:3, :3],
        T[:3, 3],
        f"x right, y up, z out of marker {known.marker_id}; metres",
        f"marker {known.marker_id}: {known.num_keyframes} keyframes of the run; 1 unit of the map is "
        f"{known.m_per_unit:.4g} m, within {100 * TWO_SIDED_95 * known.relative_sigma:.2g} % (95 %)",
    )


def _span(t_s: Array) -> str:
    return f"{t_s.min():.1f} to {t_s.max():.1f} s" if len(t_s) else "no time"


def place_by_path(data: RunData, known: Trajectory) -> Placement:
    """Return the similarity that brings a run's camera path onto a known one.

    Positions decide. Only on a straight path, where they leave the rotation about it open, do the known
    directions, which then have to be those of the camera (x right, y down, z forward). Frames whose time does
    not increase are left out: nothing tells which of two at one time a known pose is of.

    Args:
        data: The run, of one part.
        known: Poses of the camera at their own times, on the clock of the run's ``t_source_ns``.

    Raises:
        SourceError: The two have too few times in common, one of them does not move, or the path is straight
            and the known directions are not the camera's.
    """
    # Known poses may come at uneven times, and fewer of them than frames: one may be absent between two.
    gap_s = 2.0 * float(np.median(np.diff(known.t_s))) if len(known) > 1 else 0.0
    rising = rising_times(data.t_source_ns)
    times_ns, T_world_cam = data.t_source_ns[rising], data.T_world_cam[rising]
    at_frames = truth_at_frames(known, times_ns, gap_s)
    matched = np.zeros((2, 0), dtype=np.int64)
    if at_frames is not None:
        matched = np.stack(match_times(ns_to_seconds(times_ns), at_frames.t_s))
    if at_frames is None or matched.shape[1] < MIN_MATCHES:
        raise SourceError(
            f"the known path must have a pose at the time of {MIN_MATCHES} posed frames or more, "
            f"got {matched.shape[1]} of {len(data.frame_ids)}: it has {_span(known.t_s)}, the frames "
            f"{_span(ns_to_seconds(times_ns))}"
        )
    T_map_cam, T_known_cam = T_world_cam[matched[0]], at_frames.T_world_cam[matched[1]]
    p_map, p_known = T_map_cam[:, :3, 3], T_known_cam[:, :3, 3]
    if not (np.ptp(p_map, axis=0).any() and np.ptp(p_known, axis=0).any()):
        raise SourceError("the camera must move to be aligned with a known path, got a path of one place")
    scale, R, t = align_umeyama(p_map, p_known)
    # The noise of satellites gives a known path a width that the camera's own does not have.
    if _is_straight(p_map) or _is_straight(p_known):
        R = _turned_about_path(R, p_known, T_map_cam, T_known_cam)
        t = p_known.mean(axis=0) - scale * R @ p_map.mean(axis=0)
    rms = float(np.sqrt(((scale * p_map @ R.T + t - p_known) ** 2).sum(axis=1).mean()))
    words = (
        f"aligned with {len(p_map)} known poses, {rms:.3g} units of the path apart (RMS); "
        f"1 unit of the map is {scale:.4g} units of the path"
    )
    return Placement(scale, R, t, "axes and unit of the known path", words)


def _is_straight(positions: Array) -> bool:
    length, width, _ = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    return bool(length > STRAIGHT * width)


def _turned_about_path(R: Array, p_known: Array, T_map_cam: Array, T_known_cam: Array) -> Array:
    """Turn an alignment about a straight path until the cameras' directions agree as well as they can.

    Raises:
        SourceError: By their directions the path itself would point elsewhere.
    """
    by_direction = project_to_so3(np.einsum("nij,nkj->ik", T_known_cam[:, :3, :3], T_map_cam[:, :3, :3]))
    along = np.linalg.svd(p_known - p_known.mean(axis=0))[2][0]
    w, *v = quat_wxyz_from_rotation(by_direction @ R.T)
    twist = exp_so3(2.0 * np.arctan2(np.dot(v, along), w) * along)
    if rotation_angle_deg(by_direction @ (twist @ R).T) > _AGREEING_DEG:
        raise SourceError(
            "the known path is straight, so its directions must be those of the camera (x right, y down, "
            "z forward) to say what is up; they are not"
        )
    return np.asarray(twist @ R)
