from dataclasses import replace

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, make_transform, transform_points
from semcast.evaluation.competitors import COMPETITORS
from semcast.evaluation.pair_matches import PairMatches
from semcast.evaluation.pair_methods import (
    NEW_CORNER_PX,
    competitor_estimator,
    confidence_estimator,
    match_confidence,
)
from semcast.evaluation.pose_error import relative_pose_error
from semcast.server.geometry.weighting import KeypointCues, geometric_confidence

CAMERA = Intrinsics(fx=500, fy=500, cx=320, cy=240, width=640, height=480)
T_CAM1_CAM0 = make_transform(exp_so3([0.02, 0.05, -0.01]), [0.5, 0.1, 0.05])
MODES = ("robust", "paper", "off", "constant", "shuffled", "inverted")


def ends(matches):
    """The geometric confidence of both ends."""
    new = np.full(len(matches), NEW_CORNER_PX)
    none = np.zeros(len(matches))
    first = KeypointCues(matches.confidence0, None, matches.gradient0_grey2, new, none)
    second = KeypointCues(
        matches.confidence1,
        None,
        matches.gradient1_grey2,
        matches.forward_backward_px,
        matches.photometric_grey,
    )
    return geometric_confidence(first), geometric_confidence(second)


@pytest.fixture
def matches(rng):
    points = rng.uniform([-3, -2, 4], [3, 2, 10], (150, 3))
    xy0 = CAMERA.project(points)
    xy1 = CAMERA.project(transform_points(T_CAM1_CAM0, points)) + rng.normal(0, 0.3, (150, 2))
    return PairMatches(
        keypoints0_xy=xy0,
        keypoints1_xy=xy1,
        confidence0=rng.random(150),
        confidence1=rng.random(150),
        keypoint_confidence0=None,
        keypoint_confidence1=None,
        gradient0_grey2=rng.uniform(10, 200, 150),
        gradient1_grey2=rng.uniform(10, 200, 150),
        forward_backward_px=rng.exponential(0.2, 150),
        photometric_grey=rng.uniform(1, 5, 150),
        edge0=np.zeros((150, 2)),
        edge1=np.zeros((150, 2)),
    )


def test_each_mode_gets_its_own_confidence(matches):
    c = {mode: match_confidence(mode, matches, seed=0) for mode in MODES}
    np.testing.assert_array_equal(c["off"], 1.0)
    np.testing.assert_array_equal(c["paper"], np.minimum(matches.confidence0, matches.confidence1))
    assert np.ptp(c["robust"]) > 0.1
    first, second = ends(matches)
    np.testing.assert_allclose(c["robust"], np.minimum(first, second))
    np.testing.assert_allclose(c["constant"], min(first.mean(), second.mean()))
    np.testing.assert_allclose(c["inverted"], np.minimum(1 - first, 1 - second))
    assert (c["shuffled"] != c["robust"]).any()
    assert set(c["shuffled"]) <= {*first, *second}


def test_the_first_end_is_a_new_corner_and_the_second_one_was_followed(matches):
    still = replace(
        matches,
        gradient0_grey2=np.full(150, 100.0),
        gradient1_grey2=np.full(150, 1e9),
        confidence0=np.ones(150),
        confidence1=np.ones(150),
        forward_backward_px=np.full(150, 0.3),
    )
    # First: 2 grey levels over 16 * 100 give 0.05 px, with 0.1 px of a new corner. Second: 0.3 px.
    whole = np.log(1 + (5 / 0.3) ** 2)
    np.testing.assert_allclose(match_confidence("robust", still, 0), 1 - np.log(2) / whole, rtol=1e-3)
    calm = replace(still, forward_backward_px=np.zeros(150))
    first = 1 - np.log(1 + (0.05**2 + 0.1**2) / 0.3**2) / whole
    np.testing.assert_allclose(match_confidence("robust", calm, 0), first)


def test_shuffling_depends_on_the_seed_alone(matches):
    first, again, other = (match_confidence("shuffled", matches, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_descriptor_matches_have_a_confidence_too(matches):
    bare = replace(matches, forward_backward_px=None, photometric_grey=None)
    c = match_confidence("robust", bare, seed=0)
    assert c.shape == (150,)
    assert np.all(c >= match_confidence("robust", matches, seed=0))


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_finds_the_pose(mode, matches):
    estimate = confidence_estimator(mode)(matches, CAMERA, 1.0, 0)
    error = relative_pose_error(estimate, T_CAM1_CAM0)
    assert error.rot_deg < 1.0
    assert error.tdir_deg < 10.0


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_but_that_of_the_paper_is_told_the_shape_of_errors(mode, matches, rng):
    angle = rng.uniform(0, np.pi, 150)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    slid = replace(matches, keypoints1_xy=matches.keypoints1_xy + rng.normal(0, 0.8, (150, 1)) * along)
    matches, edged = slid, replace(slid, edge0=np.log(2.0) * along, edge1=np.log(2.0) * along)
    poses = [confidence_estimator(mode)(m, CAMERA, 1.0, 0) for m in (matches, edged)]
    assert np.array_equal(*poses) == (mode == "paper")


@pytest.mark.parametrize("name", COMPETITORS)
def test_competitors_see_the_same_matches(name, matches):
    error = relative_pose_error(competitor_estimator(name)(matches, CAMERA, 1.0, 0), T_CAM1_CAM0)
    assert error.rot_deg < 1.0


def test_too_few_matches_give_no_pose(matches):
    few = matches.take(np.arange(4))
    for mode in MODES:
        assert confidence_estimator(mode)(few, CAMERA, 1.0, 0) is None
