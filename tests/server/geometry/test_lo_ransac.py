import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, make_transform, rotation_angle_deg, transform_points
from semcast.server.geometry.lo_ransac import MIN_INLIERS, lo_ransac

CAMERA = Intrinsics(fx=500, fy=480, cx=320, cy=240, width=640, height=480)
OPTIONS = {"max_epipolar_error": 1.0, "max_iterations": 1000, "seed": 0}


def matches(seed, num=80):
    rng = np.random.default_rng(seed)
    T_cam1_cam0 = make_transform(exp_so3(rng.normal(0.0, 0.05, 3)), [0.6, 0.0, 0.8])
    points = rng.uniform((-3, -2, 4), (3, 2, 12), (num, 3))
    return T_cam1_cam0, CAMERA.project(points), CAMERA.project(transform_points(T_cam1_cam0, points))


@pytest.mark.parametrize("seed", range(3))
def test_most_of_the_matches_give_the_pose_with_a_translation_of_length_1(seed):
    T, xy0, xy1 = matches(seed)
    xy1[:20] = np.random.default_rng(seed).uniform((0, 0), (639, 479), (20, 2))
    found = lo_ransac(CAMERA, xy0, xy1, OPTIONS)
    assert rotation_angle_deg(found[:3, :3] @ T[:3, :3].T) < 0.1
    assert found[:3, 3] == pytest.approx(T[:3, 3], abs=0.01)
    assert np.linalg.norm(found[:3, 3]) == pytest.approx(1.0)


def test_too_few_matches_give_nothing():
    _, xy0, xy1 = matches(0, MIN_INLIERS - 1)
    assert lo_ransac(CAMERA, xy0, xy1, OPTIONS) is None
