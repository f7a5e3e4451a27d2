"""The bas-relief ambiguity: a scene that is nearer and flatter, from cameras that turn less or more.

A few frames with little perspective hardly tell how far a scene is: seen from the same places, one at a third
of the distance with a ninth of the relief looks almost alike when the cameras turn otherwise (Belhumeur et
al. 1999, "The bas-relief ambiguity"). An adjustment creeps along this valley and stops before its end.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import exp_so3, invert_transform, transform_points
from semcast.server.mapping.bundle_problem import BundleProblem

Array = NDArray[np.float64]


def nearer(problem: BundleProblem, factor: float) -> BundleProblem:
    """Return the same problem started from a scene that is ``factor`` times nearer and flatter.

    Cameras stay where they are and turn so that they see the middle of the scene where they saw it; points
    stay on the rays of the first one. Parallax grows with the factor and relief shrinks with its square:
    to first order, the images stay the same.
    """
    T_world_first = problem.T_world_cam[0]
    xyz = transform_points(invert_transform(T_world_first), problem.xyz)
    middle = np.median(xyz, axis=0)
    z = middle[2] / factor + (xyz[:, 2] - middle[2]) / factor**2
    before, after = transform_points(T_world_first, np.stack((middle, middle / factor)))
    poses = problem.T_world_cam.copy()
    for T in poses[1:]:
        T[:3, :3] = T[:3, :3] @ _turn((before - T[:3, 3]) @ T[:3, :3], (after - T[:3, 3]) @ T[:3, :3])
    on_rays = xyz * (z / np.maximum(xyz[:, 2], 1e-9))[:, None]
    return replace(problem, T_world_cam=poses, xyz=transform_points(T_world_first, on_rays))


def _turn(a: Array, b: Array) -> Array:
    """Smallest rotation ``(3, 3)`` that takes direction ``a`` to ``b``."""
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    return exp_so3(axis / max(sine, 1e-12) * np.arctan2(sine, float(a @ b)))
