import json

import cv2
import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.camera_settings import CameraSettings
from semcast.common.errors import SourceError
from semcast.common.geometry import exp_so3, invert_transform, make_transform, quat_wxyz_from_rotation
from semcast.common.sequence import as_rgb, open_sequence, read_image, truth_at_frames
from semcast.common.sequence_layouts import natural_key
from semcast.common.trajectory import Trajectory, write_tum

CAMERA = Intrinsics(fx=30.0, fy=31.0, cx=15.5, cy=11.5, width=32, height=24)


def write_images(folder, count, pattern="{:06d}.png", size=(24, 32), channels=3):
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(count):
        image = np.full((*size, 3) if channels == 3 else size, k * 10, dtype=np.uint8)
        if channels == 3:
            image[:, :, 0] = 200  # blue in OpenCV's order
        cv2.imwrite(str(folder / pattern.format(k)), image)


def poses(count, step=0.5):
    return np.array(
        [make_transform(exp_so3([0.0, 0.1 * k, 0.0]), (step * k, 0.0, 0.2 * k)) for k in range(count)]
    )


@pytest.fixture
def native(tmp_path):
    folder = tmp_path / "walk"
    write_images(folder / "images", 5)
    (folder / "times.txt").write_text("".join(f"{0.1 * k:.9f}\n" for k in range(5)))
    CAMERA.save(folder / "intrinsics.json")
    write_tum(folder / "groundtruth.txt", Trajectory(0.1 * np.arange(5), poses(5)))
    return folder


def test_native_layout_gives_images_times_camera_and_truth(native):
    sequence = open_sequence(native)
    assert (sequence.name, len(sequence), sequence.intrinsics) == ("walk", 5, CAMERA)
    np.testing.assert_array_equal(sequence.times_ns, 100_000_000 * np.arange(5))
    image = sequence.image(3)
    assert image.shape == (24, 32, 3)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image[0, 0], [30, 30, 200])  # RGB
    truth = sequence.groundtruth()
    np.testing.assert_array_equal(truth.t_s, sequence.times_ns * 1e-9)
    np.testing.assert_allclose(truth.T_world_cam, poses(5), atol=1e-6)


def test_stride_and_max_frames_keep_the_ids_of_the_recording(native):
    sequence = open_sequence(native, stride=2, max_frames=2)
    np.testing.assert_array_equal(sequence.frame_ids, [0, 2])
    np.testing.assert_array_equal(sequence.times_ns, [0, 200_000_000])
    assert sequence.image(1)[0, 0, 0] == 20
    with pytest.raises(IndexError, match=r"frame must be in \[0, 1\], got 2"):
        sequence.image(2)


def test_resizing_keeps_rays_where_they_were(native):
    full, half = open_sequence(native), open_sequence(native, resize=0.5)
    assert half.image(0).shape == (12, 16, 3)
    # The corner of the image (its edge, not its first pixel) looks the same way at every size.
    np.testing.assert_allclose(
        half.intrinsics.unproject([[-0.5, -0.5], [15.5, 11.5]]),
        full.intrinsics.unproject([[-0.5, -0.5], [31.5, 23.5]]),
        atol=1e-12,
    )


def test_an_image_is_brought_to_the_camera_of_a_resized_stream(native):
    sequence = open_sequence(native)
    camera = open_sequence(native, resize=0.5).intrinsics
    assert sequence.image(1, camera).shape == (12, 16, 3)
    other = Intrinsics(fx=90.0, fy=90.0, cx=7.5, cy=5.5, width=16, height=12)
    with pytest.raises(ValueError, match="camera must be walk's own at another size"):
        sequence.image(1, other)


def test_grey_sixteen_bit_and_transparent_images_become_rgb():
    grey = np.array([[7, 9]], dtype=np.uint8)
    np.testing.assert_array_equal(as_rgb(grey), [[[7, 7, 7], [9, 9, 9]]])
    np.testing.assert_array_equal(as_rgb(np.array([[0x1234]], dtype=np.uint16)), [[[0x12] * 3]])
    bgra = np.array([[[10, 20, 30, 255], [10, 20, 30, 0], [0, 0, 0, 51]]], dtype=np.uint8)
    np.testing.assert_array_equal(as_rgb(bgra), [[[30, 20, 10], [255, 255, 255], [204, 204, 204]]])


@pytest.mark.parametrize(("bits", "brightest"), [(8, 250), (10, 1000), (12, 4000), (14, 9000), (16, 60000)])
def test_images_of_fewer_bits_in_files_of_sixteen_are_as_bright_as_meant(tmp_path, caplog, bits, brightest):
    caplog.set_level("INFO")
    (tmp_path / "images").mkdir()
    for k, top in enumerate((brightest, brightest // 3, brightest)):
        image = np.linspace(0, top, 24 * 32).reshape(24, 32).astype(np.uint16)
        cv2.imwrite(str(tmp_path / "images" / f"{k}.png"), image)
    sequence = open_sequence(tmp_path)
    dark = open_sequence(tmp_path, stride=3, max_frames=1)  # bits are those of the whole recording
    for image, top in ((sequence.image(1), brightest // 3), (dark.image(0), brightest)):
        assert image.max() == top >> (bits - 8)
        assert image.shape == (24, 32, 3)
    assert (f"16-bit images are read as {bits}-bit" in caplog.text) == (bits != 16)
    alone = read_image(tmp_path / "images" / "0.png")
    assert alone.max() == brightest >> (bits - 8), "one by one an image goes by itself"


def test_a_dark_beginning_and_end_do_not_tell_the_bits_of_a_recording(tmp_path):
    (tmp_path / "images").mkdir()
    for k in range(20):
        image = np.full((24, 32), 4000 if 12 <= k < 15 else 200, np.uint16)
        cv2.imwrite(str(tmp_path / "images" / f"{k:02d}.png"), image)
    sequence = open_sequence(tmp_path)
    assert [int(sequence.image(k).max()) for k in (0, 12)] == [200 >> 4, 4000 >> 4]


@pytest.mark.parametrize(
    ("time", "message"),
    [
        ("1403636579763555584", "times must be in seconds, got 1403636579763555584: .*nanoseconds"),
        ("1.4e12", "times must be in seconds, got 1.4e12: looks like milliseconds"),
        ("1e999999999", "times must be in seconds, got 1e999999999: .*nanoseconds"),
        ("inf", "time must be a number of seconds, got 'inf'"),
        ("nan", "time must be a number of seconds, got 'nan'"),
    ],
)
@pytest.mark.parametrize("name", ["times.txt", "rgb.txt"])
def test_times_that_are_no_seconds_are_refused(native, name, time, message):
    (native / name).write_text("".join(f"{time} images/{k:06d}.png\n" for k in range(6)))
    with pytest.raises(SourceError, match=f"{name}: {message}"):
        open_sequence(native)


def test_true_poses_at_times_that_are_no_seconds_are_refused(native):
    truth = Trajectory(1.4e18 + 5e7 * np.arange(6), poses(6))
    write_tum(native / "groundtruth.txt", truth)
    with pytest.raises(SourceError, match="groundtruth.txt: times must be in seconds, got 14.*nanoseconds"):
        open_sequence(native)


def test_whole_nanoseconds_beyond_64_bits_are_refused(tmp_path):
    write_images(tmp_path / "mav0/cam0/data", 2)
    (tmp_path / "mav0/cam0/data.csv").write_text(f"{10**18},000000.png\n{10**20},000001.png\n")
    with pytest.raises(SourceError, match=f"data.csv: times must be whole nanoseconds: .* got {10**20}"):
        open_sequence(tmp_path)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([0.0, 0.5, 1.0], [0, 128, 255]),
        ([0.0, 100.0, 255.0], [0, 100, 255]),
        ([-3.0, np.nan, 200.0], [0, 0, 200]),
        ([-np.inf, np.inf, 1.0], [0, 255, 255]),
        ([0.2, 1.0, 1.1], [51, 255, 255]),
        ([99.6, 255.0, 260.0], [100, 255, 255]),
    ],
)
def test_floats_count_to_1_or_to_255_as_their_values_tell(tmp_path, values, expected):
    cv2.imwrite(str(tmp_path / "a.tif"), np.array([values], dtype=np.float32))
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif")[0, :, 0], expected)


def test_whole_numbers_of_any_type_count_to_255(tmp_path):
    np.testing.assert_array_equal(as_rgb(np.array([[0, 1, 2]], dtype=np.int32))[0, :, 0], [0, 1, 2])
    np.testing.assert_array_equal(as_rgb(np.array([[-5, 90, 255]], dtype=np.int16))[0, :, 0], [0, 90, 255])


def test_floats_of_another_range_are_refused_by_the_name_of_their_file(tmp_path):
    cv2.imwrite(str(tmp_path / "a.tif"), np.array([[0.0, 4000.0]], dtype=np.float32))
    with pytest.raises(SourceError, match=r"a.tif: values must be in 0..1 or 0..255, got up to 4000"):
        read_image(tmp_path / "a.tif")


def test_undistortion_moves_points_to_where_the_pinhole_has_them(tmp_path):
    camera = Intrinsics(
        fx=300.0, fy=300.0, cx=159.5, cy=119.5, width=320, height=240, distortion=(-0.25, 0.08, 0.001, -0.002)
    )
    point_cam = np.array([[0.3, -0.2, 1.0]])
    distorted_xy = cv2.projectPoints(
        point_cam, np.zeros(3), np.zeros(3), camera.K, np.array(camera.distortion)
    )[0].reshape(2)
    image = np.zeros((240, 320), dtype=np.uint8)
    # Rendered with sub-pixel precision and blurred, so that its centre of mass is where it is.
    ys, xs = np.mgrid[0:240, 0:320]
    image[:] = 255 * np.exp(-((xs - distorted_xy[0]) ** 2 + (ys - distorted_xy[1]) ** 2) / 8.0)
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "0.png"), image)
    sequence = open_sequence(tmp_path, camera)
    assert sequence.intrinsics.distortion == ()
    assert sequence.distortion == camera.distortion
    weight = sequence.image(0)[:, :, 0].astype(float)
    centre_xy = [(weight * xs).sum() / weight.sum(), (weight * ys).sum() / weight.sum()]
    expected_xy = sequence.intrinsics.project(point_cam)[0]
    assert np.linalg.norm(expected_xy - distorted_xy) > 3
    np.testing.assert_allclose(centre_xy, expected_xy, atol=0.1)


def test_tum_layout_interpolates_truth_between_its_own_times(tmp_path):
    folder = tmp_path / "rgbd_dataset_freiburg3_desk"
    write_images(folder / "rgb", 3, "{:d}.png", size=(480, 640))
    (folder / "rgb.txt").write_text(
        "# timestamp filename\n"
        "1305031102.175304 rgb/0.png\n1305031102.211214 rgb/1.png\n1305031102.243211 rgb/2.png\n"
    )
    t_s = np.array([1305031102.165304, 1305031102.185304, 1305031102.201214, 1305031102.221214])
    truth = Trajectory(t_s, poses(4))
    write_tum(folder / "groundtruth.txt", truth)
    sequence = open_sequence(folder)
    assert sequence.intrinsics.fx == 535.4
    np.testing.assert_array_equal(
        sequence.times_ns, [1305031102175304000, 1305031102211214000, 1305031102243211000]
    )
    found = sequence.groundtruth()
    assert len(found) == 2, "the last frame has no pose on both sides"
    expected = make_transform(exp_so3([0.0, 0.05, 0.0]), (0.25, 0.0, 0.1))
    np.testing.assert_allclose(found.T_world_cam[0], expected, atol=1e-5)


def test_truth_is_not_stretched_over_gaps():
    truth = Trajectory(np.array([0.0, 0.1, 0.9, 1.0]), poses(4))
    times_ns = np.array([100_000_000, 140_000_000, 500_000_000, 860_000_000, 950_000_000])
    found = truth_at_frames(truth, times_ns, 0.1)
    np.testing.assert_allclose(found.t_s, [0.1, 0.95])
    assert truth_at_frames(truth, np.array([5_000_000_000]), 0.1) is None


def test_kitti_layout_moves_poses_to_the_camera_that_is_used(tmp_path):
    folder = tmp_path / "sequences" / "06"
    write_images(folder / "image_2", 3)
    (folder / "times.txt").write_text("0.000000e+00\n1.036224e-01\n2.072448e-01\n")
    baseline = 0.06
    (folder / "calib.txt").write_text(
        f"P0: 30 0 15.5 0 0 31 11.5 0 0 0 1 0\nP2: 30 0 15.5 {30 * baseline} 0 31 11.5 0 0 0 1 0\n"
    )
    (tmp_path / "poses").mkdir()
    lines = "\n".join(" ".join(f"{v:.9f}" for v in T[:3].ravel()) for T in poses(3))
    (tmp_path / "poses" / "06.txt").write_text(lines + "\n")
    sequence = open_sequence(folder)
    assert sequence.intrinsics == CAMERA
    assert sequence.times_ns[1] == 103622400
    found = sequence.groundtruth().T_world_cam
    # P2 shifts image points of camera 0 to the right, so camera 2 sits to the left by the baseline.
    for T_world_cam0, T_world_cam2 in zip(poses(3), found, strict=True):
        np.testing.assert_allclose(
            (invert_transform(T_world_cam0) @ T_world_cam2)[:3, 3], [-baseline, 0, 0], atol=1e-7
        )


def test_euroc_layout_gives_poses_of_the_camera_not_of_the_body(tmp_path):
    folder = tmp_path / "MH_01"
    cam = folder / "mav0" / "cam0"
    write_images(cam / "data", 2, "{:d}.png", channels=1)
    (cam / "data.csv").write_text(
        "#timestamp [ns],filename\n1403636579763555584,0.png\n1403636579813555456,1.png\n"
    )
    T_body_cam = make_transform(exp_so3([0.1, -0.2, 1.5]), (-0.02, -0.06, 0.01))
    numbers = ", ".join(f"{v:.12f}" for v in T_body_cam.ravel()[:8])
    rest = ", ".join(f"{v:.12f}" for v in T_body_cam.ravel()[8:])
    (cam / "sensor.yaml").write_text(
        "# General sensor definitions.\nsensor_type: camera\ncomment: VI-Sensor cam0 (MT9M034)\n\n"
        f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers},\n         {rest}]\n\n"
        "rate_hz: 20\nresolution: [32, 24]\ncamera_model: pinhole\n"
        "intrinsics: [30.0, 31.0, 15.5, 11.5] #fu, fv, cu, cv\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]\n"
    )
    truth = folder / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir()
    rows = []
    for t_ns, T in zip((1403636579763555584, 1403636579813555456), poses(2), strict=True):
        w, x, y, z = quat_wxyz_from_rotation(T[:3, :3])
        rows.append(",".join([str(t_ns), *(f"{v:.12f}" for v in (*T[:3, 3], w, x, y, z)), "0", "0"]))
    (truth / "data.csv").write_text("#timestamp, p, q\n" + "\n".join(rows) + "\n")
    sequence = open_sequence(folder)
    assert sequence.name == "MH_01"
    assert sequence.intrinsics == CAMERA, "the pinhole of the undistorted image"
    assert sequence.times_ns[0] == 1403636579763555584
    np.testing.assert_allclose(sequence.groundtruth().T_world_cam, poses(2) @ T_body_cam, atol=1e-9)


def test_blender_layout_sorts_by_number_and_looks_along_z(tmp_path):
    folder = tmp_path / "chair"
    write_images(folder / "test", 12, "r_{:d}.png")
    # An OpenGL camera at (0, 0, 4) that looks at the origin: its axes are the world's.
    T_world_gl = make_transform(np.eye(3), (0.0, 0.0, 4.0))
    frames = [{"file_path": f"./test/r_{k}", "transform_matrix": T_world_gl.tolist()} for k in range(12)]
    frames.sort(key=lambda f: f["file_path"])
    document = {"camera_angle_x": 2 * np.arctan(16 / 30), "frames": frames}
    (folder / "transforms_test.json").write_text(json.dumps(document))
    sequence = open_sequence(folder)
    assert [int(sequence.image(k)[0, 0, 0]) for k in (1, 2, 10)] == [10, 20, 100]
    assert sequence.intrinsics.fx == pytest.approx(30.0)
    assert (sequence.intrinsics.cx, sequence.intrinsics.cy) == (15.5, 11.5)
    T_world_cam = sequence.groundtruth().T_world_cam[0]
    np.testing.assert_allclose(invert_transform(T_world_cam) @ [0, 0, 0, 1], [0, 0, 4, 1], atol=1e-12)
    np.testing.assert_allclose(T_world_cam[:3, 1], [0, -1, 0], atol=1e-12)  # y down


def test_a_transforms_file_with_pinhole_numbers_counts_from_pixel_corners(tmp_path):
    write_images(tmp_path / "images", 2)
    frames = [{"file_path": f"images/{k:06d}.png", "transform_matrix": np.eye(4).tolist()} for k in range(2)]
    document = {"fl_x": 30, "fl_y": 31, "cx": 16, "cy": 12, "w": 32, "h": 24, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    assert open_sequence(tmp_path).intrinsics == CAMERA
    assert open_sequence(tmp_path / "transforms.json").intrinsics == CAMERA


def transforms_folder(folder, **document):
    write_images(folder / "images", 1)
    frames = [{"file_path": "images/000000.png", "transform_matrix": np.eye(4).tolist()}]
    known = {"fl_x": 30, "fl_y": 31, "cx": 16, "cy": 12, "w": 32, "h": 24, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps({**known, **document}))
    return folder


@pytest.mark.parametrize("model", ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", None])
def test_a_transforms_file_of_a_pinhole_model_is_read(tmp_path, model):
    folder = transforms_folder(tmp_path, camera_model=model, k1=0.1, k4=0.0, is_fisheye=False)
    assert open_sequence(folder).distortion == (0.1, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("document", "message"),
    [
        (
            {"camera_model": "OPENCV_FISHEYE", "k1": 0.1},
            "camera_model must be one of OPENCV, .*'OPENCV_FISHEYE'",
        ),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model must be one of OPENCV, .*'EQUIRECTANGULAR'"),
        ({"camera_model": "OPENCV", "k4": 0.01}, "k4 must be absent or 0 for a pinhole camera, got 0.01"),
        ({"is_fisheye": True}, "is_fisheye must be absent or 0 for a pinhole camera, got True"),
    ],
)
def test_a_transforms_file_of_another_model_is_refused(tmp_path, document, message):
    with pytest.raises(SourceError, match=f"transforms.json holds no usable intrinsics: {message}"):
        open_sequence(transforms_folder(tmp_path, **document))


def test_times_beside_the_images_of_a_folder_are_read(tmp_path):
    write_images(tmp_path, 3, "img{:d}.png")
    (tmp_path / "times.txt").write_text("0.5\n0.75\n2\n")
    np.testing.assert_array_equal(open_sequence(tmp_path).times_ns, [500_000_000, 750_000_000, 2_000_000_000])


def test_names_with_signs_that_are_no_digits_of_a_number_are_sorted(tmp_path):
    names = ["a10.png", "a2.png", "a²3.png", "²1.png", "٣.png"]
    assert sorted(names, key=natural_key) == ["a2.png", "a10.png", "a²3.png", "²1.png", "٣.png"]
    for name in names:
        cv2.imwrite(str(tmp_path / name), np.zeros((24, 32, 3), np.uint8))
    assert len(open_sequence(tmp_path)) == 5


@pytest.mark.parametrize("layout", ["auto", "native"])
def test_a_video_is_sent_to_where_videos_go(tmp_path, layout):
    (tmp_path / "normal.mp4").write_bytes(b"video")
    with pytest.raises(
        SourceError, match="got the file .*normal.mp4: videos go through 'semcast agent --source"
    ):
        open_sequence(tmp_path / "normal.mp4", layout=layout)


def test_a_folder_of_images_needs_a_camera_only_when_it_is_asked_for_one(tmp_path):
    write_images(tmp_path, 3, "img{:d}.jpg")
    sequence = open_sequence(tmp_path, rate_hz=5.0)
    assert sequence.image(2).shape == (24, 32, 3)
    np.testing.assert_array_equal(sequence.times_ns, [0, 200_000_000, 400_000_000])
    with pytest.raises(SourceError, match=r"camera of .* is unknown: put intrinsics.json"):
        _ = sequence.intrinsics
    given = CameraSettings(fx=30.0, fy=31.0, cx=15.5, cy=11.5)
    assert open_sequence(tmp_path, given).intrinsics == CAMERA


@pytest.mark.parametrize(
    "text",
    [
        # OpenCV's cv2.FileStorage
        "%YAML:1.0\n---\nimage_width: 32\nimage_height: 24\ncamera_matrix: !!opencv-matrix\n   rows: 3\n"
        "   cols: 3\n   dt: d\n   data: [ 30., 0., 15.5, 0., 31.,\n       11.5, 0., 0., 1. ]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n"
        "   data: [ 0.1, -0.2, 0.001, 0.002, 0.3 ]\n",
        # ORB-SLAM
        "%YAML:1.0\nCamera.fx: 30.0\nCamera.fy: 31.0\nCamera.cx: 15.5\nCamera.cy: 11.5\nCamera.k1: 0.1\n"
        "Camera.k2: -0.2\nCamera.p1: 0.001\nCamera.p2: 0.002\nCamera.k3: 0.3\nCamera.width: 32\n"
        "Camera.height: 24\n",
        # ROS camera_info
        "image_width: 32\nimage_height: 24\ncamera_name: c\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        "  data: [30, 0, 15.5, 0, 31, 11.5, 0, 0, 1]\ndistortion_model: plumb_bob\n"
        "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0.1, -0.2, 0.001, 0.002, 0.3]\n",
    ],
    ids=["opencv", "orbslam", "ros"],
)
def test_calibration_yaml_of_other_tools_is_read(tmp_path, text):
    (tmp_path / "camera.yaml").write_text(text)
    found = CameraSettings(intrinsics=tmp_path / "camera.yaml").resolve(32, 24)
    assert found.undistorted() == CAMERA
    assert found.distortion == (0.1, -0.2, 0.001, 0.002, 0.3)


def test_a_fisheye_calibration_is_refused(tmp_path):
    (tmp_path / "camera.yaml").write_text(
        "resolution: [32, 24]\nintrinsics: [30, 31, 15.5, 11.5]\ndistortion_model: equidistant\n"
        "distortion_coefficients: [0.1, 0.2, 0.3, 0.4]\n"
    )
    with pytest.raises(
        SourceError, match="distortion_model must be a pinhole camera's .*, got 'equidistant'"
    ):
        CameraSettings(intrinsics=tmp_path / "camera.yaml").resolve(32, 24)


def test_camera_settings_must_be_complete_and_unambiguous(tmp_path):
    with pytest.raises(ValueError, match="fx, fy, cx and cy must be given together, got only fx, cy"):
        CameraSettings(fx=1.0, cy=2.0)
    with pytest.raises(ValueError, match="either intrinsics or"):
        CameraSettings(fx=1.0, fy=1.0, cx=1.0, cy=1.0, intrinsics=tmp_path)


def damage_missing(folder):
    return folder / "nowhere"


def damage_empty(folder):
    (folder / "empty").mkdir()
    return folder / "empty"


def damage_size(folder):
    Intrinsics(fx=30.0, fy=31.0, cx=1.0, cy=1.0, width=64, height=48).save(folder / "intrinsics.json")
    return folder


def damage_all_images(folder):
    for path in (folder / "images").iterdir():
        path.write_bytes(b"not an image")
    return folder


def damage_times(folder):
    (folder / "times.txt").write_text("0\n1\n")
    return folder


def damage_order(folder):
    (folder / "times.txt").write_text("0\n1\n1\n2\n3\n")
    return folder


def damage_number(folder):
    (folder / "times.txt").write_text("0\none\n2\n3\n4\n")
    return folder


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (damage_missing, "there is no such folder"),
        (damage_empty, "expected images/ .native."),
        (damage_size, "intrinsics of walk are for 64x48 images, its images are 32x24"),
        (damage_all_images, "000000.png is not a readable image"),
        (damage_times, "one time per image, got 2 times and 5 images"),
        (damage_order, "must strictly increase"),
        (damage_number, "time must be a number of seconds, got 'one'"),
    ],
)
def test_what_is_wrong_with_a_recording_is_said(native, damage, message):
    with pytest.raises(SourceError, match=message):
        open_sequence(damage(native))


def test_a_damaged_first_image_is_an_error_of_that_frame_alone(native):
    (native / "images" / "000000.png").write_bytes(b"")
    sequence = open_sequence(native)
    assert (len(sequence), sequence.size_wh) == (5, (32, 24))
    with pytest.raises(SourceError, match="000000.png is not a readable image"):
        sequence.image(0)
    assert sequence.image(1).shape == (24, 32, 3)


def test_images_that_would_be_refused_are_found_beforehand(native):
    (native / "images" / "000001.png").write_bytes(b"broken")
    write_images(native / "other", 1, size=(10, 12))
    (native / "other" / "000000.png").rename(native / "images" / "000003.png")
    messages, num_skipped = open_sequence(native).refused_images()
    assert "000001.png is not a readable image" in messages[0]
    assert "000003.png is 12x10, the first readable image" in messages[1]
    assert (len(messages), num_skipped) == (2, 0)
    messages, num_skipped = open_sequence(native).refused_images(most_decoded=0)
    assert (len(messages), num_skipped) == (1, 1), "only the damaged one must be decoded"


def test_a_damaged_image_in_the_middle_is_an_error_of_that_frame_alone(native):
    (native / "images" / "000002.png").write_bytes(b"")
    write_images(native / "other", 1, size=(10, 10))
    (native / "other" / "000000.png").rename(native / "images" / "000003.png")
    sequence = open_sequence(native)
    with pytest.raises(SourceError, match="000002.png is not a readable image"):
        sequence.image(2)
    with pytest.raises(
        SourceError, match="000003.png is 10x10, the first readable image of the sequence is 32x24"
    ):
        sequence.image(3)
    assert sequence.image(4).shape == (24, 32, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"resize": 0.0}, r"resize must be in \[0.05, 1\], got 0"),
        ({"stride": 0}, "stride must be at least 1, got 0"),
        ({"max_frames": 0}, "max_frames must be at least 1, got 0"),
        ({"rate_hz": 0.0}, "rate_hz must be positive, got 0"),
    ],
)
def test_arguments_out_of_range_are_refused(native, arguments, message):
    with pytest.raises(ValueError, match=message):
        open_sequence(native, **arguments)


def test_a_phone_s_focal_length_gives_a_rough_camera():
    # 26 mm on the 43.27 mm diagonal of film; 3 4 5 makes the image's diagonal 1000 px.
    camera = CameraSettings(focal_35mm=26.0).resolve(800, 600)
    assert camera.fx == camera.fy == pytest.approx(26.0 / 43.27 * 1000.0)
    assert (camera.cx, camera.cy) == (399.5, 299.5)
    with pytest.raises(ValueError, match="focal_35mm must be given alone"):
        CameraSettings(focal_35mm=26.0, fx=1.0, fy=1.0, cx=1.0, cy=1.0)
    with pytest.raises(ValueError, match=r"focal_35mm must be in \[5, 1000\], got 0.02"):
        CameraSettings(focal_35mm=0.02)
