"""Matches of two images of points, some of them wrong."""

import numpy as np

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, make_transform, transform_points

CAMERA = Intrinsics(fx=500, fy=500, cx=320, cy=240, width=640, height=480)


def make_matches(seed, num=200, outlier_share=0.3, noise_px=0.5, t=None, plane=False):
    rng = np.random.default_rng(seed)
    T = make_transform(exp_so3(rng.normal(0, 0.05, 3)), rng.normal(0, 1, 3) if t is None else t)
    points = rng.uniform((-3, -2, 5), (3, 2, 12), (num, 3))
    if plane:
        points[:, 2] = 6 + 0.3 * points[:, 0]
    xy0, xy1 = CAMERA.project(points), CAMERA.project(transform_points(T, points))
    xy1 = xy1 + rng.normal(0, noise_px, xy1.shape)
    is_outlier = rng.random(num) < outlier_share
    xy1[is_outlier] += rng.uniform(-60, 60, (int(is_outlier.sum()), 2))
    return T, xy0, xy1, is_outlier


def make_far_matches(seed, outlier_share, noise_px):
    """Thirty matches of points 10 to 30 baselines ahead, which a large turn explains nearly as well."""
    rng = np.random.default_rng(seed)
    T = make_transform(exp_so3(rng.normal(0, 0.02, 3)), (0.2, 0.05, 1.0))
    points = rng.uniform((-4, -4, 10), (4, 4, 30), (30, 3))
    xy0, xy1 = CAMERA.project(points), CAMERA.project(transform_points(T, points))
    xy1 = xy1 + rng.normal(0, noise_px, xy1.shape)
    is_outlier = rng.random(30) < outlier_share
    xy1[is_outlier] += rng.uniform(-60, 60, (int(is_outlier.sum()), 2))
    return T, xy0, xy1
