"""Points followed where the second image sees them turned and sheared."""

import cv2
import numpy as np
import pytest

from semcast.server.geometry import warped_points
from semcast.server.geometry.corners import detect_corners
from semcast.server.geometry.klt import track_points
from semcast.server.geometry.warped_points import track_warped
from semcast.server.geometry.wide_search import WideFeatures, search_wide

#: A turn by twenty degrees, of a surface that is seen narrower than before.
WARP = np.array([[0.80, -0.30], [0.27, 0.92]])
MIDDLE = np.array([160.0, 120.0])


@pytest.fixture(scope="module")
def texture():
    noise = np.random.default_rng(1).standard_normal((240, 320)).astype(np.float32)
    layers = [cv2.GaussianBlur(noise, None, s) for s in (1.5, 3, 6)]
    return np.clip(128 + 35 * sum(v / v.std() for v in layers) / 1.7, 0, 255).astype(np.uint8)


def warped(image, warp=WARP, shift=(14.0, -9.0)):
    """The image at ``x' = A x + t``, and where its corners come to lie there."""
    t = MIDDLE - warp @ MIDDLE + shift
    corners = detect_corners(image, 150, None, None, cell_px=24).astype(np.float64)
    there = corners @ warp.T + t
    inside = ((there > 15) & (there < np.array(image.shape[::-1]) - 15)).all(axis=1)
    return (
        cv2.warpAffine(image, np.hstack([warp, t[:, None]]), image.shape[::-1]),
        corners[inside],
        there[inside],
    )


def off_px(points, there):
    return np.linalg.norm(points.xy - there, axis=1)[points.ok]


def test_windows_are_found_turned_and_sheared(texture):
    image, corners, there = warped(texture)
    guess = there + np.random.default_rng(2).normal(0, 1.5, there.shape)
    found = track_warped(texture, image, corners, guess, np.tile(WARP, (len(there), 1, 1)))
    assert found.ok.mean() > 0.8
    assert (off_px(found, there) < 0.5).mean() > 0.97
    only_moved = track_points(texture, image, corners, guess, max_level=1)
    assert (off_px(only_moved, there) < 0.5).sum() < 0.5 * found.ok.sum(), "else there is nothing to gain"


def test_windows_tell_the_noise_they_were_found_in(texture):
    image, corners, there = warped(texture)
    warps = np.tile(WARP, (len(there), 1, 1))
    noise = np.random.default_rng(3).normal(0.0, 10.0, image.shape)
    noisy = np.clip(image + noise, 0, 255).astype(np.uint8)
    clean_grey, noisy_grey = (
        np.median(found.photometric_grey[found.ok])
        for found in (track_warped(texture, seen, corners, there, warps) for seen in (image, noisy))
    )
    # Sampling between pixels takes half of the noise away, and the mean size of what is left is 0.8 of it.
    assert clean_grey < 2.0
    assert 3.0 < noisy_grey < 8.0


def test_of_another_image_hardly_anything_is_found(texture):
    _, corners, there = warped(texture)
    other = np.ascontiguousarray(texture[::-1, ::-1])
    found = track_warped(texture, other, corners, there, np.tile(WARP, (len(there), 1, 1)))
    assert found.ok.mean() < 0.05


def test_where_windows_hardly_warp_points_far_from_their_guess_are_found_too(texture):
    image, corners, there = warped(texture, np.eye(2))
    far_off = there + np.array([9.0, -6.0])
    found = track_warped(texture, image, corners, far_off, np.tile(np.eye(2), (len(there), 1, 1)))
    assert found.ok.mean() > 0.8
    assert (off_px(found, there) < 0.5).mean() > 0.9


@pytest.mark.parametrize("share_warped", [0.0, 0.5])
def test_only_windows_that_are_warped_are_aligned(texture, share_warped, monkeypatch):
    image, corners, there = warped(texture, np.eye(2))
    rows = np.random.default_rng(4).random(len(there)) < share_warped
    warps = np.where(rows[:, None, None], 1.2 * np.eye(2), np.eye(2))
    aligned, align = [], warped_points.align_patches
    monkeypatch.setattr(
        warped_points,
        "align_patches",
        lambda *how, **more: aligned.append(len(how[0])) or align(*how, **more),
    )
    together = track_warped(texture, image, corners, there, warps)
    assert aligned == ([rows.sum()] * 2 if rows.any() else []), "there and back"
    alone = track_warped(texture, image, corners[rows], there[rows], warps[rows])
    for name, values in vars(together).items():
        np.testing.assert_array_equal(values[rows], vars(alone)[name])
    assert together.ok[~rows].mean() > 0.9


def test_matches_around_a_point_tell_how_its_window_was_warped(texture):
    image, corners, there = warped(texture)
    carried = search_wide(WideFeatures.of(texture), WideFeatures.of(image), corners)
    assert carried is not None
    assert np.median(np.linalg.norm(carried.xy - there, axis=1)) < 1.0
    assert np.median(np.linalg.norm(carried.warps - WARP, ord=2, axis=(1, 2))) < 0.05
