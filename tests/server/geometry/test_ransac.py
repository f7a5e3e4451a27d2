import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import (
    angle_between_deg,
    exp_so3,
    make_transform,
    rotation_angle_deg,
    transform_points,
)
from semcast.server.geometry.epipolar import essential_matrix
from semcast.server.geometry.ransac import algebraic_residual, confidence_ransac, draw_weighted, in_front

CAMERA = Intrinsics(fx=500, fy=500, cx=320, cy=240, width=640, height=480)


def test_first_draws_have_the_given_frequencies():
    q = np.array([0.5, 0.3, 0.15, 0.05])
    draws = draw_weighted(q, 1, 20_000, np.random.default_rng(0))[:, 0]
    share = np.bincount(draws, minlength=4) / len(draws)
    assert np.all(np.abs(share - q) < 4 * np.sqrt(q * (1 - q) / len(draws)))


def test_second_draws_are_without_replacement():
    q = np.array([0.6, 0.3, 0.1])
    draws = draw_weighted(q, 2, 40_000, np.random.default_rng(1))
    assert np.all(draws[:, 0] != draws[:, 1])
    # Given that 0 came first, 1 follows with probability 0.3 / 0.4.
    after_zero = draws[draws[:, 0] == 0, 1]
    share = float((after_zero == 1).mean())
    assert abs(share - 0.75) < 4 * np.sqrt(0.75 * 0.25 / len(after_zero))


def test_an_element_without_probability_comes_last():
    draws = draw_weighted(np.array([0.5, 0.0, 0.5]), 3, 200, np.random.default_rng(2))
    assert np.all(draws[:, 2] == 1)


def test_residual_by_hand():
    # E of a unit step along x is [[0,0,0],[0,0,-1],[0,1,0]]: r = |y0 - y1|.
    E = essential_matrix(make_transform(np.eye(3), (1, 0, 0)))
    rays0, rays1 = np.array([[0.1, 0.25, 1.0]]), np.array([[0.7, 0.05, 1.0]])
    assert algebraic_residual(E, rays0, rays1)[0] == pytest.approx(0.2)
    assert np.allclose(algebraic_residual(np.stack([E, 2 * E]), rays0, rays1), [[0.2], [0.4]])


def make_matches(seed, num=150, outliers=40):
    rng = np.random.default_rng(seed)
    T = make_transform(exp_so3(rng.normal(0, 0.1, 3)), rng.normal(0, 1, 3))
    T[:3, 3] /= np.linalg.norm(T[:3, 3])
    points = rng.uniform((-3, -2, 5), (3, 2, 12), (num, 3))
    xy0, xy1 = CAMERA.project(points), CAMERA.project(transform_points(T, points))
    xy1 += rng.normal(0, 0.2, xy1.shape)
    xy1[:outliers] += rng.uniform(20, 60, (outliers, 2))
    confidence = np.where(np.arange(num) < outliers, 0.1, 0.9)
    return T, xy0, xy1, confidence


@pytest.mark.parametrize("seed", range(3))
def test_it_finds_the_pose_among_outliers(seed):
    T, xy0, xy1, confidence = make_matches(seed)
    found = confidence_ransac(CAMERA, xy0, xy1, confidence, num_trials=200, seed=seed)
    assert found is not None
    assert rotation_angle_deg(found[:3, :3] @ T[:3, :3].T) < 1.5
    assert angle_between_deg(found[:3, 3], T[:3, 3]) < 6
    assert np.linalg.norm(found[:3, 3]) == pytest.approx(1.0)


def test_the_same_seed_gives_the_same_model():
    _, xy0, xy1, confidence = make_matches(0)
    a, b = (confidence_ransac(CAMERA, xy0, xy1, confidence, num_trials=50, seed=4) for _ in range(2))
    assert a is not None
    assert b is not None
    assert np.array_equal(a, b)


def test_too_few_or_equal_matches_give_nothing():
    assert confidence_ransac(CAMERA, np.zeros((5, 2)), np.zeros((5, 2)), np.ones(5)) is None
    same = np.full((30, 2), 100.0)
    assert confidence_ransac(CAMERA, same, same, np.ones(30), num_trials=20) is None


def test_of_the_four_poses_the_one_with_points_in_front_is_taken():
    T, xy0, xy1, _ = make_matches(5, outliers=0)
    t = T[:3, 3]
    twisted = make_transform((2 * np.outer(t, t) - np.eye(3)) @ T[:3, :3], -t)
    found = in_front(CAMERA, twisted, xy0, xy1)
    assert np.allclose(found, T, atol=1e-9)
