import cv2
import numpy as np
import pytest
from textures import texture

from semcast.server.geometry.corners import (
    BORDER_PX,
    corner_strength,
    deduplicate,
    detect_corners,
    noise_energy_grey2,
)
from semcast.server.geometry.grey import to_grey


def test_grey_weighs_green_most():
    image = np.zeros((1, 3, 3), np.uint8)
    image[0, 0, 0] = image[0, 1, 1] = image[0, 2, 2] = 255
    assert to_grey(image).tolist() == [[76, 150, 29]]


def test_corner_strength_by_hand():
    # A ramp of 3 grey levels per pixel in x alone has no corner.
    ramp = np.tile((3 * np.arange(60)).astype(np.uint8), (60, 1))
    assert corner_strength(ramp)[30, 30] == pytest.approx(0.0, abs=1e-4)
    # One of 4 in y that turns from 3 to -3 in x: the five columns around the ridge have slopes of 3, 3, 0, -3
    # and -3 along x, 36 / 5 in the mean of their squares, against 16 along y.
    y, x = np.mgrid[:50, :60]
    ridge = (4 * y + 3 * (10 - np.abs(x - 30)).clip(0)).astype(np.uint8)
    assert corner_strength(ridge)[30, 30] == pytest.approx(36 / 5, rel=1e-4)


def test_corners_are_spread_and_away_from_the_border():
    corners = detect_corners(texture(), 200)
    assert corners.shape[1] == 2
    assert 120 <= len(corners) <= 200
    assert corners.dtype == np.float32
    assert np.all(corners >= BORDER_PX - 3.5)
    assert np.all(corners < np.array([320, 240]) - BORDER_PX + 3.5)
    quarters = np.histogram2d(corners[:, 0], corners[:, 1], bins=(2, 2), range=((0, 320), (0, 240)))[0]
    assert quarters.min() > 0.5 * quarters.max()


def test_corners_keep_away_from_those_there_and_from_lost_rows():
    grey = texture()
    first = detect_corners(grey, 100)
    usable = np.ones(grey.shape, bool)
    usable[96:160] = False
    more = detect_corners(grey, 100, first.astype(float), usable)
    distance = np.linalg.norm(first[:, None] - more[None], axis=2).min()
    assert distance > 2.0
    assert not np.any((more[:, 1] >= 96 + 3.5) & (more[:, 1] < 160 - 3.5))


def test_a_thing_that_is_small_in_the_picture_has_many_corners():
    grey = np.full((480, 640), 240, np.uint8)
    grey[200:260, 300:360] = cv2.resize(texture(shape_hw=(180, 180)), (60, 60), interpolation=cv2.INTER_AREA)
    first = detect_corners(grey, 500)
    more = detect_corners(grey, 500, first.astype(float))
    assert len(first) + len(more) > 100


@pytest.mark.parametrize("sd", [1.5, 4.0])
def test_noise_on_plain_ground_is_measured_and_has_hardly_any_corners(sd):
    rng = np.random.default_rng(3)
    grey = np.full((480, 640), 128.0)
    grey[200:260, 300:360] = cv2.resize(texture(shape_hw=(180, 180)), (60, 60), interpolation=cv2.INTER_AREA)
    noisy = np.rint(grey + rng.normal(0, sd, grey.shape)).clip(0, 255).astype(np.uint8)
    assert noise_energy_grey2(noisy) == pytest.approx(12 / 64 * sd**2, rel=0.15)
    corners = detect_corners(noisy, 500)
    on_thing = np.all((corners > (295, 195)) & (corners < (365, 265)), axis=1)
    assert on_thing.sum() > 60
    assert (~on_thing).sum() < on_thing.sum()


def test_an_image_with_something_everywhere_has_no_noise():
    assert noise_energy_grey2(texture()) < 0.1


def test_gravel_is_no_noise():
    grey = np.random.default_rng(2).normal(128, 35, (240, 320)).clip(0, 255).astype(np.uint8)
    assert len(detect_corners(grey, 200)) == 200


def test_an_empty_image_has_no_corners():
    assert detect_corners(np.zeros((100, 100), np.uint8), 50).shape == (0, 2)
    assert detect_corners(np.full((100, 100), 255, np.uint8), 50).shape == (0, 2)
    assert detect_corners(texture(), 0).shape == (0, 2)
    assert detect_corners(np.zeros((10, 10), np.uint8), 50).shape == (0, 2)


def test_of_points_in_one_cell_one_stays():
    keep = deduplicate(np.array([[1.0, 1], [1.5, 1.5], [9, 9], [11.0, 9]]))
    assert keep.tolist() == [True, False, True, True]


def test_faint_corners_are_found_beside_a_strong_one():
    # A door handle on a bare wall must not hide the little that the floor has.
    grey = np.full((200, 300), 120, np.uint8)
    grey[90:100, 140:165] = 10
    faint = [(x, y) for x in (40, 90, 220, 260) for y in (40, 150)]
    for x, y in faint:
        grey[y - 6 : y + 6, x - 6 : x + 6] += 4
    found = detect_corners(grey, 200)
    for x, y in faint:
        assert np.linalg.norm(found - (x, y), axis=1).min() < 12.0
    assert len(detect_corners(np.full((200, 300), 120, np.uint8), 200)) == 0
