"""A pose is believed only when enough of the landmarks in sight agree with it."""

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.sight import Seen
from semcast.server.mapping.tracker import track_pose
from semcast.server.mapping.world_map import WorldMap

CAMERA = Intrinsics(fx=300, fy=300, cx=159.5, cy=119.5, width=320, height=240)


@pytest.mark.parametrize(("min_share", "is_believed"), [(0.25, True), (0.6, False)])
def test_few_agreeing_landmarks_among_many_are_a_chance_find(min_share, is_believed):
    rng = np.random.default_rng(0)
    xyz = rng.uniform((-2, -1.5, 4), (2, 1.5, 8), (60, 3))
    xy = CAMERA.project(xyz)
    xy[30:] = rng.uniform((0, 0), (319, 239), (30, 2))  # half of them were taken for something else
    ids = np.arange(60)
    world = WorldMap()
    world.add_landmarks(ids, xyz, np.zeros((60, 3), np.uint8), np.ones(60), 0, 0)
    pose = track_pose(
        CAMERA,
        world,
        NoiseModel(0.7, 0.0),
        Seen(ids, xy, np.ones(60)),
        None,
        submap=0,
        seed=0,
        min_share=min_share,
    )
    assert (pose is not None) == is_believed
    if pose is not None:
        np.testing.assert_allclose(pose.T_world_cam, np.eye(4), atol=1e-3)
        assert 30 <= pose.num_inliers < 36


@pytest.mark.parametrize(
    ("is_after_gap", "from_repetition", "is_believed"),
    [
        (False, 20, True),
        (True, 20, False),
        (True, 40, True),
    ],
)
def test_what_contradicts_the_guess_after_a_gap_needs_more_behind_it(
    is_after_gap, from_repetition, is_believed
):
    """Of a row of equal houses, some points fit the camera one house further on."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform((-2, -1.5, 4), (2, 1.5, 8), (60, 3))
    T_world_repeated, T_world_guess = np.eye(4), np.eye(4)
    T_world_repeated[0, 3], T_world_guess[0, 3] = 0.2, 1.0
    xy = rng.uniform((0, 0), (319, 239), (60, 2))
    xy[:from_repetition] = CAMERA.project(xyz[:from_repetition] - T_world_repeated[:3, 3])
    ids = np.arange(60)
    world = WorldMap()
    world.add_landmarks(ids, xyz, np.zeros((60, 3), np.uint8), np.ones(60), 0, 0)
    noise, seen = NoiseModel(0.7, 0.0), Seen(ids, xy, np.ones(60))
    how = {"submap": 0, "seed": 0, "is_after_gap": is_after_gap}
    pose = track_pose(CAMERA, world, noise, seen, T_world_guess, **how)
    assert (pose is not None) == is_believed
    if pose is not None:
        np.testing.assert_allclose(pose.T_world_cam, T_world_repeated, atol=1e-2)


def test_a_pose_near_the_guess_is_believed_after_a_gap_too():
    rng = np.random.default_rng(0)
    xyz = rng.uniform((-2, -1.5, 4), (2, 1.5, 8), (60, 3))
    xy = CAMERA.project(xyz)
    xy[20:] = rng.uniform((0, 0), (319, 239), (40, 2))
    world = WorldMap()
    world.add_landmarks(np.arange(60), xyz, np.zeros((60, 3), np.uint8), np.ones(60), 0, 0)
    T_world_guess = np.eye(4)
    T_world_guess[0, 3] = 0.01
    seen = Seen(np.arange(60), xy, np.ones(60))
    pose = track_pose(
        CAMERA, world, NoiseModel(0.7, 0.0), seen, T_world_guess, submap=0, seed=0, is_after_gap=True
    )
    assert pose is not None
    np.testing.assert_allclose(pose.T_world_cam, np.eye(4), atol=1e-2)


@pytest.mark.parametrize("guess_is_near", [True, False])
def test_landmarks_that_slid_along_edges_carry_a_pose(guess_is_near):
    rng = np.random.default_rng(0)
    xyz = rng.uniform((-2, -1.5, 4), (2, 1.5, 8), (60, 3))
    angle = rng.uniform(0, np.pi, 60)
    along = np.column_stack([np.cos(angle), np.sin(angle)])
    xy = CAMERA.project(xyz) + along * rng.normal(0, 2.0, (60, 1))
    world = WorldMap()
    world.add_landmarks(np.arange(60), xyz, np.zeros((60, 3), np.uint8), np.ones(60), 0, 0)
    noise = NoiseModel(np.sqrt(0.2), 0.0)
    guess = np.eye(4) if guess_is_near else None
    seen = Seen(np.arange(60), xy, np.ones(60), 0.5 * np.log(20.0) * along)
    pose = track_pose(CAMERA, world, noise, seen, guess, submap=0, seed=0)
    assert pose is not None
    assert pose.num_inliers > 55
    np.testing.assert_allclose(pose.T_world_cam, np.eye(4), atol=5e-3)
    rows = np.arange(20)
    assert np.array_equal(seen[rows].edge, seen.edge[rows])
