"""A graph of keyframes held by what is known of each pair, solved for similarities with GTSAM.

A map made by one camera drifts in scale as well, so a keyframe has a scale next to its pose: how large the
unit is that its surroundings were built in (Strasdat, Montiel and Davison 2010).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from numpy.typing import NDArray

from semcast.common.geometry import make_transform, project_to_so3

Array = NDArray[np.float64]

_MAX_ITERATIONS = 20
#: Holds a pose that is fixed: radians and map units.
FIXED_SIGMA = 1e-6


@dataclass(frozen=True)
class PoseConstraint:
    """What is known of two keyframes.

    Attributes:
        first: Row of one.
        second: Row of the other.
        T_first_second: ``(4, 4)`` pose of the second in the frame and the unit of the first.
        scale: Units of the first in one unit of the second.
        sigma: Standard deviations of rotation in radians, of translation in units of the first, and of the
            logarithm of the scale.
    """

    first: int
    second: int
    T_first_second: Array
    scale: float
    sigma: tuple[float, float, float]


@dataclass(frozen=True)
class SolvedGraph:
    """Where the keyframes are.

    Attributes:
        T_world_cam: ``(K, 4, 4)`` poses.
        scale: ``(K,)`` units of the world in one unit of a keyframe's surroundings.
        cost: Half the sum of squared errors in standard deviations that is left.
    """

    T_world_cam: Array
    scale: Array
    cost: float


def solve_graph(T_world_cam: Array, constraints: Sequence[PoseConstraint]) -> SolvedGraph | None:
    """Find the poses and scales that agree best with the constraints; the first keyframe stays.

    Args:
        T_world_cam: ``(K, 4, 4)`` poses to begin with, all of scale 1.
        constraints: They must join all keyframes.

    Returns:
        The solution, None where there is none.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, T in enumerate(T_world_cam):
        values.insert(X(k), _similarity(T, 1.0))
    fixed = gtsam.noiseModel.Isotropic.Sigma(7, FIXED_SIGMA)
    graph.add(gtsam.PriorFactorSimilarity3(X(0), values.atSimilarity3(X(0)), fixed))
    for constraint in constraints:
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(constraint.sigma, (3, 3, 1)))
        between = _similarity(constraint.T_first_second, constraint.scale)
        graph.add(gtsam.BetweenFactorSimilarity3(X(constraint.first), X(constraint.second), between, noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_MAX_ITERATIONS)
    try:
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
        solved = optimiser.optimize()
    except RuntimeError:  # an indeterminate system
        return None
    found = [solved.atSimilarity3(X(k)) for k in range(len(T_world_cam))]
    scale = np.array([s.scale() for s in found])
    T = np.stack([make_transform(s.rotation().matrix(), s.transformFrom(np.zeros(3))) for s in found])
    if not (np.isfinite(T).all() and np.isfinite(scale).all() and (scale > 0).all()):
        return None
    return SolvedGraph(T, scale, float(optimiser.error()))


def _similarity(T: Array, scale: float) -> gtsam.Similarity3:
    """Similarity ``x' = scale R x + t``; GTSAM writes it as ``scale (R x + t / scale)``."""
    return gtsam.Similarity3(gtsam.Rot3(project_to_so3(T[:3, :3])), T[:3, 3] / scale, scale)
