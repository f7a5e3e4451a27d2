import numpy as np
from cloud_of_points import CAMERA, IMAGE, NOISE, make_world

from semcast.server.mapping.new_landmarks import add_landmarks


def test_tracks_with_parallax_become_landmarks():
    world, points, _ = make_world()
    assert add_landmarks(world, CAMERA, NOISE, IMAGE, 1.0) == len(world.landmarks) > 70
    row = world.landmarks.rows(np.arange(len(points)))
    error = np.linalg.norm(world.landmarks.xyz[row[row >= 0]] - points[row >= 0], axis=1)
    assert np.median(error) < 0.03
    inside = np.all(world.keyframes[-1].xy[world.landmarks.ids] >= 0, axis=1)
    assert np.all(world.landmarks.rgb[inside] == (10, 20, 30))
    assert np.allclose(world.landmarks.confidence, 0.8)
    assert add_landmarks(world, CAMERA, NOISE, IMAGE, 1.0) == 0


def test_without_parallax_nothing_is_triangulated():
    world, _, _ = make_world(step=0.001)
    assert add_landmarks(world, CAMERA, NOISE, IMAGE, 1.0) == 0


def test_smaller_angles_do_where_landmarks_run_out():
    def added(num_known, enough):
        world, points, _ = make_world(step=0.04)
        known = np.arange(num_known)
        rgb = np.zeros((num_known, 3), np.uint8)
        world.add_landmarks(known, points[known], rgb, np.ones(num_known), 0, 0)
        return add_landmarks(world, CAMERA, NOISE, IMAGE, 1.5, enough=enough)

    assert added(0, enough=0) < 20, "few have the parallax that is asked for"
    assert added(0, enough=40) > 60
    assert added(40, enough=40) < 10, "there are enough"
    assert added(10, enough=40) > 60
    assert added(10, enough=40) > added(35, enough=40) > added(40, enough=40)


def test_a_slipped_track_is_no_landmark():
    world, _, _ = make_world()
    world.keyframes[-1].xy[:10] += 12.0
    add_landmarks(world, CAMERA, NOISE, IMAGE, 1.0)
    assert np.all(world.landmarks.rows(np.arange(10)) == -1)
