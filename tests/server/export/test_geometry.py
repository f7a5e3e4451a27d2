import numpy as np

from semcast.common.camera import Intrinsics
from semcast.common.run_folder import RunData
from semcast.server.export.geometry import reprojection_errors_px, unique_observations


def two_points(**changes):
    values = {
        "intrinsics": Intrinsics(fx=100, fy=100, cx=31.5, cy=23.5, width=64, height=48),
        "frame_ids": [4, 6],
        "t_source_ns": [0, 1],
        "T_world_cam": np.stack([np.eye(4)] * 2),
        "frame_submap": [0, 0],
        "keyframe_ids": [4, 6],
        "landmark_ids": [9, 2],
        "xyz": [[0, 0, 4], [1, 0, -5]],
        "rgb": [[0, 0, 0], [0, 0, 0]],
        "confidence": [1, 1],
        "landmark_submap": [0, 0],
        "observed_landmark_ids": [9, 9, 2],
        "observed_keyframe_ids": [4, 6, 6],
        "observed_xy": [[31.5, 23.5], [34.5, 27.5], [0, 0]],
        **changes,
    }
    return RunData(**values)


def test_errors_are_distances_in_pixels_and_nan_behind_the_camera():
    np.testing.assert_allclose(reprojection_errors_px(two_points()), [0.0, 5.0, np.nan])


def test_a_camera_moved_right_sees_the_point_further_left():
    T = np.stack([np.eye(4)] * 2)
    T[1, 0, 3] = 0.4  # 0.4 / 4 * 100 = 10 px
    errors = reprojection_errors_px(
        two_points(T_world_cam=T, observed_xy=[[31.5, 23.5], [21.5, 23.5], [0, 0]])
    )
    np.testing.assert_allclose(errors[:2], 0.0, atol=1e-5)


def test_exact_observations_have_no_error(arc_run):
    errors = reprojection_errors_px(arc_run())
    assert len(errors) > 100
    assert errors.max() < 1e-4


def test_a_pair_seen_twice_counts_once():
    data = two_points(observed_landmark_ids=[9, 9, 9], observed_keyframe_ids=[4, 6, 4])
    np.testing.assert_array_equal(unique_observations(data), [0, 1])
