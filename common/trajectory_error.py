"""How far an estimated trajectory is from the truth: ATE after Sim(3), RPE per frame, completeness.

A monocular map has neither metre nor origin, so every figure here is taken after the similarity that fits the
estimate to the truth best (Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, 2012).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import align_umeyama, invert_transform
from semcast.common.trajectory import Trajectory

Array = NDArray[np.float64]

#: Fewer matched poses say nothing: two are always fitted without error.
MIN_MATCHES = 3


@dataclass(frozen=True)
class AteResult:
    """Absolute trajectory error after Sim(3) alignment.

    Attributes:
        rmse: Root mean square distance between matched camera centres, in the truth's unit.
        percent: ``rmse`` as percentage of the truth's whole path.
        path_length: Length of the truth's whole path, in its unit.
        scale: Units of the truth per map unit: ``p_truth = scale * R_truth_map @ p_map + t_truth_map``.
        R_truth_map: 3x3 rotation of the alignment.
        t_truth_map: Translation of the alignment, length 3.
        t_s: ``(N,)`` times of the matched poses.
        error: ``(N,)`` distances in the truth's unit.
        in_metres: Whether that unit is the metre; else it is not known.
    """

    rmse: float
    percent: float
    path_length: float
    scale: float
    R_truth_map: Array
    t_truth_map: Array
    t_s: Array
    error: Array
    in_metres: bool

    @property
    def unit(self) -> str:
        """The truth's unit in words."""
        return "m" if self.in_metres else "units of the truth"


@dataclass(frozen=True)
class RpeResult:
    """Relative pose error between consecutive matched poses, the estimate scaled by the Sim(3) of the ATE.

    Attributes:
        trans_percent: Root mean square translation error of one step as percentage of the true one.
        rot_deg: Root mean square rotation error of one step in degrees.
    """

    trans_percent: float
    rot_deg: float


def match_times(estimate_s: Array, truth_s: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pair every estimated time with the nearest true time, each true time at most once.

    Those further apart than half the median interval of the denser one are left out: a true pose at every
    tenth frame is not that of the frames around where its own has no estimate.

    Args:
        estimate_s: ``(N,)`` increasing seconds.
        truth_s: ``(M,)`` increasing seconds.

    Returns:
        Indices into ``estimate_s`` and ``truth_s``, both increasing.
    """
    empty = np.zeros(0, dtype=np.int64)
    if len(estimate_s) == 0 or len(truth_s) == 0:
        return empty, empty
    steps_s = [float(np.median(np.diff(t_s))) for t_s in (estimate_s, truth_s) if len(t_s) > 1]
    max_gap_s = min(steps_s, default=0.0) / 2
    after = np.clip(np.searchsorted(truth_s, estimate_s), 0, len(truth_s) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(estimate_s - truth_s[before] < np.abs(truth_s[after] - estimate_s), before, after)
    gap_s = np.abs(truth_s[nearest] - estimate_s)
    estimate_idx = np.flatnonzero(gap_s <= max_gap_s + 1e-9)
    # Of several estimates at one true pose the closest stays.
    order = np.lexsort((gap_s[estimate_idx], nearest[estimate_idx]))
    _, first = np.unique(nearest[estimate_idx][order], return_index=True)
    kept = np.sort(estimate_idx[order[first]])
    return kept.astype(np.int64), nearest[kept].astype(np.int64)


def ate(estimate: Trajectory, truth: Trajectory) -> AteResult | None:
    """Return the absolute trajectory error after Sim(3) alignment of matched camera centres.

    Args:
        estimate: Poses in the map's frame and unit.
        truth: Reference poses.

    Returns:
        None where the error has no meaning: fewer than ``MIN_MATCHES`` matched poses, or a camera that
        moves from none of them to another, by the truth or by the estimate.
    """
    estimate_idx, truth_idx = match_times(estimate.t_s, truth.t_s)
    p_map, p_truth = estimate.positions[estimate_idx], truth.positions[truth_idx]
    if len(p_map) < MIN_MATCHES or not (_has_extent(p_map) and _has_extent(p_truth)):
        return None
    scale, R, t = align_umeyama(p_map, p_truth)
    error = np.linalg.norm(scale * p_map @ R.T + t - p_truth, axis=1)
    rmse = float(np.sqrt(np.mean(error**2)))
    return AteResult(
        rmse=rmse,
        percent=100.0 * rmse / truth.path_length,
        path_length=truth.path_length,
        scale=scale,
        R_truth_map=R,
        t_truth_map=t,
        t_s=estimate.t_s[estimate_idx],
        error=error,
        in_metres=truth.in_metres,
    )


def rpe(estimate: Trajectory, truth: Trajectory, scale: float) -> RpeResult | None:
    """Return the error of each step between consecutive matched poses.

    Args:
        estimate: Poses in the map's frame and unit.
        truth: Reference poses.
        scale: Units of the truth per map unit, from ``ate``.

    Returns:
        None with fewer than two matched poses or a true camera that never moves.
    """
    estimate_idx, truth_idx = match_times(estimate.t_s, truth.t_s)
    if len(estimate_idx) < 2:
        return None
    T_world_cam = estimate.T_world_cam[estimate_idx].copy()
    T_world_cam[:, :3, 3] *= scale
    step = invert_transform(T_world_cam[:-1]) @ T_world_cam[1:]
    T_true = truth.T_world_cam[truth_idx]
    true_step = invert_transform(T_true[:-1]) @ T_true[1:]
    # By the places, which are equal where the camera stands: a product of poses is off by rounding.
    step_m = float(np.sqrt(np.mean((np.diff(T_true[:, :3, 3], axis=0) ** 2).sum(axis=1))))
    if step_m == 0.0:
        return None
    error = invert_transform(true_step) @ step
    trans_m = float(np.sqrt(np.mean((error[:, :3, 3] ** 2).sum(axis=1))))
    angle_rad = rotation_angles_rad(error[:, :3, :3])
    return RpeResult(
        trans_percent=100.0 * trans_m / step_m,
        rot_deg=float(np.degrees(np.sqrt(np.mean(angle_rad**2)))),
    )


def completeness(num_posed: int, num_frames: int) -> float:
    """Return the share of frames that got a pose, in [0, 1]; 0 where there were no frames.

    Raises:
        ValueError: More poses than frames, or a negative count.
    """
    if num_posed < 0 or num_frames < num_posed:
        raise ValueError(f"num_posed must be in [0, num_frames], got {num_posed} of {num_frames}")
    return num_posed / num_frames if num_frames else 0.0


def trajectory_summary(
    estimate: Trajectory, truth: Trajectory | None, num_frames: int
) -> dict[str, float | int | None]:
    """Return the figures every run reports; None where one has no meaning.

    Args:
        estimate: All posed frames in the map's frame.
        truth: Reference poses, or None where unknown.
        num_frames: Frames of the source, posed or not.

    Returns:
        ``ate_rmse_m``, ``ate_percent``, ``path_length_m``, ``completeness``, ``rpe_trans_percent``,
        ``rpe_rot_deg``, ``num_posed``, ``num_matched``. Those in metres are None where the truth's unit is
        not known.
    """
    is_metric = truth is not None and truth.in_metres
    absolute = ate(estimate, truth) if truth is not None else None
    relative = rpe(estimate, truth, absolute.scale) if truth is not None and absolute is not None else None
    return {
        "ate_rmse_m": absolute.rmse if absolute and is_metric else None,
        "ate_percent": absolute.percent if absolute else None,
        "path_length_m": truth.path_length if truth is not None and is_metric else None,
        "completeness": completeness(len(estimate), max(num_frames, len(estimate))),
        "rpe_trans_percent": relative.trans_percent if relative else None,
        "rpe_rot_deg": relative.rot_deg if relative else None,
        "num_posed": len(estimate),
        "num_matched": len(absolute.error) if absolute else 0,
    }


def _has_extent(points: Array) -> bool:
    """Tell whether points differ by more than rounding."""
    spread = float(np.abs(points - points.mean(axis=0)).max())
    return spread > 1e-12 * max(1.0, float(np.abs(points).max()))


def rotation_angles_rad(R: Array) -> Array:
    """Angles of ``(N, 3, 3)`` rotations, accurate near 0 where arccos of the trace is not."""
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    trace = np.trace(R, axis1=1, axis2=2)
    return np.asarray(np.arctan2(np.linalg.norm(axis, axis=1), trace - 1.0))
