"""Calibration files as other tools write them; see test_camera_settings.py for their plainest forms."""

import cv2
import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.camera_file import read_flat_yaml, read_intrinsics, transform_from_yaml
from semcast.common.errors import SourceError

CAMERA = Intrinsics(fx=30.0, fy=31.0, cx=15.5, cy=11.5, width=32, height=24)
COEFFICIENTS = (0.1, -0.2, 0.001, 0.002, 0.3)
ROS_HEAD = "image_width: 32\nimage_height: 24\ncamera_name: c\ndistortion_model: plumb_bob\n"
ROS_MATRIX = "camera_matrix:\n  rows: 3\n  cols: 3\n  data: [30, 0, 15.5, 0, 31, 11.5, 0, 0, 1]\n"
EUROC = "resolution: [32, 24]\nintrinsics: [30.0, 31.0, 15.5, 11.5]\n"


def block(numbers, indent):
    return "".join(f"{' ' * indent}- {number}\n" for number in numbers)


def read(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "camera.yaml"
    path.write_text(text, encoding=encoding)
    return read_intrinsics(path)


@pytest.mark.parametrize(
    "text",
    [
        f"{ROS_HEAD}{ROS_MATRIX}distortion_coefficients:\n  rows: 1\n  cols: 5\n  data:\n"
        f"{block(COEFFICIENTS, 4)}projection_matrix:\n  rows: 3\n",
        f"{ROS_HEAD}camera_matrix:\n  cols: 3\n  data:\n{block([30, 0, 15.5, 0, 31, 11.5, 0, 0, 1], 2)}"
        f"  rows: 3\ndistortion_coefficients:\n  cols: 5\n  data:\n{block(COEFFICIENTS, 2)}  rows: 1\n",
        f"{ROS_HEAD}camera_matrix:\n- - 30.0\n  - 0.0\n  - 15.5\n- - 0.0\n  - 31.0\n  - 11.5\n"
        f"- [0, 0,\n   1]\ndistortion_coefficients:\n- {list(COEFFICIENTS)}\n",
        "height: 24\nwidth: 32\ndistortion_model: plumb_bob\nD: [0.1, -0.2, 0.001, 0.002, 0.3]\n"
        "K: [30.0, 0.0, 15.5, 0.0, 31.0, 11.5, 0.0, 0.0, 1.0]\n",
        "height: 24\nwidth: 32\ndistortion_model: plumb_bob\n"
        f"d:\n{block(COEFFICIENTS, 0)}k:\n{block([30.0, 0.0, 15.5, 0.0, 31.0, 11.5, 0.0, 0.0, 1.0], 0)}",
        f"{EUROC}camera_model: pinhole\ndistortion_model: radtan\ndistortion_coeffs: {list(COEFFICIENTS)}\n",
        "cam0:\n  T_cam_imu:\n  - [1, 0, 0, 0]\n  - [0, 1, 0, 0]\n  camera_model: pinhole\n"
        f"  distortion_coeffs: {list(COEFFICIENTS)}\n  distortion_model: radtan\n"
        "  intrinsics: [30, 31, 15.5, 11.5]\n  resolution: [32, 24]\n"
        "cam1:\n  distortion_coeffs: [9, 9, 9, 9]\n  intrinsics: [9, 9, 9, 9]\n",
        f"{EUROC}distortion:\n  k1: 0.1\n  k2: -0.2\n  p1: 0.001\n  p2: 0.002\n  k3: 0.3\n",
    ],
    ids=[
        "ros data in a block",
        "ros all in blocks",
        "lists of lists",
        "ros message",
        "ros 2 message",
        "euroc",
        "kalibr",
        "named",
    ],
)
def test_lists_are_read_however_they_are_written(tmp_path, text):
    found = read(tmp_path, text)
    assert found.undistorted() == CAMERA
    assert found.distortion == COEFFICIENTS


def test_a_byte_order_mark_is_no_part_of_the_first_key(tmp_path):
    text = f"{ROS_HEAD}{ROS_MATRIX}distortion_coefficients: []\n"
    assert read(tmp_path, text, encoding="utf-8-sig") == CAMERA


def test_what_opencv_writes_of_a_rational_model_is_read(tmp_path):
    coefficients = np.array([[0.1, -0.2, 0.001, 0.002, 0.3, 0.4, 0.5, 0.6, *[0.0] * 6]])
    storage = cv2.FileStorage(str(tmp_path / "camera.yaml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 32)
    storage.write("image_height", 24)
    storage.write("fisheye_model", 0)
    storage.write("camera_matrix", CAMERA.K)
    storage.write("distortion_coefficients", coefficients)
    storage.release()
    found = read_intrinsics(tmp_path / "camera.yaml")
    assert found.undistorted() == CAMERA
    assert found.distortion == tuple(coefficients[0, :8])


@pytest.mark.parametrize(
    "text",
    [
        f"{EUROC}camera_model: pinhole\ndistortion_model: equidistant\n"
        "distortion_coeffs: [0.1, -0.2, 0.3, 0.4]\n",
        'Camera.type: "KannalaBrandt8"\nCamera1.fx: 30\nCamera1.fy: 31\nCamera1.cx: 15.5\nCamera1.cy: 11.5\n'
        "Camera1.k1: 0.1\nCamera1.k2: -0.2\nCamera1.k3: 0.3\nCamera1.k4: 0.4\n"
        "Camera.width: 32\nCamera.height: 24\n",
    ],
    ids=["kalibr", "orbslam3"],
)
def test_a_fisheye_is_read_as_one(tmp_path, text):
    found = read(tmp_path, text)
    assert found.undistorted() == CAMERA
    assert (found.distortion_model, found.distortion) == ("equidistant", (0.1, -0.2, 0.3, 0.4))


@pytest.mark.parametrize("word", ["false", "no", "0", "off"])
def test_a_camera_said_to_be_no_fisheye_is_none(tmp_path, word):
    assert read(tmp_path, f"{EUROC}is_fisheye: {word}\n") == CAMERA


def test_orbslam_without_tangential_distortion_is_read(tmp_path):
    text = (
        "Camera.type: PinHole\nCamera.fx: 30\nCamera.fy: 31\nCamera.cx: 15.5\nCamera.cy: 11.5\n"
        "Camera.k1: 0.1\nCamera.k2: -0.2\nCamera.width: 32\nCamera.height: 24\n"
    )
    assert read(tmp_path, text).distortion == (0.1, -0.2, 0.0, 0.0)
    with pytest.raises(SourceError, match="k4 must be 0 or come with k5 and k6, got 0.4"):
        read(tmp_path, f"{text}Camera.k4: 0.4\n")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{EUROC}distortion_coeffs:\n", "distortion_coeffs must be a list of numbers.*, got ''"),
        (
            f"{EUROC}distortion_coeffs: [0.1, x, 0, 0]\n",
            r"distortion_coeffs must be .*, got '\[0.1, x, 0, 0\]'",
        ),
        (f"{EUROC}distortion_coeffs: [0.1, 0.2\n", r"distortion_coeffs must be .*, got '\[0.1, 0.2'"),
        (f"{EUROC}distortion_coeffs:\n- k1: 0.1\n", "distortion_coeffs must be .*, got '- k1: 0.1'"),
        (
            f"{EUROC}distortion_parameters:\n  k1: 0.1\n",
            "distortion_parameters must be .* distCoeffs, dist, D, d, coeffs, got",
        ),
        (f"{EUROC}D: 0.1\n", "D must be a list of numbers.*, got 0.1"),
        (
            f"{ROS_HEAD}camera_matrix:\n  data:\n  - 1\n",
            r"camera_matrix must be a list of 9 numbers, got \[1.0\]",
        ),
        (
            f"{ROS_HEAD}camera_matrix: {{data: [1]}}\n",
            "camera_matrix must be a list of 9 numbers, got '{data",
        ),
        (ROS_HEAD, "'camera_matrix or K' is missing"),
        ("resolution: [32, 24]\nintrinsics: [1, 2, 3, 4, 5]\n", "intrinsics must be a list of 4 numbers"),
        (f"{EUROC}fisheye: perhaps\n", "fisheye must be true or false, got 'perhaps'"),
        (f"{EUROC}camera_model: omni\n", "camera_model must be a pinhole camera's .*, got 'omni'"),
        (
            f"{ROS_HEAD}{ROS_MATRIX}fisheye_model: 1\n",
            "distortion_model and fisheye_model must say the same, got radtan, equidistant",
        ),
        (f"{EUROC}k1: 0.1\nD: [0.2, 0, 0, 0]\n", "k1 and D must say the same"),
        (
            f"{EUROC}distortion:\n  model: equirectangular\n  k1: 0.1\n",
            "model must be a pinhole camera's .*, got 'equirectangular'",
        ),
    ],
)
def test_what_can_not_be_used_is_said_and_never_left_out(tmp_path, text, message):
    with pytest.raises(SourceError, match=f"camera.yaml holds no usable intrinsics: {message}"):
        read(tmp_path, text)


def test_a_word_that_only_starts_like_distortion_does_not_matter(tmp_path):
    assert read(tmp_path, f"{EUROC}distance_to_board: 2.0\n") == CAMERA


def test_a_transform_may_be_written_in_rows(tmp_path):
    path = tmp_path / "sensor.yaml"
    path.write_text("T_BS:\n  - [1, 0, 0, 5]\n  - [0, 1, 0, 6]\n  - [0, 0, 1, 7]\n  - [0, 0, 0, 1]\nT_SC:\n")
    values = read_flat_yaml(path)
    np.testing.assert_array_equal(transform_from_yaml(values, "T_BS")[:3, 3], [5, 6, 7])
    assert transform_from_yaml(values, "T_SC") is None
    assert transform_from_yaml(values, "T_XY") is None
