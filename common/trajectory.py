"""Timed camera poses and the TUM text format."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semcast.common.errors import SourceError
from semcast.common.geometry import make_transform, quat_wxyz_from_rotation, rotation_from_quat_wxyz
from semcast.common.text_rows import text_rows
from semcast.common.whole_file import write_whole


@dataclass(frozen=True)
class Trajectory:
    """Camera poses over time.

    Attributes:
        t_s: ``(N,)`` seconds, strictly increasing.
        T_world_cam: ``(N, 4, 4)``, camera axes x right, y down, z forward.
        times_ns: ``(N,)`` the same times exactly, where they came as nanoseconds: seconds since 1970 as a
            float are some 200 ns off.
        in_metres: False where nobody knows the unit, as of a path that was itself found from images. Is asked
            of paths that others are compared with.
    """

    t_s: NDArray[np.float64]
    T_world_cam: NDArray[np.float64]
    times_ns: NDArray[np.int64] | None = None
    in_metres: bool = True

    def __post_init__(self) -> None:
        """Check shapes and order.

        Raises:
            ValueError: Shapes disagree or times do not increase.
        """
        if self.t_s.ndim != 1 or self.T_world_cam.shape != (len(self.t_s), 4, 4):
            raise ValueError(
                f"need (N,) times and (N, 4, 4) poses, got {self.t_s.shape} and {self.T_world_cam.shape}"
            )
        if len(self.t_s) > 1 and not np.all(np.diff(self.t_s) > 0):
            raise ValueError("times must strictly increase")

    def __len__(self) -> int:
        return len(self.t_s)

    @property
    def positions(self) -> NDArray[np.float64]:
        """``(N, 3)`` camera centres in the world frame."""
        return np.asarray(self.T_world_cam[:, :3, 3])

    @property
    def path_length(self) -> float:
        """Sum of the distances between consecutive camera centres, in the trajectory's own unit."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def between(self, start_s: float, end_s: float) -> "Trajectory":
        """Return the poses of a span of time, with the ones that enclose it."""
        first = max(0, int(np.searchsorted(self.t_s, start_s, side="right")) - 1)
        last = int(np.searchsorted(self.t_s, end_s, side="left"))
        span = slice(first, last + 1)
        times_ns = None if self.times_ns is None else self.times_ns[span]
        return replace(self, t_s=self.t_s[span], T_world_cam=self.T_world_cam[span], times_ns=times_ns)


def seconds_of(time_ns: int) -> str:
    """Return a time as decimal seconds with all its nanoseconds, which a float of the year 2026 has not."""
    sign, time_ns = ("-", -time_ns) if time_ns < 0 else ("", time_ns)
    return f"{sign}{time_ns // 10**9}.{time_ns % 10**9:09d}"


def read_tum(path: Path) -> Trajectory:
    """Read ``t tx ty tz qx qy qz qw`` lines (camera to world); ``#`` starts a comment.

    Raises:
        SourceError: The file can't be read, a line has not eight finite numbers, or times do not increase.
    """
    times: list[float] = []
    poses: list[NDArray[np.float64]] = []
    before = ""
    for number, line, fields in text_rows(path):
        try:
            t, tx, ty, tz, qx, qy, qz, qw = numbers = [float(f) for f in fields]
            if not np.isfinite(numbers).all():
                raise ValueError("not finite")
            poses.append(make_transform(rotation_from_quat_wxyz((qw, qx, qy, qz)), (tx, ty, tz)))
        except ValueError as err:
            raise SourceError(f"{path}:{number} must be 't tx ty tz qx qy qz qw', got {line!r}") from err
        if times and not t > times[-1]:
            raise SourceError(
                f"{path}:{number}: times must strictly increase, got {fields[0]} s after {before}"
            )
        before = fields[0]
        times.append(t)
    return Trajectory(np.array(times), np.array(poses).reshape(-1, 4, 4))


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write ``t tx ty tz qx qy qz qw`` lines with nine digits behind the point, all or none of them."""
    times = (
        [f"{t_s:.9f}" for t_s in trajectory.t_s]
        if trajectory.times_ns is None
        else [seconds_of(t_ns) for t_ns in trajectory.times_ns.tolist()]
    )
    rows = ["# t_s tx ty tz qx qy qz qw (camera to world; x right, y down, z forward)"]
    for time, T_world_cam in zip(times, trajectory.T_world_cam, strict=True):
        w, x, y, z = quat_wxyz_from_rotation(T_world_cam[:3, :3])
        numbers = " ".join(f"{v:.9f}" for v in (*T_world_cam[:3, 3], x, y, z, w))
        rows.append(f"{time} {numbers}")
    write_whole(path, "\n".join(rows) + "\n")
