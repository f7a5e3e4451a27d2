import pytest
from cloud_of_points import CAMERA, make_world, put_landmarks

from semcast.common.geometry import transform_points
from semcast.server.mapping.scene_depth import usual_depth
from semcast.server.mapping.world_map import WorldMap


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
