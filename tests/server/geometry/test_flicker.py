import cv2
import numpy as np
import pytest
from textures import shifted

from semcast.server.geometry.corners import detect_corners
from semcast.server.geometry.flicker import flicker_between, row_gains, with_row_gains
from semcast.server.geometry.klt import track_points

HEIGHT, WIDTH = 240, 320
ALL = np.ones(HEIGHT, bool)
STILL = np.zeros(2)


@pytest.fixture
def grey(rng):
    smooth = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH)).astype(np.float32), (0, 0), 2.5)
    spread = (smooth - smooth.min()) / (smooth.max() - smooth.min())
    return np.rint(40 + 120 * spread).astype(np.uint8)


def bands(phase, depth=0.25):
    """Light of each row under a lamp that goes through one and a half periods while the image is read."""
    return 1.0 + depth * np.sin(2 * np.pi * 1.5 * np.arange(HEIGHT) / HEIGHT + phase)


@pytest.mark.parametrize("told_px", [(4.0, -3.0), (0.0, 0.0)])
def test_the_gain_of_every_row_is_told_though_the_motion_is_known_roughly(grey, told_px):
    before, after = bands(0.0), bands(2.0)
    moved = with_row_gains(shifted(grey, 4, -3), after)
    gains = row_gains(with_row_gains(grey, before), moved, np.array(told_px), ALL)
    expected = np.interp(np.arange(HEIGHT) - 3, np.arange(HEIGHT), after) / before
    inner = slice(12, -12)
    assert np.median(np.abs(gains / expected - 1)[inner]) < 0.03
    assert np.abs(gains / expected - 1)[inner].max() < 0.12


def test_rows_that_did_not_arrive_tell_nothing(grey):
    broken = with_row_gains(grey, bands(2.0))
    broken[96:112] = 40
    usable = ALL.copy()
    usable[96:112] = False
    gains = row_gains(with_row_gains(grey, bands(0.0)), broken, STILL, usable)
    expected = bands(2.0) / bands(0.0)
    assert np.abs(gains / expected - 1)[12:-12].max() < 0.12


def test_images_whose_rows_changed_alike_have_no_bands(grey):
    even = np.full(HEIGHT, 0.7)
    assert row_gains(grey, grey, STILL, ALL) is None
    assert row_gains(grey, with_row_gains(grey, even), STILL, ALL) is None, "that is another exposure"
    assert row_gains(grey, with_row_gains(grey, bands(0.0)), np.array([0.0, HEIGHT]), ALL) is None
    assert row_gains(grey, with_row_gains(grey, bands(0.0)), np.full(2, np.nan), ALL) is not None
    black = np.zeros_like(grey)
    assert row_gains(black, grey, STILL, ALL) is None
    assert row_gains(grey, with_row_gains(grey, bands(0.0)), STILL, ~ALL) is None


def test_points_are_found_under_flickering_lamps(grey):
    corners = detect_corners(grey, 200).astype(np.float64)
    corners = corners[((corners > 25) & (corners < (WIDTH - 26, HEIGHT - 26))).all(axis=1)]
    before, after = with_row_gains(grey, bands(0.0)), with_row_gains(shifted(grey, 3, 2), bands(2.0))
    gains = flicker_between(before, after, corners, corners, ALL)
    found = track_points(with_row_gains(before, gains), after, corners, corners)
    error = np.linalg.norm(found.xy - corners - (3, 2), axis=1)[found.ok]
    assert found.ok.mean() > 0.95
    assert np.median(error) < 0.1
    assert track_points(before, after, corners, corners).ok.mean() < 0.6


def test_a_horizon_that_goes_up_in_the_image_has_no_bands(grey):
    sky = grey.copy()
    sky[:90] = 200
    assert row_gains(sky, shifted(sky, 0, -14), STILL, ALL) is None


def test_a_scene_of_level_layers_that_moves_up_has_no_bands(grey):
    layered = with_row_gains(grey, bands(0.0, 0.5))
    moved = shifted(layered, 0, -10)
    corners = detect_corners(layered, 200).astype(np.float64)
    assert row_gains(layered, moved, STILL, ALL) is not None, "rows alone can't tell"
    assert flicker_between(layered, moved, corners, corners, ALL) is None


def test_few_points_try_out_nothing(grey):
    corners = detect_corners(grey, 9).astype(np.float64)
    assert flicker_between(grey, with_row_gains(grey, bands(0.0)), corners, corners, ALL) is None


def test_bright_rows_are_clipped_as_a_camera_clips():
    grey = np.array([[0, 100, 200], [0, 100, 200]], np.uint8)
    assert with_row_gains(grey, np.array([1.5, 0.5])).tolist() == [[0, 150, 255], [0, 50, 100]]
