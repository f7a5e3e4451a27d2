import cv2
import numpy as np
import pytest
from textures import shifted

from semcast.common.codec import KLT_WINDOW_PX
from semcast.server.geometry import brightness, klt
from semcast.server.geometry.brightness import brightness_change, with_brightness
from semcast.server.geometry.corners import detect_corners
from semcast.server.geometry.klt import track_points, track_through_light


@pytest.fixture
def grey(rng):
    smooth = cv2.GaussianBlur(rng.normal(0, 1, (240, 320)).astype(np.float32), (0, 0), 2.5)
    light = np.linspace(0.6, 1.0, 320, dtype=np.float32)
    spread = (smooth - smooth.min()) / (smooth.max() - smooth.min())
    return np.rint((40 + 120 * spread) * light).astype(np.uint8)


@pytest.mark.parametrize(("gain", "offset"), [(0.5, 0.0), (0.9, 0.0), (1.3, 0.0), (1.1, -6.0)])
def test_a_change_of_exposure_is_found_though_points_are_wrong(grey, rng, gain, offset):
    xy = rng.uniform((10, 10), (309, 229), (300, 2))
    moved = with_brightness(shifted(grey, 4, -3), gain, offset)
    xy1 = xy + np.array([4, -3])
    xy1[:60] = rng.uniform((10, 10), (309, 229), (60, 2))
    found_gain, found_offset = brightness_change(grey, moved, xy, xy1)
    assert found_gain * 100 + found_offset == pytest.approx(gain * 100 + offset, abs=1.0)


def test_a_change_that_does_not_matter_is_none(grey, rng):
    xy = rng.uniform((10, 10), (309, 229), (300, 2))
    assert brightness_change(grey, grey, xy, xy) is None
    noisy = np.clip(grey + rng.normal(0, 8, grey.shape), 0, 255).astype(np.uint8)
    assert brightness_change(grey, noisy, xy, xy) is None
    assert brightness_change(grey, with_brightness(grey, 0.5, 0.0), xy[:19], xy[:19]) is None
    black = np.zeros_like(grey)
    lost = [rng.uniform((10, 10), (309, 229), (2, 40, 2)) for _ in range(40)]
    told = [brightness_change(grey, grey, *pairs) for pairs in lost]
    assert sum(change is not None for change in told) <= 8, "points that are elsewhere tell nothing"
    assert brightness_change(black, grey, xy, xy) is None


def test_the_brightness_of_a_point_is_the_mean_of_its_patch_as_far_as_that_is_in_the_image():
    grey = np.arange(48, dtype=np.uint8).reshape(6, 8)
    xy = np.array([[4.0, 3.0], [0.0, 0.0], [7.4, 9.0], [np.nan, 2.0]])
    patches = [grey[2:5, 3:6], grey[:2, :2], grey[4:, 6:], grey[1:4, :2]]
    assert brightness._patch_means(grey, xy, 3) == pytest.approx([patch.mean() for patch in patches])


def test_an_image_clips_as_a_camera_does():
    grey = np.array([[0, 100, 200]], np.uint8)
    assert with_brightness(grey, 1.5, -10.0).tolist() == [[0, 140, 255]]


@pytest.mark.parametrize("gain", [0.6, 0.9, 1.4])
def test_points_are_followed_to_where_they_are_through_a_change_of_exposure(grey, monkeypatch, gain):
    corners = detect_corners(grey, 200).astype(np.float64)
    corners = corners[((corners > 25) & (corners < (294, 214))).all(axis=1)]
    moved = with_brightness(shifted(grey, 3, 2), gain, 0.0)

    found = track_points(grey, moved, corners, corners)
    error = np.linalg.norm(found.xy[found.ok] - corners[found.ok] - (3, 2), axis=1)
    assert found.ok.mean() > 0.95
    assert np.median(error) < 0.08
    assert np.median(found.photometric_grey[found.ok]) < 2.0
    monkeypatch.setattr("semcast.server.geometry.klt.brightness_change", lambda *_: None)
    without = track_points(grey, moved, corners, corners)
    assert without.ok.mean() < 0.5 * found.ok.mean()


@pytest.fixture
def searches(monkeypatch):
    """Number of points of each Lucas-Kanade search, there and back being one."""
    search, counts = klt._search, []

    def counted(grey0, grey1, xy0, *how):
        counts.append(len(xy0))
        return search(grey0, grey1, xy0, *how)

    monkeypatch.setattr(klt, "_search", counted)
    return counts


def test_one_search_is_enough_where_guesses_are_near(grey, searches):
    corners = detect_corners(grey, 200).astype(np.float64)
    corners = corners[((corners > 25) & (corners < (294, 214))).all(axis=1)]
    moved = with_brightness(shifted(grey, 3, 2), 0.95, 0.0)
    found, (gain, offset) = track_through_light(grey, moved, corners, corners + np.array([2.0, 3.0]))
    assert searches == [pytest.approx(len(corners) / 3, abs=1), len(corners)], "some, then all, once"
    assert found.ok.mean() > 0.95
    assert gain * 100 + offset == pytest.approx(95, abs=1.0)


def test_a_small_change_of_light_is_told_by_what_is_found_and_nothing_is_looked_for_twice(grey, searches):
    corners = detect_corners(grey, 200).astype(np.float64)
    corners = corners[((corners > 25) & (corners < (294, 214))).all(axis=1)]
    moved = with_brightness(shifted(grey, 3, 2), 1.0, 3.0)
    found, (gain, offset) = track_through_light(grey, moved, corners, corners + np.array([2.0, 3.0]))
    assert searches == [len(corners)]
    assert gain * 100 + offset == pytest.approx(103, abs=0.5)
    error = np.linalg.norm(found.xy[found.ok] - corners[found.ok] - (3, 2), axis=1)
    assert np.median(error) < 0.05


def test_light_that_guesses_told_is_not_doubted_where_much_is_hidden(grey, searches, monkeypatch, rng):
    corners = detect_corners(grey, 200).astype(np.float64)
    corners = corners[((corners > 25) & (corners < (294, 214))).all(axis=1)]
    moved = with_brightness(shifted(grey, 3, 2), 0.95, 0.0)
    hidden = corners[:, 0] > np.quantile(corners[:, 0], 0.7)
    first = round(float(corners[hidden, 0].min()))
    moved[:, first:] = cv2.GaussianBlur(rng.integers(0, 255, moved.shape, np.uint8), (0, 0), 2.0)[:, first:]

    def told(grey0, grey1, xy0, xy1, *patch_px):
        return (0.95, 0.0) if patch_px else (0.85, 0.0)

    monkeypatch.setattr(klt, "brightness_change", told)
    found, change = track_through_light(grey, moved, corners, corners + np.array([3.0, 2.0]))
    assert 0.4 < found.ok.mean() < 0.6
    assert change == (0.95, 0.0)
    assert len(searches) == 2, "some, then all, once"


def test_light_that_far_guesses_make_up_is_none(grey):
    # A wall is brighter the further to the right: where points are guessed to be, but not where they are.
    scene = np.rint(20 + 0.35 * np.arange(320) + 0.3 * grey).astype(np.uint8)
    corners = detect_corners(scene, 200).astype(np.float64)
    corners = corners[((corners > 25) & (corners < (280, 214))).all(axis=1)]
    guess = corners + np.array([14.0, 0.0])
    assert brightness_change(scene, scene, corners, guess, KLT_WINDOW_PX) is not None
    found, change = track_through_light(scene, scene, corners, guess)
    assert change is None
    assert np.median(np.linalg.norm(found.xy[found.ok] - corners[found.ok], axis=1)) < 0.05
