"""Patches that are seen turned and scaled, put back to a fraction of a pixel."""

import cv2
import numpy as np
import pytest
import textures

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, make_transform
from semcast.server.geometry.patch_alignment import Templates, affine_warps, align_patches

CAMERA = Intrinsics(fx=300, fy=320, cx=160, cy=120, width=320, height=240)
CENTRES = np.array([[80.0, 60.0], [160.3, 120.7], [230.5, 90.2], [120.0, 180.0]])


@pytest.fixture(scope="module")
def texture():
    return textures.texture((240, 320), (1.5, 3, 6), 1, 20)


def seen_through(image, A, t):
    """The image at ``x' = A x + t``."""
    return cv2.warpAffine(image, np.hstack([A, t[:, None]]), image.shape[::-1], borderMode=cv2.BORDER_REFLECT)


@pytest.mark.parametrize(
    "A",
    [np.eye(2), 1.25 * np.eye(2), 0.8 * np.eye(2), np.array([[0.94, -0.34], [0.34, 0.94]])],
    ids=["shift", "nearer", "further", "turned"],
)
def test_patches_are_found_to_a_tenth_of_a_pixel(texture, A):
    t = np.array([160.0, 120.0]) - A @ np.array([160.0, 120.0]) + [3.3, -2.6]
    image = seen_through(texture, A, t)
    image = np.clip(0.8 * image.astype(np.float32) + 20, 0, 255).astype(np.uint8)  # another exposure
    true = CENTRES @ A.T + t
    start = true + np.array([[1.5, -1.0], [-1.2, 1.3], [0.8, 1.6], [-1.7, -0.4]])
    found = align_patches(Templates.cut(texture, CENTRES), image, start, np.tile(A, (4, 1, 1)))
    assert np.abs(found.xy - true).max() < 0.1
    assert found.correlation.min() > 0.98


def test_without_the_warp_a_scaled_patch_is_found_worse(texture):
    A = 1.3 * np.eye(2)
    t = -0.3 * np.array([160.0, 120.0])
    image = seen_through(texture, A, t)
    true = CENTRES @ A.T + t
    warped = align_patches(Templates.cut(texture, CENTRES), image, true + 1.0, np.tile(A, (4, 1, 1)))
    plain = align_patches(Templates.cut(texture, CENTRES), image, true + 1.0, np.tile(np.eye(2), (4, 1, 1)))
    assert np.abs(warped.xy - true).max() < 0.1
    assert plain.correlation.max() < warped.correlation.min()


def test_what_is_not_there_or_has_no_structure_does_not_correlate(texture):
    other = np.random.default_rng(2).integers(0, 256, texture.shape).astype(np.uint8)
    warps = np.tile(np.eye(2), (4, 1, 1))
    assert align_patches(Templates.cut(texture, CENTRES), other, CENTRES, warps).correlation.max() < 0.5
    flat = np.full_like(texture, 90)
    found = align_patches(Templates.cut(flat, CENTRES), texture, CENTRES, warps)
    np.testing.assert_array_equal(found.xy, CENTRES)
    np.testing.assert_array_equal(found.correlation, -1.0)
    blind = align_patches(Templates.cut(texture, CENTRES), flat, CENTRES, warps)
    assert np.isfinite(blind.xy).all()
    assert blind.correlation.max() < 0.1


def test_points_at_the_border_and_no_points_are_no_error(texture):
    edge = np.array([[0.0, 0.0], [319.0, 239.0]])
    found = align_patches(Templates.cut(texture, edge), texture, edge, np.tile(np.eye(2), (2, 1, 1)))
    assert np.isfinite(found.xy).all()
    assert (
        len(align_patches(Templates.cut(texture, edge[:0]), texture, edge[:0], np.zeros((0, 2, 2))).xy) == 0
    )


def test_warps_are_the_derivatives_of_the_projection():
    T = make_transform(exp_so3([0.05, -0.1, 0.3]), [0.4, -0.2, 0.5])
    depth = np.array([3.0, 5.0, 4.0, 8.0])

    def into_second(xy0):
        rays = CAMERA.unproject(xy0) * depth[:, None]
        return CAMERA.project(rays @ T[:3, :3].T + T[:3, 3])

    warps, depth1 = affine_warps(CAMERA, T, CENTRES, depth)
    h = 1e-4
    for axis in range(2):
        numeric = (
            into_second(CENTRES + h * np.eye(2)[axis]) - into_second(CENTRES - h * np.eye(2)[axis])
        ) / (2 * h)
        np.testing.assert_allclose(warps[:, :, axis], numeric, atol=1e-5)
    np.testing.assert_allclose(
        depth1, (CAMERA.unproject(CENTRES) * depth[:, None] @ T[:3, :3].T + T[:3, 3])[:, 2]
    )


def test_a_point_behind_the_second_camera_has_no_warp_and_says_so():
    T = make_transform(np.eye(3), [0.0, 0.0, -5.0])
    warps, depth1 = affine_warps(CAMERA, T, CENTRES[:1], np.array([3.0]))
    np.testing.assert_array_equal(warps[0], np.eye(2))
    assert depth1[0] == pytest.approx(-2.0)


def test_many_patches_are_aligned_at_once():
    image = np.tile(np.arange(64, dtype=np.uint8) * 3, (64, 1))
    image = np.asarray(image ^ image.T, np.uint8)
    count = 33_000  # OpenCV takes no picture of so many rows
    centres = np.tile([[30.0, 31.0]], (count, 1))
    found = align_patches(Templates.cut(image, centres, 9), image, centres, np.tile(np.eye(2), (count, 1, 1)))
    assert np.abs(found.xy - centres).max() < 0.01
