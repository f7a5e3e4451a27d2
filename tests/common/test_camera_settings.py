from dataclasses import replace

import pytest

from semcast.common.camera import Intrinsics
from semcast.common.camera_settings import CameraSettings, check_size
from semcast.common.errors import SourceError

CAMERA = Intrinsics(fx=30.0, fy=31.0, cx=15.5, cy=11.5, width=32, height=24)


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


def test_a_panorama_is_refused(tmp_path):
    (tmp_path / "camera.yaml").write_text(
        "resolution: [32, 24]\nintrinsics: [30, 31, 15.5, 11.5]\ndistortion_model: spherical\n"
        "distortion_coefficients: [0.1, 0.2, 0.3, 0.4]\n"
    )
    with pytest.raises(SourceError, match="distortion_model must be a pinhole camera's .*, got 'spherical'"):
        CameraSettings(intrinsics=tmp_path / "camera.yaml").resolve(32, 24)


def test_camera_settings_must_be_complete_and_unambiguous(tmp_path):
    with pytest.raises(ValueError, match="fx, fy, cx and cy must be given together, got only fx, cy"):
        CameraSettings(fx=1.0, cy=2.0)
    with pytest.raises(ValueError, match="either intrinsics or"):
        CameraSettings(fx=1.0, fy=1.0, cx=1.0, cy=1.0, intrinsics=tmp_path)


def test_a_fisheye_is_given_by_its_numbers():
    pinhole = {"fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5}
    lens = {"distortion": (0.1, 0.2, 0.3, 0.4), "distortion_model": "equidistant"}
    camera = CameraSettings(**pinhole, **lens).resolve(32, 24)
    assert (camera.distortion, camera.distortion_model) == tuple(lens.values())
    with pytest.raises(
        SourceError, match=r"give --fx 60 .*--distortion 0.1 0.2 0.3 0.4 --distortion-model equid"
    ):
        check_size(camera, 64, 48, "walk")
    with pytest.raises(ValueError, match="distortion_model must come with fx, fy, cx and cy"):
        CameraSettings(distortion_model="equidistant")
    with pytest.raises(SourceError, match=r"must be 4 finite values \(k1 to k4 of a fisheye\), got \(\)"):
        CameraSettings(**pinhole, distortion_model="equidistant").resolve(32, 24)


def test_a_phone_s_focal_length_gives_a_rough_camera():
    # 26 mm on the 43.27 mm diagonal of film; 3 4 5 makes the image's diagonal 1000 px.
    camera = CameraSettings(focal_35mm=26.0).resolve(800, 600)
    assert camera.fx == camera.fy == pytest.approx(26.0 / 43.27 * 1000.0)
    assert (camera.cx, camera.cy) == (399.5, 299.5)
    with pytest.raises(ValueError, match="focal_35mm must be given alone"):
        CameraSettings(focal_35mm=26.0, fx=1.0, fy=1.0, cx=1.0, cy=1.0)
    with pytest.raises(ValueError, match=r"focal_35mm must be in \[5, 1000\], got 0.02"):
        CameraSettings(focal_35mm=0.02)


def test_intrinsics_of_another_size_are_refused_with_what_to_do():
    check_size(CAMERA, 32, 24, "walk")
    bent = replace(CAMERA, distortion=(0.1, -0.2, 0.0, 0.0))
    with pytest.raises(SourceError, match="its images are 64x48") as told:
        check_size(bent, 64, 48, "walk")
    words = str(told.value).split(" give ")[1].split()
    flags = dict(zip(words[0:8:2], map(float, words[1:8:2]), strict=True))
    assert flags == {"--fx": 60.0, "--fy": 62.0, "--cx": 31.5, "--cy": 23.5}
    assert words[8:] == ["--distortion", "0.1", "-0.2", "0", "0"]
    with pytest.raises(SourceError, match="its images are 64x48: .* --cy 23.5$"):
        check_size(CAMERA, 64, 48, "walk")
    with pytest.raises(SourceError, match="turned by 90 degrees"):
        check_size(CAMERA, 24, 32, "walk")
    with pytest.raises(SourceError, match="neither cut nor stretched: 'semcast calibrate'"):
        check_size(CAMERA, 32, 18, "walk")
