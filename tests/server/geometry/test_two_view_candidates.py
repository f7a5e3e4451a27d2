"""Relative poses that two images may have."""

import numpy as np
import pytest
from two_view_matches import CAMERA, make_far_matches, make_matches

from semcast.common.geometry import (
    angle_between_deg,
    rotation_angle_deg,
)
from semcast.server.geometry import two_view_candidates
from semcast.server.geometry.two_view_candidates import from_plane, near_turning


@pytest.mark.parametrize("seed", range(4))
def test_a_motion_near_pure_turning_is_found_without_a_search(seed):
    T, xy0, xy1 = make_far_matches(seed, 0.0, 0.2)
    poses = near_turning(CAMERA, xy0, xy1, 1.0)
    # The sign of the translation is chosen afterwards; the axis ahead alone would be 12 degrees off.
    direction = [angle_between_deg(pose[:3, 3], T[:3, 3]) for pose in poses]
    best = int(np.argmin([min(angle, 180 - angle) for angle in direction]))
    assert min(direction[best], 180 - direction[best]) < 3.0
    assert rotation_angle_deg(poses[best][:3, :3] @ T[:3, :3].T) < 0.2


def test_a_plane_leads_to_the_true_pose_and_no_plane_to_none():
    T, xy0, xy1, _ = make_matches(0, t=(0.8, 0.1, 0.1), plane=True, outlier_share=0.0, noise_px=0.0)
    errors = [
        rotation_angle_deg(pose[:3, :3] @ T[:3, :3].T) + angle_between_deg(pose[:3, 3], T[:3, 3])
        for pose in from_plane(CAMERA, xy0, xy1, 1.0, 0)
    ]
    assert min(errors) < 0.01
    _, xy0, xy1, _ = make_matches(0, t=(3.0, 0.1, 0.1))
    assert from_plane(CAMERA, xy0, xy1, 1.0, 0) == []


def test_matches_are_drawn_from_all_from_those_that_agree_and_in_order_of_confidence():
    kept = np.array([0, 2, 3])
    every, among, ordered = two_view_candidates._orders_of_drawing(4, kept, np.array([0.1, 1.0, 0.5, 0.9]))
    assert (every[0].tolist(), every[1]) == ([0, 1, 2, 3], False)
    assert (among[0].tolist(), among[1]) == ([0, 2, 3], False)
    assert (ordered[0].tolist(), ordered[1]) == ([3, 2, 0], True)
    # Nine of ten are nearly all: a search among these would be the first one over again.
    assert len(two_view_candidates._orders_of_drawing(10, np.arange(9), None)) == 1
    assert len(two_view_candidates._orders_of_drawing(11, np.arange(9), None)) == 2
