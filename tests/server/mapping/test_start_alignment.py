"""Tracks of the views a map begins with, put where their images have them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from textures import layered_noise

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, invert_transform, make_transform
from semcast.server.mapping.kept_frames import Observed
from semcast.server.mapping.start_alignment import aligned_views

CAMERA = Intrinsics(fx=250.0, fy=250.0, cx=160.0, cy=120.0, width=320, height=240)
DEPTH_M = 4.0
#: From the pixels of the picture on the wall to the wall, of which one pixel is seen as about one.
ON_WALL = np.array([[0.016, 0.0, -4.8], [0.0, 0.016, -4.0], [0.0, 0.0, DEPTH_M], [0.0, 0.0, 1.0]])


def pose(k):
    """A camera that goes 8 cm sideways and rolls 3 degrees from view to view."""
    return make_transform(exp_so3(np.radians([0.0, 1.0 * k, 3.0 * k])), [0.08 * k, 0.01 * k, 0.0])


def truth_in(T_world_cam, xyz):
    T = invert_transform(T_world_cam)
    return CAMERA.project(xyz @ T[:3, :3].T + T[:3, 3])


@pytest.fixture(scope="module")
def start():
    """Five noisy views of a wall, tracks that drifted, the poses, and where the points are."""
    rng, picture = np.random.default_rng(0), layered_noise((500, 600), (2, 4, 9), 3) * 20 + 128
    poses = np.stack([pose(k) for k in range(5)])
    across, down = np.meshgrid(np.linspace(-1.6, 2.2, 14), np.linspace(-1.3, 1.5, 10))
    xyz = np.column_stack([across.ravel(), down.ravel(), np.full(across.size, DEPTH_M)])
    views, truths = [], []
    for k, T_world_cam in enumerate(poses):
        seen = cv2.warpPerspective(
            picture, CAMERA.K @ invert_transform(T_world_cam)[:3] @ ON_WALL, (320, 240)
        )
        grey = np.clip(seen + 6.0 * rng.standard_normal(seen.shape), 0, 255).astype(np.uint8)
        true = truth_in(T_world_cam, xyz)
        inside = ((true > 12) & (true < [308, 228])).all(axis=1)
        true = true[inside]
        xy = true + 0.7 * rng.standard_normal(true.shape)
        views.append(Observed(k, k * 10**8, np.flatnonzero(inside), xy, np.ones(len(xy)), None, grey))
        truths.append(true)
    return views, poses, truths


def disagreement_px(views, truths):
    """How far points move against each other from view to view, which is what a start is decided by."""
    moved = []
    for view0, true0 in zip(views, truths, strict=True):
        for view1, true1 in zip(views, truths, strict=True):
            _, i, j = np.intersect1d(view0.ids, view1.ids, return_indices=True)
            moved.append(((view1.xy - true1)[j] - (view0.xy - true0)[i]).ravel())
    return float(np.sqrt(np.mean(np.concatenate(moved) ** 2)))


def test_views_agree_after_they_were_aligned_with_each_other(start):
    views, poses, truths = start
    before, after = (
        disagreement_px(views, truths),
        disagreement_px(aligned_views(CAMERA, views, poses), truths),
    )
    assert before > 0.8
    assert after < 0.5 * before


def test_turns_between_the_views_are_taken_into_account(start):
    views, poses, truths = start
    no_turn = np.tile(np.eye(4), (len(poses), 1, 1))
    with_turns = disagreement_px(aligned_views(CAMERA, views, poses), truths)
    assert with_turns < 0.8 * disagreement_px(aligned_views(CAMERA, views, no_turn), truths)


def test_nothing_but_the_places_is_changed(start):
    views, poses, _ = start
    for before, after in zip(views, aligned_views(CAMERA, views, poses), strict=True):
        assert replace(after, xy=before.xy) == before
        assert after.xy.shape == before.xy.shape
        assert np.isfinite(after.xy).all()


def test_a_view_without_an_image_stays_and_tells_nothing_of_the_others(start):
    views, poses, _ = start
    blind = [replace(views[0], grey=None), *views[1:]]
    found = aligned_views(CAMERA, blind, poses)
    assert found[0] is blind[0]
    rest = aligned_views(CAMERA, views[1:], poses[1:])
    for one, other in zip(found[1:], rest, strict=True):
        np.testing.assert_array_equal(one.xy, other.xy)


def test_a_point_that_the_others_have_somewhere_else_stays(start):
    views, poses, _ = start
    lost = views[2].xy.copy()
    lost[7] += (9.0, -8.0)
    found = aligned_views(CAMERA, [*views[:2], replace(views[2], xy=lost), *views[3:]], poses)
    np.testing.assert_array_equal(found[2].xy[7], lost[7])


def test_a_view_the_other_way_tells_nothing(start):
    views, poses, _ = start
    behind = poses.copy()
    behind[4, :3, :3] = poses[4, :3, :3] @ exp_so3(np.radians([0.0, 170.0, 0.0]))
    with_it, without = aligned_views(CAMERA, views, behind), aligned_views(CAMERA, views[:4], poses[:4])
    for one, other in zip(with_it[:4], without, strict=True):
        np.testing.assert_array_equal(one.xy, other.xy)
    np.testing.assert_array_equal(with_it[4].xy, views[4].xy)
