import cv2
import numpy as np
import pytest

from semcast.common.codec import DecodedImage
from semcast.evaluation.pair_matches import match_pair


@pytest.fixture
def pair(rng):
    texture = cv2.GaussianBlur(rng.integers(0, 256, (160, 220, 3)).astype(np.uint8), None, 2.0)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    left = np.ascontiguousarray(texture[10:138, 10:202])
    right = np.ascontiguousarray(texture[7:135, 14:206])
    confidence = np.tile(np.linspace(0, 1, 192, dtype=np.float32), (128, 1))
    return DecodedImage(left, confidence), DecodedImage(right, confidence[:, ::-1].copy())


@pytest.mark.parametrize("features", ["klt", "orb", "sift"])
def test_matches_follow_the_shift(pair, features):
    matches = match_pair(*pair, features, 400)
    assert len(matches) > 40
    moved = matches.keypoints1_xy - matches.keypoints0_xy
    np.testing.assert_allclose(np.median(moved, axis=0), [-4, 3], atol=0.1)
    assert np.mean(np.linalg.norm(moved - [-4, 3], axis=1) < 1.5) > 0.9


def test_confidence_is_that_of_the_worse_end(pair):
    matches = match_pair(*pair, "klt", 200)
    x0, x1 = (np.rint(xy[:, 0]) for xy in (matches.keypoints0_xy, matches.keypoints1_xy))
    np.testing.assert_allclose(matches.confidence, np.minimum(x0 / 191, 1 - x1 / 191), atol=1e-5)
    assert set(matches.cues) == {"confidence", "corner_strength", "forward_backward", "photometric"}
    assert (matches.cues["forward_backward"] <= 0).all()


@pytest.mark.parametrize("features", ["klt", "sift"])
def test_each_end_has_the_edge_of_its_image(pair, features):
    # Blurred along the columns all edges of the second image are upright, those of the first are not.
    first, second = pair
    streaks = cv2.GaussianBlur(second.image, (1, 61), 0.1, sigmaY=4.0)
    matches = match_pair(first, DecodedImage(streaks, second.confidence), features, 400)
    assert len(matches.edge0) == len(matches.edge1) == len(matches) > 10
    upright0, upright1 = (np.abs(e[:, 1]) - np.abs(e[:, 0]) for e in (matches.edge0, matches.edge1))
    assert np.median(upright1) > np.median(upright0) + 0.2


def test_keypoint_confidence_becomes_a_cue_where_both_images_have_it(pair):
    first, second = pair
    half = np.full((128, 192), 0.5, np.float32)
    with_both = match_pair(
        DecodedImage(first.image, half, half), DecodedImage(second.image, half, half), "sift", 200
    )
    assert with_both.cues["keypoint_confidence"] == pytest.approx(0.5)
    assert "forward_backward" not in with_both.cues
    with_one = match_pair(DecodedImage(first.image, half, half), second, "sift", 200)
    assert "keypoint_confidence" not in with_one.cues


def test_matches_can_be_thinned(pair):
    matches = match_pair(*pair, "klt", 200)
    some = matches.take(np.array([3, 5]))
    assert len(some) == 2
    np.testing.assert_array_equal(some.keypoints1_xy, matches.keypoints1_xy[[3, 5]])
    assert some.keypoint_confidence0 is None


@pytest.mark.parametrize("features", ["klt", "orb", "sift"])
def test_flat_images_have_no_matches(features):
    flat = DecodedImage(np.full((96, 96, 3), 128, np.uint8), np.ones((96, 96), np.float32))
    matches = match_pair(flat, flat, features, 100)
    assert len(matches) == 0
    assert matches.cues["confidence"].shape == (0,)
