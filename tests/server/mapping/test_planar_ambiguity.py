"""The other pose and plane that explain two images of a flat scene."""

from dataclasses import replace

import numpy as np

from semcast.common.geometry import invert_transform
from semcast.server.mapping.planar_ambiguity import twin


def test_the_twin_shows_the_same_images_from_elsewhere(wall, projected, relative, direction_error_deg):
    truth = wall()
    other = twin(truth)
    ends = (truth.view == 0) | (truth.view == truth.view.max())
    np.testing.assert_allclose(projected(other)[ends], truth.xy[ends], atol=0.02)
    assert direction_error_deg(other.T_world_cam, truth.T_world_cam) > 25.0
    baselines = [np.linalg.norm(relative(p.T_world_cam)[:3, 3]) for p in (truth, other)]
    np.testing.assert_allclose(*baselines, rtol=1e-3)


def test_its_normal_is_the_way_of_the_camera_and_the_other_way_round(wall, relative):
    # Of a small motion, the two structures swap the plane's normal and the direction of motion.
    truth = wall(way=(0.04, 0.015, 0.025), turn_deg=(0.0, 0.0, 0.0))
    other = twin(truth)
    spread = np.linalg.svd(other.xyz - other.xyz.mean(axis=0))[2]
    way = relative(truth.T_world_cam)[:3, 3]
    assert abs(spread[2] @ way) / np.linalg.norm(way) > 0.999
    moved = relative(other.T_world_cam)[:3, 3]
    normal = np.array([0.2, -0.1, 1.0])
    assert abs(moved @ normal) / np.linalg.norm(moved) / np.linalg.norm(normal) > 0.999


def test_the_twin_of_the_twin_is_the_truth(wall, direction_error_deg):
    truth = wall()
    again = twin(twin(truth))
    assert direction_error_deg(again.T_world_cam, truth.T_world_cam) < 0.5
    np.testing.assert_allclose(again.xyz, truth.xyz, rtol=0.02, atol=0.02)


def test_views_between_are_placed_where_the_plane_asks_for_them(wall, projected):
    truth = wall(bend=0.5)
    error = np.linalg.norm(projected(twin(truth)) - truth.xy, axis=1)
    middle = truth.view == 1
    assert np.median(error[middle]) < 6.0  # a straight line between first and last is 20 px off
    straight = twin(wall(bend=0.0))
    assert np.median(np.linalg.norm(projected(straight) - straight.xy, axis=1)) < 1.0


def test_a_world_frame_that_is_not_the_first_camera_changes_nothing(wall):
    truth = wall()
    T = truth.T_world_cam[2]
    moved = replace(truth, T_world_cam=T @ truth.T_world_cam, xyz=truth.xyz @ T[:3, :3].T + T[:3, 3])
    a, b = twin(truth), twin(moved)
    np.testing.assert_allclose(T @ a.T_world_cam, b.T_world_cam, atol=1e-6)
    back = invert_transform(T)
    np.testing.assert_allclose(b.xyz @ back[:3, :3].T + back[:3, 3], a.xyz, atol=1e-6)


def test_a_scene_with_depth_has_no_twin_and_moving_straight_at_a_wall_neither(arc, wall):
    assert twin(arc(focal_px=600.0, depth=4.0)) is None
    normal = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
    assert twin(wall(way=tuple(0.4 * normal), turn_deg=(0.0, 0.0, 0.0))) is None


def test_too_few_common_points_have_no_twin(wall):
    truth = wall()
    keep = (truth.view != 0) | (truth.point < 8)
    rows = ("view", "point", "xy", "sigma_px", "confidence", "edge")
    few = replace(truth, **{name: getattr(truth, name)[keep] for name in rows})
    assert twin(few) is None


def test_a_principal_point_outside_the_image_is_no_obstacle(wall, direction_error_deg):
    truth = wall()
    camera = replace(truth.camera, cx=truth.camera.cx - 400.0, cy=truth.camera.cy - 300.0)
    shifted = replace(truth, camera=camera, xy=truth.xy - [400.0, 300.0])
    assert direction_error_deg(twin(shifted).T_world_cam, twin(truth).T_world_cam) < 0.1
