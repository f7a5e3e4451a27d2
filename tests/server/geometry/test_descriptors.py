import cv2
import numpy as np
from textures import texture

from semcast.server.geometry.corners import detect_corners
from semcast.server.geometry.descriptors import Describer, count_matches, hamming, match_descriptors


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
    grey0 = texture(shape_hw=(360, 480))
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
