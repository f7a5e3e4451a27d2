"""Streaks of motion blur are told by spectra, and laid on the other image."""

import cv2
import numpy as np
import pytest

from semcast.server.geometry.streaks import Streak, band_power, blurred_alike, differing_streaks


def scene(x=0, seed=3):
    """Boxes of many sizes, 240 by 320, from a camera that moved by ``x`` pixels."""
    rng = np.random.default_rng(seed)
    image = np.full((300, 420), 120, np.uint8)
    for size in np.geomspace(60, 4, 400).astype(int).tolist():
        left, top = int(rng.integers(-20, 420)), int(rng.integers(-20, 300))
        shape = (left + size, top + int(size * rng.uniform(0.5, 2.0)))
        cv2.rectangle(image, (left, top), shape, int(rng.integers(20, 230)), -1)
    return np.ascontiguousarray(image[20:260, 20 + x : 340 + x])


def line_blurred(image, length_px, angle_deg):
    """Mean of copies moved along a line: made without the kernels under test."""
    offset = np.linspace(-0.5, 0.5, 41) * length_px
    angle = np.radians(angle_deg)
    size = image.shape[::-1]
    moved = [
        cv2.warpAffine(
            image.astype(np.float32),
            np.float32([[1, 0, s * np.cos(angle)], [0, 1, s * np.sin(angle)]]),
            size,
            borderMode=cv2.BORDER_REFLECT_101,
        )
        for s in offset
    ]
    return np.rint(np.mean(moved, axis=0)).astype(np.uint8)


def told(image0, image1):
    return differing_streaks(band_power(image0), band_power(image1))


@pytest.mark.parametrize(
    ("first", "second"), [((15, 40), (15, 130)), ((25, 0), (25, 70)), ((12, 170), (21, 60))]
)
def test_the_streak_of_each_image_is_told(first, second):
    found = told(line_blurred(scene(), *first), line_blurred(scene(8), *second))
    for streak, (length_px, angle_deg) in zip(found, (first, second), strict=True):
        assert abs(streak.length_px - length_px) <= 3.0
        off_deg = (np.degrees(streak.angle_rad) - angle_deg + 90.0) % 180.0 - 90.0
        assert abs(off_deg) <= 10.0


def test_a_sharp_image_has_no_streak():
    none, streak = told(scene(), line_blurred(scene(8), 15, 40))
    assert none is None
    assert abs(streak.length_px - 15) <= 3.0
    streak, none = told(line_blurred(scene(), 15, 40), scene(8))
    assert none is None
    assert abs(streak.length_px - 15) <= 3.0


def test_streaks_in_common_stay():
    one, other = line_blurred(scene(), 21, 40), line_blurred(scene(8), 21, 40)
    assert told(one, other) is None
    kept = blurred_alike(one, other, band_power(one), band_power(other))
    assert kept[0] is one
    assert kept[1] is other


@pytest.mark.parametrize(
    "change",
    [
        lambda image: image,
        lambda image: (image * 0.5 + 20).astype(np.uint8),
        lambda image: cv2.GaussianBlur(image, None, 2.0),
        lambda image: np.clip(image + np.random.default_rng(0).normal(0, 12, image.shape), 0, 255).astype(
            np.uint8
        ),
        lambda image: np.full_like(image, 90),
    ],
    ids=["motion", "exposure", "defocus", "noise", "nothing to see"],
)
def test_what_is_no_streak_is_taken_for_none(change):
    assert told(scene(), change(scene(8))) is None


def test_images_with_the_streaks_of_both_look_alike():
    one, other = line_blurred(scene(), 25, 20), line_blurred(scene(), 25, 110)
    before = np.abs(one.astype(float) - other).mean()
    alike = blurred_alike(one, other, band_power(one), band_power(other))
    after = np.abs(alike[0].astype(float) - alike[1]).mean()
    assert before > 8.0
    assert after < 0.2 * before


@pytest.mark.parametrize("angle_deg", [0, 30, 90, 145])
def test_a_streak_lies_about_where_the_point_was(angle_deg):
    dot = np.zeros((61, 61), np.uint8)
    dot[30, 30] = 255
    dot = cv2.GaussianBlur(dot, None, 1.5) * 10
    drawn = Streak(21.0, np.radians(angle_deg)).laid_on(dot).astype(float)
    y, x = np.mgrid[-30:31, -30:31]
    middle = np.array([(x * drawn).sum(), (y * drawn).sum()]) / drawn.sum()
    assert np.abs(middle).max() < 0.1
    across = x * np.sin(np.radians(angle_deg)) - y * np.cos(np.radians(angle_deg))
    along = x * np.cos(np.radians(angle_deg)) + y * np.sin(np.radians(angle_deg))
    assert np.ptp(along[drawn > 4]) > 18.0
    assert np.ptp(across[drawn > 4]) < 12.0


def test_an_image_of_one_pixel_has_a_spectrum():
    assert np.isfinite(band_power(np.zeros((1, 1), np.uint8))).all()
