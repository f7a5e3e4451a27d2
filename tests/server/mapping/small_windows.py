"""Windows of a few views for bundle adjustment, with what is true of them."""

import numpy as np

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_se3, exp_so3, invert_transform, make_transform, transform_points
from semcast.server.mapping.bundle_problem import BundleProblem

CAMERA = Intrinsics(fx=500.0, fy=480.0, cx=320.0, cy=240.0, width=640, height=480)


def make_problem(seed=0, num_views=6, num_points=60, noise_px=0.3, shake=0.02, sigma_px=None, **changes):
    """A window with known truth whose start is shaken; the two oldest poses are exact and fixed."""
    rng = np.random.default_rng(seed)
    T_world_cam = np.stack(
        [
            make_transform(exp_so3(rng.normal(0, 0.03, 3)), (0.4 * k, 0.1 * rng.normal(), 0.1 * k))
            for k in range(num_views)
        ]
    )
    xyz = rng.uniform((-2, -1.5, 5), (4, 1.5, 12), (num_points, 3))
    view, point = (a.ravel() for a in np.meshgrid(np.arange(num_views), np.arange(num_points), indexing="ij"))
    cam = np.stack([transform_points(invert_transform(T), xyz) for T in T_world_cam]).reshape(-1, 3)
    xy = CAMERA.project(cam)
    sigma = np.full(len(xy), noise_px) if sigma_px is None else sigma_px(view, point, rng)
    xy = xy + rng.normal(0, 1, xy.shape) * sigma[:, None]
    start = np.stack(
        [T if k < 2 else T @ exp_se3(rng.normal(0, shake, 6)) for k, T in enumerate(T_world_cam)]
    )
    values = {
        "camera": CAMERA,
        "keyframe_ids": np.arange(num_views),
        "T_world_cam": start,
        "fixed": np.arange(num_views) < 2,
        "keep_baseline": False,
        "landmark_ids": np.arange(num_points),
        "xyz": xyz + rng.normal(0, shake, xyz.shape),
        "view": view,
        "point": point,
        "xy": xy,
        "sigma_px": np.maximum(sigma, 0.1),
        "confidence": np.ones(len(xy)),
        "iterations": 12,
    }
    return BundleProblem(**{**values, **changes}), T_world_cam, xyz


def pose_error(result, truth):
    return np.linalg.norm(result.T_world_cam[:, :3, 3] - truth[:, :3, 3], axis=1).max()
