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
