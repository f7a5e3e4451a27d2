import cv2
import numpy as np
import pytest

from semcast.common.codec import KLT_WINDOW_PX
from semcast.server.geometry.features import (
    BORDER_PX,
    Describer,
    corner_strength,
    count_matches,
    deduplicate,
    detect_corners,
    hamming,
    match_descriptors,
    noise_energy_grey2,
    to_grey,
    track_points,
)
from semcast.server.geometry.sampling import sample_map


def texture(seed=0, shape=(240, 320)):
    """Noise at several scales: like photographs, it has something on every level of a pyramid."""
    rng = np.random.default_rng(seed)
    noise = np.zeros(shape, np.float32)
    for sigma in (2.0, 5.0, 12.0):
        layer = cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), None, sigma)
        noise += layer / layer.std()
    return np.clip((noise - noise.mean()) / noise.std() * 45 + 128, 0, 255).astype(np.uint8)


def shifted(grey, dx, dy):
    M = np.array([[1, 0, dx], [0, 1, dy]], dtype=np.float64)
    return cv2.warpAffine(grey, M, grey.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


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
    grey[200:260, 300:360] = cv2.resize(texture(shape=(180, 180)), (60, 60), interpolation=cv2.INTER_AREA)
    first = detect_corners(grey, 500)
    more = detect_corners(grey, 500, first.astype(float))
    assert len(first) + len(more) > 100


@pytest.mark.parametrize("sd", [1.5, 4.0])
def test_noise_on_plain_ground_is_measured_and_has_hardly_any_corners(sd):
    rng = np.random.default_rng(3)
    grey = np.full((480, 640), 128.0)
    grey[200:260, 300:360] = cv2.resize(texture(shape=(180, 180)), (60, 60), interpolation=cv2.INTER_AREA)
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
        thing, ground = shifted(texture(0), *shift), shifted(texture(1), *behind)
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
    corners = detect_corners(texture(0), 150).astype(np.float64)
    found = track_points(texture(0), texture(1), corners, corners)
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


def test_of_points_in_one_cell_one_stays():
    keep = deduplicate(np.array([[1.0, 1], [1.5, 1.5], [9, 9], [11.0, 9]]))
    assert keep.tolist() == [True, False, True, True]


def test_descriptors_match_as_opencv_matches_them():
    rng = np.random.default_rng(0)
    mine = rng.integers(0, 256, (90, 32), dtype=np.uint8)
    theirs = np.concatenate([mine[::2], ~mine[:1], rng.integers(0, 256, (20, 32), dtype=np.uint8), mine[4:9]])
    for k, other in enumerate(theirs[:45]):  # a few bits differ, in some as many as in another one
        other[: 1 + k % 9] ^= 3
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(mine, theirs, k=2)
    back = [m.trainIdx for m in cv2.BFMatcher(cv2.NORM_HAMMING).match(theirs, mine)]
    expected = sorted(
        (a.distance, a.queryIdx, a.trainIdx)
        for a, b in pairs
        if a.distance <= min(64, 0.9 * b.distance) and back[a.trainIdx] == a.queryIdx
    )
    assert len(expected) > 30
    row0, row1 = match_descriptors(mine, theirs)
    assert list(zip(row0, row1, strict=True)) == [(a, b) for _, a, b in expected]
    counted = sum(a.distance <= min(60, 0.75 * b.distance) for a, b in pairs)
    assert count_matches(mine, theirs) == counted > 30
    # Where all 256 bits differ, that is far, and not near.
    assert count_matches(mine[:1], np.stack([~mine[0], mine[1]])) == 0


def test_descriptors_match_across_a_shift_and_a_change_of_size():
    grey0 = texture(shape=(360, 480))
    describer = Describer()
    corners = detect_corners(grey0, 150).astype(np.float64)
    rows, descriptors = describer.describe(grey0, corners)
    for factor, octaves in ((1.0, (0,)), (1.44, (0, 2))):
        grey1 = cv2.resize(grey0, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
        moved = (corners + 0.5) * factor - 0.5
        rows1, descriptors1 = describer.describe(grey1, moved, octaves)
        mine, theirs = match_descriptors(descriptors1, descriptors)
        right = rows1[mine] == rows[theirs]
        assert len(mine) > 40
        assert right.mean() > 0.9


def test_hamming_by_hand_and_no_descriptors():
    a = np.array([[0b1010, 255], [0, 0]], np.uint8)
    b = np.array([[0b0110, 255], [1, 3]], np.uint8)
    assert hamming(a, b).tolist() == [2, 3]
    rows, descriptors = Describer().describe(texture(), np.zeros((0, 2)))
    assert rows.shape == (0,)
    assert descriptors.shape == (0, 32)
    assert len(match_descriptors(descriptors, descriptors)[0]) == 0


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
