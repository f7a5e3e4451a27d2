"""Bundle adjustment problems and results, as plain arrays that travel between processes."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.geometry.edges import alike, each_of, whitened
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.observations import Observations
from semcast.server.mapping.pose_graph import PoseConstraint
from semcast.server.worker import Runner

Array = NDArray[np.float64]

#: What solves a window; both converge to the same minimum.
Solver = Literal["dense", "gtsam"]


@dataclass(frozen=True)
class ViewMotion:
    """How views moved while their images were read.

    Attributes:
        size_wh: Of the images, pixels.
        velocity: ``(K, 6)`` of each view in its own frame, rotation (rad/s) before translation (map units/s);
            NaN where unknown.
        distortion: OpenCV coefficients of the lens that the images were put right for.
        put_right_px: ``(M, 2)`` how much further each observation is in its image as received, before that
            was put right for its readout; None where only what is left of a readout is asked for.
    """

    size_wh: tuple[int, int]
    velocity: Array
    distortion: tuple[float, ...] = ()
    put_right_px: Array | None = None


@dataclass(frozen=True)
class BundleProblem:
    """A window of keyframes and the landmarks they see.

    Attributes:
        camera: Pinhole; distortion is not looked at.
        keyframe_ids: ``(K,)`` int64 frame ids, in order of time.
        T_world_cam: ``(K, 4, 4)``.
        fixed: ``(K,)`` bool, poses that hold the gauge; at least one.
        keep_baseline: The distance between the newest fixed keyframe and the free one furthest from it is
            held too, for a window whose fixed poses don't tell its scale.
        landmark_ids: ``(P,)`` int64.
        xyz: ``(P, 3)`` world frame.
        view: ``(M,)`` keyframe of each observation.
        point: ``(M,)`` landmark of each observation.
        xy: ``(M, 2)`` pixels.
        sigma_px: ``(M,)`` standard deviation per coordinate.
        confidence: ``(M,)`` of each observation, handed through.
        iterations: Levenberg-Marquardt steps at most.
        num_anchors: So many of the first keyframes are of long ago; they are held, and only what the others
            see is adjusted.
        with_covariance: Whether it is wanted how well the poses are known,
        sets_unit: and whether that is in the unit that the keyframes set, see ``window_covariance``.
        huber_px: See ``NoiseModel``.
        edge: ``(M, 2)`` of each observation, see ``edges``.
        motion: Of the views, where it is wanted what the residuals say about shutter and lens.
        solver: Of small problems; large ones, and those with ``steps``, are GTSAM's in any case.
        steps: What is known of pairs of views besides what they saw; scales are not looked at.
    """

    camera: Intrinsics
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
    num_anchors: int = 0
    with_covariance: bool = True
    sets_unit: bool = False
    huber_px: float | None = None
    motion: ViewMotion | None = None
    edge: Array = field(default_factory=alike)
    solver: Solver = "dense"
    steps: tuple[PoseConstraint, ...] = ()

    def __post_init__(self) -> None:
        """Have an edge for each observation."""
        object.__setattr__(self, "edge", each_of(self.edge, len(self.xy)))


class Frame(Protocol):
    """Anything with a frame id: a keyframe, or a frame that waits for a map."""

    @property
    def frame_id(self) -> int:
        """Its number in the stream."""


def assemble_problem(
    camera: Intrinsics,
    views: Sequence[Frame],
    T_world_cam: Array,
    landmark_ids: NDArray[np.int64],
    xyz: Array,
    seen: Observations,
    noise: NoiseModel,
    *,
    fixed: NDArray[np.bool_],
    keep_baseline: bool,
    iterations: int,
) -> BundleProblem:
    """Put a problem together from what views saw; no covariance is asked for.

    Args:
        camera: Pinhole.
        views: In order of time.
        T_world_cam: ``(K, 4, 4)`` of the views.
        landmark_ids: ``(P,)``.
        xyz: ``(P, 3)`` where they are.
        seen: Observations, with rows into ``landmark_ids``.
        noise: Gives each observation its sigma, and Huber's threshold.
        fixed: ``(K,)`` bool, see ``BundleProblem``.
        keep_baseline: See ``BundleProblem``.
        iterations: Levenberg-Marquardt steps at most.
    """
    return BundleProblem(
        camera=camera,
        keyframe_ids=np.array([frame.frame_id for frame in views], dtype=np.int64),
        T_world_cam=T_world_cam,
        fixed=fixed,
        keep_baseline=keep_baseline,
        landmark_ids=landmark_ids,
        xyz=xyz,
        view=seen.view,
        point=seen.point,
        xy=seen.xy,
        sigma_px=noise.sigma_px(seen.confidence),
        confidence=seen.confidence,
        iterations=iterations,
        with_covariance=False,
        huber_px=noise.huber_px,
        edge=seen.edge,
    )


@dataclass(frozen=True)
class BundleResult:
    """The adjusted window.

    Attributes:
        problem: What was asked.
        ok: False where the system was indeterminate or got no better; poses and points are then as asked.
        T_world_cam: ``(K, 4, 4)``.
        xyz: ``(P, 3)``.
        residual_px: ``(M, 2)`` observed minus projected, NaN behind the camera or not used.
        covariances: ``(K, 7, 7)``, how well each keyframe is known against those that are fixed, see
            ``window_covariance``; None where it was not asked for, or nothing fixes the window.
        elapsed_ms: Time it took.
        pattern_products: ``(K, 9, 9)``, see ``residual_patterns``; None where ``motion`` was not given.
    """

    problem: BundleProblem
    ok: bool
    T_world_cam: Array
    xyz: Array
    residual_px: Array
    covariances: Array | None
    elapsed_ms: float
    pattern_products: Array | None = None

    @cached_property
    def whitened_px(self) -> Array:
        """``(M, 2)`` residuals scaled so that their noise is isotropic, see ``edges``."""
        return whitened(self.problem.edge, self.residual_px)


#: Runs bundle adjustments.
BundleRunner = Runner[BundleProblem, BundleResult]
