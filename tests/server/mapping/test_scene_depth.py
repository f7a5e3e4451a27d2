import numpy as np
import pytest
from cloud_of_points import CAMERA, make_world, put_landmarks

from semcast.common.geometry import transform_points
from semcast.server.mapping.scene_depth import median_depth, median_depth_of, usual_depth
from semcast.server.mapping.world_map import Keyframe, WorldMap


def test_the_usual_depth_is_not_that_of_the_last_few_landmarks_before_a_loss():
    world, points, truth = make_world(num_keyframes=3, num_points=80)
    put_landmarks(world, points)
    usual = usual_depth(world, 50)
    assert 6.0 < usual < 9.0
    newest = world.keyframes[-1]
    newest.ids, newest.xy, newest.confidence = (a[:5] for a in (newest.ids, newest.xy, newest.confidence))
    near = transform_points(truth[-1], CAMERA.unproject(newest.xy) * 0.5)
    world.move_landmarks(newest.ids, near)
    assert usual_depth(world, 50) == pytest.approx(usual, rel=0.2)
    assert usual_depth(world, 81) == pytest.approx(0.5, rel=0.1), "none sees enough: that of the newest"
    assert usual_depth(WorldMap(), 50) == 1.0


def test_the_median_is_over_the_landmarks_that_the_keyframe_sees():
    world = WorldMap()
    ids = np.array([4, 5, 6, 9])
    seen = Keyframe(0, 0, np.eye(4), 0, ids[:3], np.zeros((3, 2)), np.ones(3))
    xyz = np.array([[0.0, 0.0, z] for z in (1.0, 2.0, 6.0, 50.0)])
    assert median_depth_of(seen, ids, xyz) == 2.0
    assert median_depth(world, seen) == np.inf, "the map is empty"
