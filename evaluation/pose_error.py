"""Errors of relative poses of frame pairs: rotation, translation direction, and their summary."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import angle_between_deg, rotation_angle_deg
from semcast.evaluation.statistics import pose_auc_percent

Array = NDArray[np.float64]

#: Both errors of a pair without an estimate: a direction at random is as far off in the mean, and no rotation
#: must not pass for a small one.
FAILED_DEG = 90.0
AUC_THRESHOLDS_DEG = (5, 10, 20)


@dataclass(frozen=True)
class PoseError:
    """Error of one estimated relative pose.

    Attributes:
        rot_deg: Angle between estimated and true rotation, in [0, 180].
        tdir_deg: Angle between estimated and true translation, in [0, 180]: a flipped direction is an error
            of 180, not 0, since a map built on it runs backwards.
        failed: True when there was no estimate.
    """

    rot_deg: float
    tdir_deg: float
    failed: bool = False


def relative_pose_error(T_cam1_cam0: Array | None, T_cam1_cam0_true: Array) -> PoseError:
    """Compare a relative pose of unknown scale with the truth.

    Args:
        T_cam1_cam0: Estimate, 4x4, or None when the estimator gave none: then both errors count as 90
            degrees.
        T_cam1_cam0_true: Truth, 4x4, with a translation.
    """
    if T_cam1_cam0 is None:
        return PoseError(FAILED_DEG, FAILED_DEG, failed=True)
    R_error = T_cam1_cam0[:3, :3] @ T_cam1_cam0_true[:3, :3].T
    return PoseError(
        rotation_angle_deg(R_error), angle_between_deg(T_cam1_cam0[:3, 3], T_cam1_cam0_true[:3, 3])
    )


def summarise_pose_errors(errors: Mapping[str, Array]) -> dict[str, float | int | None]:
    """Return the figures of one mode over its pairs.

    Args:
        errors: ``rot_deg``, ``tdir_deg`` ``(N,)`` and ``failed`` ``(N,)`` bool.

    Returns:
        ``rot_deg_mean``, ``rot_deg_median``, ``tdir_deg_mean``, ``tdir_deg_median``, ``auc5``, ``auc10``,
        ``auc20`` (percent, of the larger of both errors), ``num_pairs``, ``num_failed``; None without pairs.
    """
    rot_deg, tdir_deg = np.asarray(errors["rot_deg"]), np.asarray(errors["tdir_deg"])
    failed = np.asarray(errors["failed"], dtype=bool)
    summary: dict[str, float | int | None] = {}
    for name, values in (("rot_deg", rot_deg), ("tdir_deg", tdir_deg)):
        summary[f"{name}_mean"] = float(values.mean()) if len(values) else None
        summary[f"{name}_median"] = float(np.median(values)) if len(values) else None
    worst_deg = np.where(failed, np.inf, np.maximum(rot_deg, tdir_deg))
    for threshold_deg in AUC_THRESHOLDS_DEG:
        summary[f"auc{threshold_deg}"] = pose_auc_percent(worst_deg, threshold_deg)
    return {**summary, "num_pairs": len(failed), "num_failed": int(failed.sum())}
