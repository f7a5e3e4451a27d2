"""What bundle adjustment is asked and what it answers: plain arrays that travel between processes."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BundleProblem:
    """A window of keyframes and the landmarks they see.

    Attributes:
        intrinsics: fx, fy, cx, cy in pixels.
        keyframe_ids: ``(K,)`` int64 frame ids, in order of time.
        T_world_cam: ``(K, 4, 4)``.
        fixed: ``(K,)`` bool, poses that hold the gauge; at least one.
        keep_baseline: The distance between the first keyframe and the one furthest from it is held too, for
            a window with a single fixed pose.
        landmark_ids: ``(P,)`` int64.
        xyz: ``(P, 3)`` world frame.
        view: ``(M,)`` keyframe of each observation.
        point: ``(M,)`` landmark of each observation.
        xy: ``(M, 2)`` pixels.
        sigma_px: ``(M,)`` standard deviation per coordinate.
        confidence: ``(M,)`` of each observation, handed through.
        iterations: Levenberg-Marquardt steps at most.
        map_version: Handed through; a result for another map is not applied.
        num_anchors: So many of the first keyframes are of long ago; they are held, and only what the others
            see is adjusted.
        with_covariance: Whether the covariance of the last pose is wanted.
    """

    intrinsics: tuple[float, float, float, float]
    keyframe_ids: NDArray[np.int64]
    T_world_cam: Array
    fixed: NDArray[np.bool_]
    keep_baseline: bool
    landmark_ids: NDArray[np.int64]
    xyz: Array
    view: NDArray[np.intp]
    point: NDArray[np.intp]
    xy: Array
    sigma_px: Array
    confidence: Array
    iterations: int = 6
    map_version: int = 0
    num_anchors: int = 0
    with_covariance: bool = True


@dataclass(frozen=True)
class BundleResult:
    """The adjusted window.

    Attributes:
        problem: What was asked.
        ok: False where the system was indeterminate or got no better; poses and points are then as asked.
        T_world_cam: ``(K, 4, 4)``.
        xyz: ``(P, 3)``.
        residual_px: ``(M, 2)`` observed minus projected, NaN behind the camera or not used.
        covariance: ``(6, 6)`` marginal covariance of the last keyframe's pose in its own frame, rotation
            before translation, or None.
        elapsed_ms: Time it took.
    """

    problem: BundleProblem
    ok: bool
    T_world_cam: Array
    xyz: Array
    residual_px: Array
    covariance: Array | None
    elapsed_ms: float


class BundleRunner(Protocol):
    """Runs bundle adjustments, one at a time."""

    @property
    def busy(self) -> bool:
        """A problem was submitted and its result not taken yet."""

    def submit(self, problem: BundleProblem) -> bool:
        """Start on a problem; False (and nothing happens) while another one is under way."""

    def take(self, wait: bool = False) -> BundleResult | None:
        """Return the result if it is there.

        Args:
            wait: Wait for it, within a deadline, also where the runner would not.
        """

    def close(self) -> None:
        """Free everything. Idempotent."""
