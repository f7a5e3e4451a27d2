import logging

import cv2
import numpy as np
import pytest
from bags import CONTAINERS, SECOND, BagMaker
from camera_bags import START, STEP, WH, D, K, P, add_images, picture, settings

from semcast.agent.unpack import UnpackSettings, unpack
from semcast.cli import main
from semcast.common.errors import SourceError
from semcast.common.sequence import open_sequence


@pytest.mark.parametrize("container", CONTAINERS)
def test_a_bag_becomes_a_sequence_with_camera_and_path(container, tmp_path):
    bag = BagMaker(container)
    add_images(bag)
    bag.camera_info("/cam/camera_info", K, D, P, WH, time_ns=START)
    for k in range(5):
        bag.transform("/tf", "/world", "/base", (0.5 * k, 0.0, 0.0), START + k * STEP)
    bag.transform("/tf_static", "/base", "/cam", (0.0, 0.0, 1.0), START)
    found = unpack(settings(bag, tmp_path, truth="world"))
    assert (found.num_images, found.num_left_out, found.num_poses) == (5, 0, 5)
    sequence = open_sequence(tmp_path / "out")
    assert sequence.times_ns.tolist() == [START + k * STEP for k in range(5)]
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "out" / "images" / "000003.png")), picture(3))
    camera = sequence.stored_camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50.0, 51.0, 31.5, 23.5)
    assert (camera.width, camera.height, camera.distortion) == (*WH, D)
    positions = sequence.groundtruth().positions
    np.testing.assert_allclose(positions, [(0.5 * k, 0.0, 1.0) for k in range(5)], atol=1e-9)


def test_a_file_of_a_folder_and_the_folder_are_the_same_bag(tmp_path):
    bag = BagMaker("mcap")
    add_images(bag)
    file = bag.write(tmp_path)
    for path, name in ((file, "a"), (file.parent, "b")):
        assert unpack(UnpackSettings(bag=path, out=tmp_path / name)).num_images == 5


def test_compressed_images_stay_what_they_are(tmp_path):
    bag = BagMaker()
    _, jpeg = cv2.imencode(".jpg", picture(7))
    bag.compressed("/cam/image_raw/compressed", jpeg.tobytes(), "jpeg", START)
    bag.camera_info("/cam/camera_info", K, D, P, WH, time_ns=START)
    found = unpack(settings(bag, tmp_path))
    assert (tmp_path / "out" / "images" / "000000.jpg").read_bytes() == jpeg.tobytes()
    assert found.camera is not None, "the camera_info beside /cam/image_raw is that of its compressed images"


def test_rectified_images_have_the_rectified_camera(tmp_path):
    bag = BagMaker()
    add_images(bag, "/cam/image_rect_color")
    bag.camera_info("/cam/camera_info", K, D, P, WH, time_ns=START)
    camera = unpack(settings(bag, tmp_path)).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion) == (40.0, 41.0, 30.5, 22.5, ())


def test_binned_images_of_a_part_of_the_sensor_have_their_own_camera(tmp_path):
    bag = BagMaker("bag")
    add_images(bag)
    # Half the resolution of a part of 128x96 that begins at (20, 10).
    K_full = (100.0, 0.0, 83.5, 0.0, 102.0, 57.5, 0.0, 0.0, 1.0)
    bag.camera_info(
        "/cam/camera_info", K_full, D, P, (200, 150), roi_xywh=(20, 10, 128, 96), binning=2, time_ns=START
    )
    camera = unpack(settings(bag, tmp_path)).camera
    assert (camera.width, camera.height) == WH
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50.0, 51.0, 31.5, 23.5)
    assert camera.distortion == D
    assert open_sequence(tmp_path / "out").stored_camera == camera


def test_binned_pixels_are_whole_ones_where_the_sensor_is_no_multiple_of_them(tmp_path):
    bag = BagMaker()
    add_images(bag)
    # Three columns and rows a pixel: of 194x146 two are left over at the right and at the bottom.
    K_full = (150.0, 0.0, 97.0, 0.0, 153.0, 73.0, 0.0, 0.0, 1.0)
    bag.camera_info("/cam/camera_info", K_full, D, P, (194, 146), binning=3, time_ns=START)
    camera = unpack(settings(bag, tmp_path)).camera
    assert (camera.width, camera.height) == WH
    np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), (50.0, 51.0, 32.0, 24.0))


def test_binning_that_leaves_no_pixel_is_an_error_in_a_line(tmp_path):
    bag = BagMaker()
    add_images(bag)
    bag.camera_info("/cam/camera_info", K, D, P, WH, binning=WH[0] + 1, time_ns=START)
    with pytest.raises(SourceError, match="/cam/camera_info: binning must leave a pixel of 64x48, got 65x65"):
        unpack(settings(bag, tmp_path))
    assert not (tmp_path / "out").exists()


def test_a_camera_that_was_not_calibrated_is_unknown(tmp_path, caplog):
    bag = BagMaker()
    add_images(bag)
    bag.camera_info("/cam/camera_info", np.zeros(9), [], np.zeros(12), WH, time_ns=START)
    assert unpack(settings(bag, tmp_path)).camera is None
    assert "was not calibrated" in caplog.text
    assert not (tmp_path / "out" / "intrinsics.json").exists()


def test_a_fisheye_stays_one(tmp_path):
    bag = BagMaker()
    add_images(bag)
    bag.camera_info("/cam/camera_info", K, D[:4], P, WH, model="equidistant", time_ns=START)
    unpack(settings(bag, tmp_path))
    camera = open_sequence(tmp_path / "out").stored_camera
    assert (camera.distortion_model, camera.distortion) == ("equidistant", D[:4])


def test_an_unknown_lens_is_refused_before_anything_is_written(tmp_path):
    bag = BagMaker()
    add_images(bag)
    bag.camera_info("/cam/camera_info", K, D[:4], P, WH, model="omni", time_ns=START)
    with pytest.raises(SourceError, match="/cam/camera_info: .*pinhole.*'omni'"):
        unpack(settings(bag, tmp_path))
    assert not (tmp_path / "out").exists()


def test_of_several_topics_one_must_be_named(tmp_path):
    bag = BagMaker()
    add_images(bag, "/left/image_raw", 5)
    add_images(bag, "/right/image_raw", 3)
    with pytest.raises(SourceError, match=r"they are: /left/image_raw \(5\), /right/image_raw \(3\)"):
        unpack(settings(bag, tmp_path))


def test_the_topic_that_was_named_is_taken(tmp_path):
    bag = BagMaker()
    add_images(bag, "/left/image_raw", 5)
    add_images(bag, "/right/image_raw", 3)
    assert unpack(settings(bag, tmp_path, image_topic="/right/image_raw")).num_images == 3


@pytest.mark.parametrize(
    ("name", "told"),
    [("image_topic", "must be one of those with images, "), ("camera_info_topic", "must be one of none")],
)
def test_a_topic_that_is_not_there_is_refused(name, told, tmp_path):
    bag = BagMaker()
    add_images(bag)
    with pytest.raises(SourceError, match=rf"{name} {told}.*got /nowhere"):
        unpack(settings(bag, tmp_path, **{name: "/nowhere"}))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "--image-topic must be given where not one topic has images"),
        (["--image-topic", "/x"], "--image-topic must be one of those with images, "),
        (["--image-topic", "/left", "--truth", "/x"], "--truth must be a topic of poses ("),
    ],
)
def test_what_a_bag_does_not_have_is_named_by_its_option(words, message, tmp_path, capsys):
    bag = BagMaker()
    add_images(bag, "/left")
    add_images(bag, "/right")
    wanted = settings(bag, tmp_path)
    assert main(["unpack", str(wanted.bag), "--out", str(wanted.out), *words]) == 1
    assert capsys.readouterr().err.startswith(f"semcast unpack: {message}")


def test_bad_images_are_left_out_and_counted(tmp_path, caplog):
    bag = BagMaker()
    for k in (0, 1, 3):
        bag.image("/cam/image_raw", picture(k), "bgr8", START + k * STEP)
    bag.image("/cam/image_raw", picture(2)[..., 0], "32FC1", START + 2 * STEP)
    # Recorded last, but taken at the time of the second.
    bag.image("/cam/image_raw", picture(4), "bgr8", START + STEP, recorded_ns=START + 4 * STEP)
    with caplog.at_level(logging.WARNING):
        found = unpack(settings(bag, tmp_path))
    assert (found.num_images, found.num_left_out) == (3, 2)
    assert "image 3 is left out: encoding must be one of" in caplog.text
    assert open_sequence(tmp_path / "out").times_ns.tolist() == [START + k * STEP for k in (0, 1, 3)]


def test_a_bag_of_bad_images_is_an_error(tmp_path):
    bag = BagMaker()
    bag.image("/depth/image_raw", np.zeros(WH[::-1], np.uint16), "16UC1", START)
    with pytest.raises(SourceError, match="no image of /depth/image_raw: none of its 1 can be used"):
        unpack(settings(bag, tmp_path))


def test_a_header_without_a_time_leaves_that_of_the_recording(tmp_path):
    bag = BagMaker()
    bag.image("/cam/image_raw", picture(0), "bgr8", 0, recorded_ns=START)
    unpack(settings(bag, tmp_path))
    assert open_sequence(tmp_path / "out").times_ns.tolist() == [START]


def test_a_clock_that_begins_at_zero_tells_a_time(tmp_path):
    bag = BagMaker()
    for k in range(3):
        bag.image("/cam/image_raw", picture(k), "bgr8", k * STEP, recorded_ns=START + k * STEP)
    unpack(settings(bag, tmp_path))
    assert open_sequence(tmp_path / "out").times_ns.tolist() == [0, STEP, 2 * STEP]


def test_an_image_without_a_time_has_that_of_the_recording_on_the_clock_of_the_others(tmp_path):
    bag = BagMaker()
    for k in range(4):
        stamp_ns = 0 if k == 2 else 7 * SECOND + k * STEP
        bag.image("/cam/image_raw", picture(k), "bgr8", stamp_ns, recorded_ns=START + k * STEP)
    unpack(settings(bag, tmp_path))
    assert open_sequence(tmp_path / "out").times_ns.tolist() == [7 * SECOND + k * STEP for k in range(4)]


@pytest.mark.parametrize("wrong", [0, 2])
def test_one_time_far_ahead_costs_one_image(wrong, tmp_path, caplog):
    bag = BagMaker()
    for k in range(5):
        stamp_ns = START + k * STEP + (3600 * SECOND if k == wrong else 0)
        bag.image("/cam/image_raw", picture(k), "bgr8", stamp_ns, recorded_ns=START + k * STEP)
    found = unpack(settings(bag, tmp_path))
    assert (found.num_images, found.num_left_out) == (4, 1)
    assert f"image {wrong + 1} is left out: its time" in caplog.text
    expected = [START + k * STEP for k in range(5) if k != wrong]
    assert open_sequence(tmp_path / "out").times_ns.tolist() == expected


def test_of_two_images_of_one_time_the_first_counts(tmp_path):
    bag = BagMaker()
    for k in (0, 1):
        bag.image("/cam/image_raw", picture(k), "bgr8", START, recorded_ns=START + k * STEP)
    assert unpack(settings(bag, tmp_path)).num_images == 1
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "out" / "images" / "000000.png")), picture(0))


def test_a_part_of_a_bag_can_be_taken(tmp_path):
    bag = BagMaker()
    add_images(bag, count=10)
    unpack(settings(bag, tmp_path, start_s=0.2, seconds=0.3))
    assert open_sequence(tmp_path / "out").times_ns.tolist() == [START + k * STEP for k in (2, 3, 4)]


def test_a_time_without_images_is_an_error(tmp_path):
    bag = BagMaker()
    add_images(bag)
    with pytest.raises(SourceError, match="none in the time asked for"):
        unpack(settings(bag, tmp_path, start_s=60.0))


def test_a_try_that_failed_leaves_the_folder_to_the_next(tmp_path):
    bag = BagMaker()
    add_images(bag)
    wanted = settings(bag, tmp_path, start_s=60.0)
    with pytest.raises(SourceError, match="none in the time asked for"):
        unpack(wanted)
    assert unpack(UnpackSettings(bag=wanted.bag, out=wanted.out)).num_images == 5


def test_a_folder_with_files_is_left_alone(tmp_path):
    bag = BagMaker()
    add_images(bag)
    wanted = settings(bag, tmp_path)
    wanted.out.mkdir()
    (wanted.out / "mine.txt").write_text("mine")
    with pytest.raises(SourceError, match="must be a new or an empty folder"):
        unpack(wanted)
    assert [p.name for p in wanted.out.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(
    ("name", "content"),
    [("none.bag", None), ("bad.bag", b"no bag at all"), ("bad.db3", b"SQLite format 3\0bad")],
)
def test_a_file_that_is_no_bag_is_an_error_in_a_line(name, content, tmp_path):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SourceError) as caught:
        unpack(UnpackSettings(bag=path, out=tmp_path / "out"))
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_no_bag_of_ros_is_named_as_that(tmp_path):
    recording = tmp_path / "run.mcap"
    recording.write_bytes(b"\x89MCAP0\r\n")
    for path in (recording, tmp_path):
        with pytest.raises(SourceError, match=f"{path.name} is no ROS bag: 'semcast info' says what it is"):
            unpack(UnpackSettings(bag=path, out=tmp_path / "out"))


def test_a_bag_with_damage_in_the_middle_is_an_error_in_a_line(tmp_path):
    bag = BagMaker("bag")
    add_images(bag)
    path = bag.write(tmp_path)
    content = path.read_bytes()
    # The name of a field of a message's header, which is text to those who look for it.
    at = content.index(b"time=", content.index(b"conn=", 8000))
    path.write_bytes(content[:at] + b"\x9c" + content[at + 1 :])
    with pytest.raises(SourceError, match="drive.bag can't be read as a ROS bag, it is damaged: ") as caught:
        unpack(UnpackSettings(bag=path, out=tmp_path / "out"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("start_s", -0.1),
        ("start_s", float("nan")),
        ("start_s", float("inf")),
        ("seconds", 0.0),
        ("seconds", float("inf")),
    ],
)
def test_ranges_are_checked(name, value, tmp_path):
    with pytest.raises(ValueError, match=name):
        UnpackSettings(bag=tmp_path / "a.bag", out=tmp_path / "out", **{name: value})


def test_progress_is_told(tmp_path):
    bag = BagMaker()
    add_images(bag, count=3)
    told = []
    unpack(settings(bag, tmp_path), lambda taken, total: told.append((taken, total)))
    assert told == [(1, 3), (2, 3), (3, 3)]
