import cv2
import numpy as np
import pytest
from textures import shifted, texture

from semcast.common.codec import KLT_WINDOW_PX
from semcast.server.geometry.corners import corner_strength, detect_corners
from semcast.server.geometry.klt import track_points
from semcast.server.geometry.sampling import sample_map


@pytest.mark.parametrize(("shift", "share"), [((3.4, -2.6), 0.9), ((28.0, 11.0), 0.7)])
def test_points_are_followed_to_a_fraction_of_a_pixel(shift, share):
    grey0 = texture()
    grey1 = shifted(grey0, *shift)
    corners = detect_corners(grey0, 150).astype(np.float64)
    inside = np.all((corners + shift > 14) & (corners + shift < np.array([306, 226])), axis=1)
    corners = corners[inside]
    found = track_points(grey0, grey1, corners, corners)
    assert found.ok.mean() > share
    error = np.linalg.norm(found.xy - corners - shift, axis=1)[found.ok]
    assert np.median(error) < 0.1
    assert np.median(found.forward_backward_px[found.ok]) < 0.1
    assert np.all(found.gradient_grey2[found.ok] > 0)


def test_points_near_an_outline_are_placed_by_what_is_inside_it():
    inside = np.zeros((240, 320), np.uint8)
    for x in range(30, 320, 40):
        for y in range(30, 240, 40):
            cv2.circle(inside, (x, y), 13, 255, -1)

    def seen(shift, behind):
        mask = shifted(inside, *shift)[..., None].astype(np.float32) / 255
        thing, ground = shifted(texture(seed=0), *shift), shifted(texture(seed=1), *behind)
        return np.rint(mask[..., 0] * thing + (1 - mask[..., 0]) * ground).astype(np.uint8)

    shift = (2.0, 1.0)
    grey0, grey1 = seen((0, 0), (0, 0)), seen(shift, (0.5, -0.5))
    usable = cv2.erode(inside, np.ones((13, 13), np.uint8)) > 0
    corners = detect_corners(grey0, 200, usable=usable).astype(np.float64)
    found = track_points(grey0, grey1, corners, corners + shift)
    error = np.linalg.norm(found.xy - corners - shift, axis=1)[found.ok]
    assert len(error) > 30
    assert np.median(error) < 0.1


def test_gradient_of_tracking_is_that_of_the_corner_strength():
    grey = texture()
    corners = detect_corners(grey, 100).astype(np.float64)
    found = track_points(grey, grey, corners, corners)
    strength = sample_map(corner_strength(grey, block_px=KLT_WINDOW_PX), corners)
    ratio = found.gradient_grey2[found.ok] / strength[found.ok]
    assert np.median(ratio) == pytest.approx(1.0, rel=0.15)


def test_points_without_a_counterpart_are_not_ok():
    corners = detect_corners(texture(seed=0), 150).astype(np.float64)
    found = track_points(texture(seed=0), texture(seed=1), corners, corners)
    assert found.ok.mean() < 0.2


def test_tracking_takes_any_input():
    grey = texture()
    assert len(track_points(grey, grey, np.zeros((0, 2)), np.zeros((0, 2))).ok) == 0
    assert not track_points(grey, grey[:100], np.ones((3, 2)), np.ones((3, 2))).ok.any()
    odd = np.array([[np.nan, 5.0], [1e9, -1e9], [50.0, 50.0]])
    found = track_points(grey, grey, np.full((3, 2), 50.0), odd)
    assert np.isfinite(found.xy).all()
    flat = np.zeros_like(grey)
    assert not track_points(flat, flat, np.full((3, 2), 50.0), np.full((3, 2), 50.0)).ok.any()
