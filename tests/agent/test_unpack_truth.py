"""The true path that a bag has of its camera."""

import numpy as np
import pytest
from bags import SECOND, BagMaker
from camera_bags import START, STEP, add_images, settings

from semcast.agent.unpack import UnpackSettings, unpack
from semcast.common.errors import SourceError
from semcast.common.sequence import open_sequence


def test_poses_without_a_frame_of_their_own_are_the_cameras(tmp_path):
    bag = BagMaker()
    add_images(bag)
    for k in (0, 2, 4):
        bag.pose("/mocap", "room", (1.0 * k, 0.0, 0.0), START + k * STEP)
    assert unpack(settings(bag, tmp_path, truth="/mocap")).num_poses == 5
    positions = open_sequence(tmp_path / "out").groundtruth().positions
    np.testing.assert_allclose(positions[:, 0], [0.0, 1.0, 2.0, 3.0, 4.0], atol=1e-9)


def test_poses_of_a_body_reach_the_camera_by_tf_and_win_over_it(tmp_path):
    bag = BagMaker()
    add_images(bag)
    for k in range(5):
        bag.odometry("/odom", "odom", "base", (1.0 * k, 0.0, 0.0), START + k * STEP)
        bag.transform("/tf", "map", "base", (99.0, 0.0, 0.0), START + k * STEP)
    bag.transform("/tf_static", "base", "cam", (0.0, 2.0, 0.0), START)
    unpack(settings(bag, tmp_path, truth="/odom"))
    positions = open_sequence(tmp_path / "out").groundtruth().positions
    np.testing.assert_allclose(positions, [(1.0 * k, 2.0, 0.0) for k in range(5)], atol=1e-9)


def test_poses_of_a_sibling_of_the_camera_reach_it_too(tmp_path):
    # What a tracker of motions, or an estimator by inertia, calls its body seldom is the root of the rig.
    bag = BagMaker()
    add_images(bag)
    for k in range(5):
        bag.odometry("/vio", "world", "imu", (1.0 * k, 0.0, 0.0), START + k * STEP)
    bag.transform("/tf_static", "base", "imu", (0.0, 0.0, 3.0), START)
    bag.transform("/tf_static", "base", "cam", (0.0, 2.0, 0.0), START)
    assert unpack(settings(bag, tmp_path, truth="/vio", camera_frame="/cam")).num_poses == 5
    positions = open_sequence(tmp_path / "out").groundtruth().positions
    np.testing.assert_allclose(positions, [(1.0 * k, 2.0, -3.0) for k in range(5)], atol=1e-9)


@pytest.mark.parametrize("images", ["/red/cam/image_raw", "/cam/image_raw"])
def test_transforms_of_a_namespace_are_those_of_what_lies_in_it(images, tmp_path):
    bag = BagMaker()
    add_images(bag, images)
    for k in range(5):
        if images.startswith("/red"):  # of another robot, whose frames have the same names
            bag.transform("/blue/tf", "map", "base", (0.0, 9.0, 9.0), START + k * STEP)
        bag.transform("/red/tf", "map", "base", (1.0 * k, 0.0, 0.0), START + k * STEP)
    bag.transform("/red/tf_static", "base", "cam", (0.0, 2.0, 0.0), START)
    unpack(settings(bag, tmp_path, truth="map"))
    positions = open_sequence(tmp_path / "out").groundtruth().positions
    np.testing.assert_allclose(positions, [(1.0 * k, 2.0, 0.0) for k in range(5)], atol=1e-9)


@pytest.mark.parametrize("images", ["/robot/cam/image_raw", "/cam/image_raw"])
def test_transforms_of_a_namespace_count_beside_fixed_ones_at_the_root(images, tmp_path):
    bag = BagMaker()
    add_images(bag, images)
    for k in range(5):
        bag.transform("/robot/tf", "map", "base", (1.0 * k, 0.0, 0.0), START + k * STEP)
    bag.transform("/tf_static", "base", "cam", (0.0, 2.0, 0.0), START)
    unpack(settings(bag, tmp_path, truth="map"))
    positions = open_sequence(tmp_path / "out").groundtruth().positions
    np.testing.assert_allclose(positions, [(1.0 * k, 2.0, 0.0) for k in range(5)], atol=1e-9)


@pytest.mark.parametrize("of_camera", ["", "/red"])
def test_transforms_of_other_namespaces_do_not_count_where_the_cameras_own_say_it(of_camera, tmp_path):
    bag = BagMaker()
    add_images(bag, f"{of_camera}/cam/image_raw")
    for k in range(5):
        bag.transform(f"{of_camera}/tf", "map", "cam", (1.0 * k, 0.0, 0.0), START + k * STEP)
        bag.transform("/blue/tf", "map", "cam", (0.0, 9.0, 9.0), START + k * STEP + STEP // 2)
    if of_camera:  # of another robot: nothing is known of what is fixed to this one
        bag.transform("/blue/tf_static", "map", "cam", (9.0, 9.0, 9.0), START)
    unpack(settings(bag, tmp_path, truth="map"))
    positions = open_sequence(tmp_path / "out").groundtruth().positions
    np.testing.assert_allclose(positions, [(1.0 * k, 0.0, 0.0) for k in range(5)], atol=1e-9)


def test_poses_that_do_not_say_of_what_they_are_can_be_said_to_be_of_a_body(tmp_path):
    bag = BagMaker()
    add_images(bag)
    for k in range(5):
        bag.pose("/mocap", "room", (1.0 * k, 0.0, 0.0), START + k * STEP)
    bag.transform("/tf_static", "base", "cam", (0.0, 2.0, 0.0), START)
    unpack(settings(bag, tmp_path, truth="/mocap", truth_frame="/base"))
    positions = open_sequence(tmp_path / "out").groundtruth().positions
    np.testing.assert_allclose(positions, [(1.0 * k, 2.0, 0.0) for k in range(5)], atol=1e-9)


def test_a_body_that_does_not_lead_to_the_camera_is_refused(tmp_path):
    bag = BagMaker()
    add_images(bag)
    bag.pose("/mocap", "room", (0.0, 0.0, 0.0), START)
    bag.transform("/tf_static", "base", "cam", (0.0, 2.0, 0.0), START)
    with pytest.raises(SourceError, match="no transform of a frame 'robot': known are base, cam"):
        unpack(settings(bag, tmp_path, truth="/mocap", truth_frame="robot"))


def test_poses_of_several_bodies_are_refused(tmp_path):
    bag = BagMaker()
    add_images(bag)
    for k, body in enumerate(("drone", "car")):
        bag.odometry("/mocap", "room", body, (0.0, 0.0, 0.0), START + k * STEP)
    with pytest.raises(SourceError, match="/mocap must be of one frame .*'car' in 'room', 'drone' in 'room'"):
        unpack(settings(bag, tmp_path, truth="/mocap"))


def test_what_a_tracker_says_that_lost_its_body_is_no_pose(tmp_path, caplog):
    bag = BagMaker()
    add_images(bag)
    for k in range(5):
        bag.pose("/mocap", "room", (1.0 * k, 0.0, 0.0), START + k * STEP)
    bag.pose("/mocap", "room", (0.0, 0.0, 0.0), START + STEP // 2, w=0.0)
    bag.pose("/mocap", "room", (float("nan"), 0.0, 0.0), START + STEP // 4)
    bag.transform("/tf", "map", "wheel", (0.0, 0.0, 0.0), START, (0.0, 0.0, 0.0, 0.0))
    assert unpack(settings(bag, tmp_path, truth="/mocap")).num_poses == 5
    assert "/mocap: '' in 'room' is left out where it is no pose: position must be finite" in caplog.text
    assert "tf: 'wheel' in 'map' is left out" in caplog.text


@pytest.mark.parametrize("speed", [1.0, 0.0], ids=["moving", "at rest"])
def test_images_without_a_pose_have_none(speed, tmp_path):
    bag = BagMaker()
    add_images(bag)
    for k in range(3):
        bag.pose("/mocap", "room", (speed * k, 0.0, 0.0), START + k * STEP)
    assert unpack(settings(bag, tmp_path, truth="/mocap")).num_poses == 3


def test_a_path_of_another_time_is_told(tmp_path, caplog):
    bag = BagMaker()
    add_images(bag)
    bag.pose("/mocap", "room", (0.0, 0.0, 0.0), SECOND)
    assert unpack(settings(bag, tmp_path, truth="/mocap")).num_poses is None
    assert "no true pose at the time of any image" in caplog.text


def test_a_truth_that_is_neither_topic_nor_frame_is_refused_before_anything_is_written(tmp_path):
    bag = BagMaker()
    add_images(bag)
    bag.pose("/mocap", "room", (0.0, 0.0, 0.0), START)
    bag.transform("/tf_static", "base", "cam", (0.0, 2.0, 0.0), START)
    with pytest.raises(
        SourceError, match=r"topic of poses \(/mocap\) or a frame of /tf \(base, cam\), got map"
    ):
        unpack(settings(bag, tmp_path, truth="map"))
    assert not (tmp_path / "out").exists()


def test_images_that_name_no_frame_need_one_for_the_truth(tmp_path):
    bag = BagMaker()
    add_images(bag, frame="")
    bag.transform("/tf_static", "base", "cam", (0.0, 2.0, 0.0), START)
    wanted = settings(bag, tmp_path, truth="base")
    with pytest.raises(SourceError, match="camera_frame must be given"):
        unpack(wanted)
    named = UnpackSettings(bag=wanted.bag, out=wanted.out, truth="base", camera_frame="cam")
    assert unpack(named).num_poses == 5
