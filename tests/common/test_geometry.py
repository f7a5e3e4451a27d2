import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semcast.common import geometry as g

vectors = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(np.array)


def random_transform(rng):
    return g.make_transform(g.exp_so3(rng.normal(size=3)), rng.normal(size=3))


def test_a_quarter_turn_about_z_maps_x_to_y():
    R = g.exp_so3([0.0, 0.0, np.pi / 2])
    np.testing.assert_allclose(R @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(g.quat_wxyz_from_rotation(R), [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-12)
    assert g.rotation_angle_deg(R) == pytest.approx(90.0)


@given(vectors)
def test_log_inverts_exp_below_half_a_turn(w):
    angle = np.linalg.norm(w)
    if angle > np.pi - 1e-3:
        w = w * (np.pi - 1e-3) / angle
    np.testing.assert_allclose(g.log_so3(g.exp_so3(w)), w, atol=1e-6)


def test_logs_of_many_are_those_of_each(rng):
    w = rng.normal(size=(40, 3))
    angle_rad = np.append(0.0, np.geomspace(1e-9, 3.13, 39))
    w *= (angle_rad / np.linalg.norm(w, axis=1))[:, None]
    found = g.logs_so3(g.exp_so3(w).reshape(5, 8, 3, 3))
    np.testing.assert_allclose(found.reshape(40, 3), w, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(found[3, 4], g.log_so3(g.exp_so3(w[28])), atol=1e-12)


@given(vectors)
def test_quaternions_round_trip(w):
    R = g.exp_so3(w)
    np.testing.assert_allclose(g.rotation_from_quat_wxyz(g.quat_wxyz_from_rotation(R)), R, atol=1e-9)


def test_inverse_and_composition(rng):
    T = np.stack([random_transform(rng) for _ in range(5)])
    np.testing.assert_allclose(T @ g.invert_transform(T), np.broadcast_to(np.eye(4), T.shape), atol=1e-12)
    points = rng.normal(size=(7, 3))
    np.testing.assert_allclose(
        g.transform_points(T[0] @ T[1], points), g.transform_points(T[0], g.transform_points(T[1], points))
    )


def test_exp_se3_is_the_flow_of_its_twist(rng):
    xi = rng.normal(size=6)
    half = g.exp_se3(xi / 2)
    np.testing.assert_allclose(half @ half, g.exp_se3(xi), atol=1e-12)
    np.testing.assert_allclose(g.exp_se3([0, 0, 0, 1, 2, 3])[:3, 3], [1, 2, 3])


@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 1e-7, 0.99e-4, 1.01e-4, 1e-2, 1.0, np.pi, 6.0])
def test_exponentials_are_those_of_matrices_at_any_angle_and_of_many_at_once(angle_rad):
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    twists = np.stack([np.concatenate([s * angle_rad * axis, [1.0, -2.0, s]]) for s in (1.0, -1.0, 0.5)])
    generators = np.zeros((3, 4, 4))
    generators[:, :3, :3], generators[:, :3, 3] = g.skew(twists[:, :3]), twists[:, 3:]
    term = total = np.broadcast_to(np.eye(4), (3, 4, 4))
    for k in range(1, 50):
        term = term @ generators / k
        total = total + term
    np.testing.assert_allclose(g.exp_se3(twists), total, rtol=0.0, atol=2e-11)
    np.testing.assert_allclose(g.exp_so3(twists[:, :3]), total[:, :3, :3], rtol=0.0, atol=2e-11)
    np.testing.assert_array_equal(g.exp_se3(twists)[1], g.exp_se3(twists[1]))


def test_skew_is_the_cross_product(rng):
    a, b = rng.normal(size=(2, 3))
    np.testing.assert_allclose(g.skew(a) @ b, np.cross(a, b))


def test_projection_gives_the_nearest_rotation(rng):
    R = g.exp_so3(rng.normal(size=3))
    np.testing.assert_allclose(g.project_to_so3(R + 1e-6 * rng.normal(size=(3, 3))), R, atol=1e-5)
    assert np.linalg.det(g.project_to_so3(-np.eye(3))) == pytest.approx(1.0)


def test_angle_between_is_exact_for_tiny_angles():
    assert g.angle_between_deg([1, 0, 0], [1, 1e-9, 0]) == pytest.approx(np.degrees(1e-9))
    assert g.angle_between_deg([1, 0, 0], [-2, 0, 0]) == pytest.approx(180.0)
    assert g.angle_between_deg([0, 0, 0], [1, 0, 0]) == 90.0


def test_umeyama_recovers_a_similarity(rng):
    R, t, scale = g.exp_so3(rng.normal(size=3)), rng.normal(size=3), 2.5
    x = rng.normal(size=(20, 3))
    scale_hat, R_hat, t_hat = g.align_umeyama(x, scale * x @ R.T + t)
    assert scale_hat == pytest.approx(scale)
    np.testing.assert_allclose(R_hat, R, atol=1e-9)
    np.testing.assert_allclose(t_hat, t, atol=1e-9)


def test_umeyama_never_mirrors(rng):
    x = rng.normal(size=(20, 3))
    _, R, _ = g.align_umeyama(x, x * [1, 1, -1])
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_umeyama_refuses_points_without_extent():
    with pytest.raises(ValueError, match="must have an extent"):
        g.align_umeyama(np.ones((4, 3)), np.ones((4, 3)))
    with pytest.raises(ValueError, match="N >= 2"):
        g.align_umeyama(np.ones((1, 3)), np.ones((1, 3)))


def test_a_quaternion_without_length_is_refused():
    with pytest.raises(ValueError, match="must have a length"):
        g.rotation_from_quat_wxyz([0, 0, 0, 0])


def test_a_pose_between_two_is_on_the_straight_way_and_the_shortest_turn(rng):
    R_a, turn = g.exp_so3(rng.normal(size=3)), np.array([0.6, -0.3, 0.9])
    a, b = g.make_transform(R_a, [1.0, 2.0, 3.0]), g.make_transform(R_a @ g.exp_so3(turn), [3.0, 2.0, -1.0])
    np.testing.assert_allclose(g.interpolate_pose(a, b, 0.0), a, atol=1e-12)
    np.testing.assert_allclose(g.interpolate_pose(a, b, 1.0), b, atol=1e-12)
    quarter = g.make_transform(R_a @ g.exp_so3(0.25 * turn), [1.5, 2.0, 2.0])
    np.testing.assert_allclose(g.interpolate_pose(a, b, 0.25), quarter, atol=1e-12)
