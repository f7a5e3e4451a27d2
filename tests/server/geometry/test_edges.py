import cv2
import numpy as np
import pytest

from semcast.server.geometry.edges import alike, edges_at, rounded, whitened, whiteners
from semcast.server.geometry.klt import track_points


def half_plane(angle_rad, shift_px=0.0, noise_grey=0.0, seed=0):
    """A soft step of 100 grey levels through the middle of an image; ``angle_rad`` is that of its edge."""
    y, x = np.mgrid[:240, :320].astype(np.float64)
    across = -np.sin(angle_rad) * (x - 160) + np.cos(angle_rad) * (y - 120) - shift_px
    grey = 128 + 50 * np.tanh(across / 1.5) + np.random.default_rng(seed).normal(0, noise_grey, x.shape)
    return np.rint(np.clip(grey, 0, 255)).astype(np.uint8)


def on_edge(angle_rad, count=40):
    way = np.linspace(-80, 80, count)[:, None]
    return np.array([160.0, 120.0]) + way * [np.cos(angle_rad), np.sin(angle_rad)]


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0, 135.0])
def test_an_edge_points_along_what_is_bright_on_one_side(angle_deg):
    angle = np.radians(angle_deg)
    edge = edges_at(half_plane(angle, noise_grey=1.0), on_edge(angle))
    length = np.linalg.norm(edge, axis=1)
    assert np.allclose(length, 0.5 * np.log(10.0)), "as long as an edge can be"
    assert np.abs(edge @ [-np.sin(angle), np.cos(angle)]).max() < 0.1 * length.min()


def test_a_corner_and_noise_are_known_alike_in_all_directions():
    board = np.full((120, 120), 60, np.uint8)
    board[60:, :60] = board[:60, 60:] = 200
    noise = np.random.default_rng(0).normal(128, 5, (120, 120)).astype(np.uint8)
    assert np.linalg.norm(edges_at(board, np.array([[59.5, 59.5]]))) < 0.05
    assert np.linalg.norm(edges_at(noise, np.array([[40.0, 70.0]]))) < 0.15


def test_plain_ground_and_small_images_have_no_edges():
    assert not edges_at(np.full((60, 60), 7, np.uint8), np.array([[30.0, 30.0]])).any()
    assert not edges_at(np.eye(16, dtype=np.uint8) * 255, np.array([[8.0, 8.0]])).any()
    assert edges_at(half_plane(0.3), np.zeros((0, 2))).shape == (0, 2)
    assert edges_at(half_plane(0.3), np.array([[0.0, 0.0], [319.0, 239.0]])).shape == (2, 2)


def test_what_lucas_kanade_errs_by_has_the_shape_of_the_edge():
    angle = np.radians(25.0)
    errors, edges = [], []
    for seed in range(6):
        first, second = (half_plane(angle, noise_grey=3.0, seed=10 * seed + k) for k in range(2))
        xy = on_edge(angle)
        found = track_points(first, second, xy, xy)
        near = found.forward_backward_px < 20.0  # what slid along the edge hardly comes back
        errors.append((found.xy - xy)[near])
        edges.append(edges_at(second, found.xy)[near])
    error, edge = np.concatenate(errors), np.concatenate(edges)
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    ratio = np.std(error @ along) / np.std(error @ across)
    assert ratio > 20.0
    shaped = whitened(edge, error)
    assert np.std(shaped @ along) / np.std(shaped @ across) < 0.15 * ratio


def test_whitening_undoes_the_covariance_it_stands_for():
    rng = np.random.default_rng(0)
    edge = rng.normal(0, 0.5, (20, 2))
    length = np.linalg.norm(edge, axis=1)
    u = edge / length[:, None]
    n = np.column_stack([-u[:, 1], u[:, 0]])
    covariance = np.exp(2 * length)[:, None, None] * u[:, :, None] * u[:, None, :]
    covariance += np.exp(-2 * length)[:, None, None] * n[:, :, None] * n[:, None, :]
    W = whiteners(edge)
    assert np.allclose(W @ covariance @ W, np.eye(2))
    assert np.allclose(np.linalg.det(W), 1.0)
    assert np.allclose(whiteners(-edge), W), "the sign has no meaning"
    assert np.allclose(whiteners(alike()), np.eye(2))
    error = rng.normal(0, 1, (20, 2))
    assert np.allclose(whitened(edge, error)[3], W[3] @ error[3])


def test_rounding_leaves_few_edges_close_to_what_they_were():
    edge = np.random.default_rng(1).normal(0, 0.5, (5000, 2))
    few = rounded(edge)
    assert len(np.unique(few.round(9), axis=0)) < 600
    assert np.abs(whiteners(few) - whiteners(edge)).max() < 0.2 * whiteners(edge).max()
    assert not rounded(np.array([[0.05, 0.0]])).any()
    assert np.allclose(rounded(np.array([[0.6, 0.0], [-0.6, 0.0]])), [[0.6, 0.0], [0.6, 0.0]])


def test_an_edge_is_rounded_to_one_vector_whichever_way_it_points():
    angle = np.radians([0.0, 1.0, 42.0, 90.0, 179.0, 179.9])
    edge = 0.6 * np.column_stack([np.cos(angle), np.sin(angle)])
    np.testing.assert_array_equal(rounded(edge), rounded(-edge))
    assert len(np.unique(rounded(edge[[0, 1, 4, 5]]), axis=0)) == 1, "all lie along the rows"


def test_the_gradients_are_those_of_the_window_around_the_point():
    grey = half_plane(0.0)
    grey[:, 200:] = cv2.transpose(half_plane(0.0))[:240, :120]  # another scene to the right
    left, right = np.array([[100.0, 120.0]]), np.array([[240.0, 120.0]])
    assert np.allclose(edges_at(grey, left), edges_at(half_plane(0.0), left))
    assert not np.allclose(edges_at(grey, right), edges_at(half_plane(0.0), right))
