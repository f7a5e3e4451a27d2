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
from semcast.server.geometry.epipolar import (
    beyond_infinity_jacobian,
    beyond_infinity_px,
    depths,
    essential_matrix,
    fit_rotation,
    fundamental_matrix,
    half_line_px,
    msac_score,
    rays_angle_deg,
    refine_relative_pose,
    rotation_residual_px,
    sampson_jacobian,
    sampson_px,
    shape_of,
    turn_in_doubt_deg,
)

CAMERA = Intrinsics(fx=500, fy=480, cx=320, cy=240, width=640, height=480)


def make_pair(rng, num=200, noise_px=0.0, angle_rad=0.1):
    T = make_transform(exp_so3(rng.normal(0, angle_rad, 3)), rng.normal(0, 1, 3))
    T[:3, 3] /= np.linalg.norm(T[:3, 3])
    points = rng.uniform((-3, -2, 5), (3, 2, 12), (num, 3))
    xy0, xy1 = CAMERA.project(points), CAMERA.project(transform_points(T, points))
    noise = rng.normal(0, 1, (2, num, 2)) * noise_px
    return T, points, xy0 + noise[0], xy1 + noise[1]


@pytest.mark.parametrize("seed", range(10))
def test_exact_matches_lie_on_the_epipolar_geometry(seed):
    T, points, xy0, xy1 = make_pair(np.random.default_rng(seed))
    assert np.abs(sampson_px(fundamental_matrix(CAMERA, T), xy0, xy1)).max() < 1e-8
    rays0, rays1 = CAMERA.unproject(xy0), CAMERA.unproject(xy1)
    assert np.abs(np.einsum("ni,ij,nj->n", rays1, essential_matrix(T), rays0)).max() < 1e-12
    depth0, depth1 = depths(CAMERA, T, xy0, xy1)
    assert np.allclose(depth0, points[:, 2])
    assert np.allclose(depth1, transform_points(T, points)[:, 2])


def test_sampson_is_the_distance_from_a_horizontal_epipolar_line():
    # Sideways motion: matches stay on their row. A row difference of 1 px is shared by both images.
    T = make_transform(np.eye(3), (1, 0, 0))
    square = Intrinsics(fx=500, fy=500, cx=320, cy=240, width=640, height=480)
    residual = sampson_px(fundamental_matrix(square, T), np.array([[300.0, 200]]), np.array([[350.0, 201]]))
    assert abs(residual[0]) == pytest.approx(1 / np.sqrt(2))


def test_sampson_of_many_matrices_is_that_of_each():
    rng = np.random.default_rng(0)
    pairs = [make_pair(rng) for _ in range(3)]
    F = np.stack([fundamental_matrix(CAMERA, T) for T, *_ in pairs])
    _, _, xy0, xy1 = pairs[0]
    assert np.allclose(sampson_px(F, xy0, xy1), [sampson_px(f, xy0, xy1) for f in F])


@pytest.mark.parametrize("length", [0.0, 0.7])
def test_the_derivative_of_sampson_is_that_of_small_steps(length):
    rng = np.random.default_rng(4)
    T, _, xy0, xy1 = make_pair(rng, num=40, noise_px=2.0)
    shapes = shape_of(length * rng.normal(0, 1, (40, 2))), shape_of(length * rng.normal(0, 1, (40, 2)))
    t = T[:3, 3]
    across = np.cross(t, (0.3, -0.5, 0.8))
    tangent = np.stack([across, np.cross(t, across)]) / np.linalg.norm(across)
    residual, J = sampson_jacobian(CAMERA, T, tangent, xy0, xy1, shapes)
    assert np.allclose(residual, sampson_px(fundamental_matrix(CAMERA, T), xy0, xy1, shapes), atol=1e-12)
    for k in range(5):
        step = 1e-6 * np.eye(5)[k]

        def moved(step):
            turned = t + step[3:] @ tangent
            pose = make_transform(exp_so3(step[:3]) @ T[:3, :3], turned / np.linalg.norm(turned))
            return sampson_px(fundamental_matrix(CAMERA, pose), xy0, xy1, shapes)

        assert np.allclose(J[:, k], (moved(step) - moved(-step)) / 2e-6, rtol=1e-4, atol=1e-3)


def test_the_shape_of_an_error_is_as_long_along_its_edge_as_it_is_short_across():
    # Half the logarithm of 9: along the edge the standard deviation is 3, across it 1 / 3.
    edge = 0.5 * np.log(9.0) * np.array([[1.0, 0], [0, -1], [0.6, 0.8], [0, 0]])
    shape = shape_of(edge)
    assert np.allclose(shape[:2], [np.diag([9, 1 / 9]), np.diag([1 / 9, 9])])
    assert np.allclose(shape[2] @ (0.6, 0.8), 9 * np.array([0.6, 0.8]))
    assert np.allclose(shape[2] @ (-0.8, 0.6), np.array([-0.8, 0.6]) / 9)
    assert np.allclose(shape[3], np.eye(2))


def test_a_match_off_its_line_weighs_by_its_error_across_the_line():
    # Lines are rows: of edges along them the standard deviation across is 1 / 3, of upright ones 3.
    T = make_transform(np.eye(3), (1, 0, 0))
    square = Intrinsics(fx=500, fy=500, cx=320, cy=240, width=640, height=480)
    xy0, xy1 = np.full((3, 2), (300.0, 200.0)), np.full((3, 2), (350.0, 201.0))
    length = 0.5 * np.log(9.0)
    edge0 = length * np.array([[1.0, 0], [0, 1], [1, 0]])
    edge1 = length * np.array([[1.0, 0], [0, 1], [0, 1]])
    found = half_line_px(square, T, xy0, xy1, (shape_of(edge0), shape_of(edge1)))
    assert np.allclose(found, 1.0 / np.sqrt([2 / 9, 18, 1 / 9 + 9]))


def test_matches_known_alike_in_all_directions_have_the_distance_of_those_without_a_shape():
    T, _, xy0, xy1 = make_pair(np.random.default_rng(5), noise_px=2.0)
    alike = shape_of(np.zeros((len(xy0), 2)))
    F = np.stack([fundamental_matrix(CAMERA, T), np.diag([1.0, 2, 3])])
    assert np.allclose(sampson_px(F, xy0, xy1, (alike, alike)), sampson_px(F, xy0, xy1))


def test_half_of_an_epipolar_line_is_in_front_of_the_cameras():
    # Camera 1 sits 1 to the left: a point 5 ahead moves 100 px to the right, never to the left.
    T = make_transform(np.eye(3), (1, 0, 0))
    square = Intrinsics(fx=500, fy=500, cx=320, cy=240, width=640, height=480)
    xy0 = np.full((3, 2), (300.0, 200.0))
    xy1 = np.array([[400.0, 200], [300, 200], [280, 203]])
    assert np.allclose(beyond_infinity_px(square, T, xy0, xy1), [0, 0, -20 / np.sqrt(2)])
    assert np.allclose(half_line_px(square, T, xy0, xy1), [0, 0, np.hypot(20, 3) / np.sqrt(2)])


@pytest.mark.parametrize("seed", range(4))
def test_no_point_of_an_exact_pair_is_beyond_infinity_and_turned_round_all_are(seed):
    T, _, xy0, xy1 = make_pair(np.random.default_rng(seed))
    assert np.abs(beyond_infinity_px(CAMERA, T, xy0, xy1)).max() < 1e-9
    turned = make_transform(T[:3, :3], -T[:3, 3])
    assert (beyond_infinity_px(CAMERA, turned, xy0, xy1) < 0).all()


def test_the_derivative_of_what_is_beyond_infinity_is_that_of_small_steps():
    rng = np.random.default_rng(7)
    T, _, xy0, xy1 = make_pair(rng, num=40, noise_px=3.0)
    T[:3, 3] *= -1.0
    t = T[:3, 3]
    across = np.cross(t, (0.3, -0.5, 0.8))
    tangent = np.stack([across, np.cross(t, across)]) / np.linalg.norm(across)
    beyond, J = beyond_infinity_jacobian(CAMERA, T, tangent, xy0, xy1)
    assert np.allclose(beyond, beyond_infinity_px(CAMERA, T, xy0, xy1), atol=1e-12)
    assert (beyond < 0).sum() > 30
    for k in range(5):
        step = 1e-6 * np.eye(5)[k]

        def moved(step):
            turned = t + step[3:] @ tangent
            pose = make_transform(exp_so3(step[:3]) @ T[:3, :3], turned / np.linalg.norm(turned))
            return beyond_infinity_px(CAMERA, pose, xy0, xy1)

        assert np.allclose(J[:, k], (moved(step) - moved(-step)) / 2e-6, rtol=1e-4, atol=1e-3)


def test_msac_by_hand():
    assert msac_score(np.array([0.0, 1.0, 5.0, -2.0]), 2.0) == pytest.approx((0 + 0.25 + 1 + 1) / 4)
    assert msac_score(np.zeros(0), 1.0) == 1.0
    assert msac_score(np.array([0.0, 4.0]), 2.0, np.array([3.0, 1.0])) == pytest.approx(0.25)


def test_parallax_of_a_point_ahead():
    # Camera 1 sits 1 to the right of camera 0; a point 1 ahead of it is seen under 45 degrees from camera 0.
    T = make_transform(np.eye(3), (-1, 0, 0))
    xy0, xy1 = CAMERA.project([[1.0, 0, 1]]), CAMERA.project([[0.0, 0, 1]])
    assert rays_angle_deg(CAMERA, T, xy0, xy1)[0] == pytest.approx(45.0)


def test_rotation_alone_is_found():
    rng = np.random.default_rng(1)
    R = exp_so3((0.02, -0.1, 0.03))
    points = rng.uniform((-3, -2, 5), (3, 2, 12), (80, 3))
    xy0, xy1 = CAMERA.project(points), CAMERA.project(points @ R.T)
    xy1[:20] += rng.uniform(-50, 50, (20, 2))
    found = fit_rotation(CAMERA, xy0, xy1)
    assert rotation_angle_deg(found @ R.T) < 0.01
    assert rotation_residual_px(CAMERA, found, xy0, xy1)[20:].max() < 0.2


def test_of_two_angles_the_one_counts_more_where_pixels_are_smaller():
    # Rays of lengths 1 and the root of 2, the second turned by 3 mrad about y: weights 1 and 2, so 2 mrad.
    square = Intrinsics(fx=500, fy=500, cx=320, cy=240, width=640, height=480)
    xy0 = square.project([[0.0, 0, 1], [1, 0, 1]])
    xy1 = square.project([[0.0, 0, 1], exp_so3((0, 3e-3, 0)) @ (1, 0, 1)])
    R = fit_rotation(square, xy0, xy1, iterations=1)
    assert R[0, 2] == pytest.approx(2e-3, rel=0.01)


@pytest.mark.parametrize("seed", range(5))
def test_refinement_reaches_the_truth_on_exact_matches(seed):
    rng = np.random.default_rng(seed)
    T, _, xy0, xy1 = make_pair(rng)
    t = T[:3, 3] + rng.normal(0, 0.05, 3)
    start = make_transform(exp_so3(rng.normal(0, 0.02, 3)) @ T[:3, :3], t / np.linalg.norm(t))
    found = refine_relative_pose(
        CAMERA, start, xy0, xy1, np.full(len(xy0), 2.0), cut_sigmas=50, iterations=20
    )
    assert rotation_angle_deg(found[:3, :3] @ T[:3, :3].T) < 1e-3
    assert angle_between_deg(found[:3, 3], T[:3, 3]) < 1e-2


def sideways_pair(width, depth, num=150):
    """A square to the right of the middle of the image, and a camera that has gone to the right."""
    rng = np.random.default_rng(0)
    z = rng.uniform(*depth, num)
    xy0 = np.column_stack([rng.uniform(420, 420 + width, num), rng.uniform(60, 420, num)])
    T = make_transform(np.eye(3), (-1, 0, 0))
    return T, xy0, CAMERA.project(transform_points(T, CAMERA.unproject(xy0) * z[:, None]))


def test_the_turn_of_a_relative_pose_errs_as_much_as_it_is_in_doubt():
    T, xy0, xy1 = sideways_pair(200, (5, 12))
    turned = []
    for seed in range(200):
        noise0, noise1 = 0.1 * np.random.default_rng(seed).normal(size=(2, *xy0.shape))
        found = refine_relative_pose(CAMERA, T, xy0 + noise0, xy1 + noise1, np.full(len(xy0), 1.0))
        turned.append(found[:3, :3] - np.eye(3))
    turned = np.array(turned)
    errors = np.degrees(np.column_stack([turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]]))
    largest = np.sqrt(np.linalg.eigvalsh(np.cov(errors.T))[-1])
    assert 0.1 * turn_in_doubt_deg(CAMERA, T, xy0, xy1) == pytest.approx(largest, rel=0.15)


def test_a_turn_is_in_doubt_across_a_narrow_strip_and_without_enough_matches():
    T, xy0, xy1 = sideways_pair(200, (8, 9))
    whole = turn_in_doubt_deg(CAMERA, T, xy0, xy1)
    strip = turn_in_doubt_deg(CAMERA, *sideways_pair(40, (8, 9)))
    assert strip > 4.0 * whole
    assert turn_in_doubt_deg(CAMERA, T, xy0[:4], xy1[:4]) > 1e3


def test_weights_help_when_they_are_right():
    errors = {"weighted": [], "equal": []}
    for seed in range(12):
        rng = np.random.default_rng(seed)
        T, _, xy0, xy1 = make_pair(rng, num=80)
        sigma = np.where(np.arange(80) % 2, 0.2, 3.0)
        xy1 = xy1 + rng.normal(0, 1, xy1.shape) * sigma[:, None]
        for name, s in (("weighted", sigma), ("equal", np.full(80, 1.5))):
            found = refine_relative_pose(CAMERA, T, xy0, xy1, s, cut_sigmas=9, iterations=20)
            errors[name].append(angle_between_deg(found[:3, 3], T[:3, 3]))
    assert np.mean(errors["weighted"]) < 0.5 * np.mean(errors["equal"])


def test_matches_that_slide_along_edges_help_where_their_shape_is_known():
    errors = {"shaped": [], "alike": []}
    for seed in range(12):
        rng = np.random.default_rng(seed)
        T, _, xy0, xy1 = make_pair(rng, num=80)
        angle = rng.uniform(0, np.pi, 80)
        along = np.column_stack([np.cos(angle), np.sin(angle)])
        across = np.column_stack([-along[:, 1], along[:, 0]])
        xy1 = xy1 + rng.normal(0, 3.0, (80, 1)) * along + rng.normal(0, 0.2, (80, 1)) * across
        edge = 0.5 * np.log(3.0 / 0.2) * along
        for name, shapes in (("shaped", (shape_of(edge), shape_of(edge))), ("alike", None)):
            found = refine_relative_pose(
                CAMERA, T, xy0, xy1, np.full(80, 1.5), shapes=shapes, cut_sigmas=9, iterations=20
            )
            errors[name].append(angle_between_deg(found[:3, 3], T[:3, 3]))
    assert np.mean(errors["shaped"]) < 0.6 * np.mean(errors["alike"])
