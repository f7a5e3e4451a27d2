import json
from pathlib import Path

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError
from semcast.common.geometry import exp_so3, invert_transform, make_transform, quat_wxyz_from_rotation
from semcast.common.layouts.kitti import kitti_pose_places
from semcast.common.layouts.layout import read_layout
from semcast.common.sequence import open_sequence, truth_at_frames
from semcast.common.trajectory import Trajectory, write_tum

CAMERA = Intrinsics(fx=30.0, fy=31.0, cx=15.5, cy=11.5, width=32, height=24)


def test_whole_nanoseconds_beyond_64_bits_are_refused(tmp_path, write_images):
    write_images(tmp_path / "mav0/cam0/data", 2)
    (tmp_path / "mav0/cam0/data.csv").write_text(f"{10**18},000000.png\n{10**20},000001.png\n")
    with pytest.raises(SourceError, match=f"data.csv:2: time must be within .* ns, got {10**20}"):
        open_sequence(tmp_path)


def test_tum_layout_interpolates_truth_between_its_own_times(tmp_path, write_images, poses):
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


def test_names_of_images_in_a_list_may_hold_blanks_and_commas(tmp_path, write_images):
    names = ["my photo 1.png", "b, c.PNG", "three.png"]
    for name in names:
        write_images(tmp_path / "my rgb", 1, name)
    (tmp_path / "rgb.txt").write_text(
        f"0.5 my rgb/{names[0]}\n1.5\tmy rgb/{names[1]} 1.5 depth/1.png\n2.5,my rgb/{names[2]}  # the last\n"
    )
    assert [path.name for path in read_layout(tmp_path, "auto", 10.0).image_paths] == names
    assert open_sequence(tmp_path).refused_images()[0] == []


def test_truth_is_not_stretched_over_gaps(poses):
    truth = Trajectory(np.array([0.0, 0.1, 0.9, 1.0]), poses(4))
    times_ns = np.array([100_000_000, 140_000_000, 500_000_000, 860_000_000, 950_000_000])
    found = truth_at_frames(truth, times_ns, 0.1)
    np.testing.assert_allclose(found.t_s, [0.1, 0.95])
    assert truth_at_frames(truth, np.array([5_000_000_000]), 0.1) is None


def test_kitti_layout_moves_poses_to_the_camera_that_is_used(tmp_path, write_images, poses):
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


@pytest.mark.parametrize(
    ("times", "pose", "message"),
    [
        ("0\n2\n1\n", "1 0 0 0 0 1 0 0 0 0 1 0", "must strictly increase, image 3 has 1 s after 2 s"),
        ("0\n1\n", "1 0 0 0 0 1 0 0 0 0 1 0", "one time per image, got 2 times and 3 images"),
        (
            "0\n0,5 # half\n1\n",
            "1 0 0 0 0 1 0 0 0 0 1 0",
            "times.txt:2: time must have a decimal point, got '0,5'",
        ),
        ("0\n1\n2\n", "nan 0 0 0 0 1 0 0 0 0 1 0", "poses.txt:1: must be 12 finite numbers, got nan 0"),
    ],
)
def test_what_is_wrong_with_a_kitti_recording_is_said(tmp_path, write_images, times, pose, message):
    write_images(tmp_path / "image_0", 3)
    (tmp_path / "times.txt").write_text(times)
    (tmp_path / "poses.txt").write_text(3 * f"{pose}\n")
    with pytest.raises(SourceError, match=message):
        open_sequence(tmp_path)


@pytest.mark.parametrize(
    ("projection", "message"),
    [
        ("0 0 15.5 0 0 31 11.5 0 0 0 1 0", "P0 must have positive focal lengths, got 0 0 15.5"),
        ("-30 0 15.5 0 0 31 11.5 0 0 0 1 0", "P0 must have positive focal lengths, got -30 0"),
        ("inf 0 15.5 0 0 31 11.5 0 0 0 1 0", "P0 must be 12 finite numbers, got inf 0"),
        ("30 0 15.5", "P0 must be 12 finite numbers, got 30 0 15.5"),
    ],
)
def test_a_damaged_kitti_calibration_is_said(tmp_path, write_images, projection, message):
    write_images(tmp_path / "image_0", 1)
    (tmp_path / "calib.txt").write_text(f"P0: {projection}\n")
    with pytest.raises(SourceError, match=f"calib.txt: {message}"):
        open_sequence(tmp_path)


@pytest.mark.parametrize(("pattern", "first"), [("{:06d}.png", 0), ("{:06d}.png", 4), ("night_{}.png", 0)])
def test_images_cut_out_of_a_kitti_recording_keep_their_poses(tmp_path, write_images, poses, pattern, first):
    write_images(tmp_path / "image_0", 8, pattern)
    for path in sorted((tmp_path / "image_0").iterdir())[:first]:
        path.unlink()
    for path in sorted((tmp_path / "image_0").iterdir())[3:]:
        path.unlink()
    lines = (" ".join(f"{v:.9f}" for v in T[:3].ravel()) for T in poses(8))
    (tmp_path / "poses.txt").write_text("\n".join(lines) + "\n")
    found = open_sequence(tmp_path).groundtruth().T_world_cam
    np.testing.assert_allclose(found, poses(8)[first : first + 3], atol=1e-7)


@pytest.fixture
def cut_kitti(tmp_path, write_images, poses):
    """Return a function that writes a recording of eight frames, of which some images are left."""

    def write(pattern, kept, num_poses):
        write_images(tmp_path / "image_0", 8, pattern)
        for k in set(range(8)) - set(kept):
            (tmp_path / "image_0" / pattern.format(k)).unlink()
        (tmp_path / "times.txt").write_text("".join(f"{0.1 * k * k}\n" for k in range(8)))
        chosen = poses(8) if num_poses != len(kept) else poses(8)[list(kept)]
        lines = (" ".join(f"{v:.9f}" for v in T[:3].ravel()) for T in chosen[:num_poses])
        (tmp_path / "poses.txt").write_text("\n".join(lines) + "\n")
        return tmp_path

    return write


@pytest.mark.parametrize("kept", [(0, 1, 2), (3, 4, 6)])
@pytest.mark.parametrize("num_poses", [8, 3])
def test_the_numbers_of_kitti_images_tell_their_times(cut_kitti, poses, kept, num_poses, caplog):
    caplog.set_level("INFO", "semcast")
    sequence = open_sequence(cut_kitti("{:06d}.png", kept, num_poses))
    np.testing.assert_allclose(sequence.times_ns, [1e8 * k * k for k in kept])
    np.testing.assert_allclose(sequence.groundtruth().T_world_cam, poses(8)[list(kept)], atol=1e-7)
    assert "has 3 of 8 images: times and poses are those of their numbers" in caplog.text


@pytest.mark.parametrize(
    ("pattern", "num_poses", "message"),
    [
        ("night_{}.png", 8, "one time per image, got 8 times and 3 images"),
        ("1{:05d}.png", 8, "one time per image, got 8 times and 3 images"),
        ("{:06d}.png", 5, "poses.txt has 5 poses: none for image 000006.png"),
    ],
)
def test_a_cut_kitti_recording_whose_numbers_don_t_tell_is_refused(cut_kitti, pattern, num_poses, message):
    with pytest.raises(SourceError, match=message):
        open_sequence(cut_kitti(pattern, (3, 4, 6), num_poses))


def test_a_kitti_folder_may_stand_at_the_root_of_a_file_system(tmp_path):
    root = Path(tmp_path.anchor)
    assert kitti_pose_places(root / "kitti")[-1] == root / "poses" / "kitti.txt"
    assert kitti_pose_places(root / "data" / "sequences" / "06")[-1] == root / "data" / "poses" / "06.txt"


def test_euroc_layout_gives_poses_of_the_camera_not_of_the_body(tmp_path, write_images, poses):
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
    (truth / "data.csv").write_text(f"{'9' * 400},0,0,0,1,0,0,0\n")
    with pytest.raises(SourceError, match="data.csv:1: time must be within 9000000000000000000 ns"):
        open_sequence(folder)


@pytest.mark.parametrize(
    "header", ["#timestamp [ns],filename\n", "timestamp [ns],filename\n", "Time,File\n", ""]
)
def test_the_line_that_names_the_columns_of_a_euroc_list_need_not_be_a_comment(
    tmp_path, write_images, header
):
    cam = tmp_path / "mav0" / "cam0"
    write_images(cam / "data", 2, "{:d}.png")
    (cam / "data.csv").write_text(f"{header}1403636579763555584,0.png\n1403636579813555456,1.png\n")
    times_ns = [1403636579763555584, 1403636579813555456]
    np.testing.assert_array_equal(open_sequence(tmp_path).times_ns, times_ns)
    (cam / "data.csv").write_text(f"{header}1403636579763555584,0.png\ntimestamp,1.png\n")
    with pytest.raises(SourceError, match="time must be whole nanoseconds, got 'timestamp'"):
        open_sequence(tmp_path)


def test_a_list_of_images_that_a_power_cut_filled_with_zeros_is_told(tmp_path, write_images):
    folder = tmp_path / "desk"
    write_images(folder / "rgb", 2, "{:d}.png")
    (folder / "rgb.txt").write_text("0.5 rgb/0.png\n1.5 rgb/1.png\n2.5 rgb/\0\0\0\n")
    sequence = open_sequence(folder)
    messages, _ = sequence.refused_images()
    assert len(messages) == 1
    assert "can't be read: embedded null byte" in messages[0]
    with pytest.raises(SourceError, match="can't be read: embedded null byte"):
        sequence.image(2)


def test_blender_layout_sorts_by_number_and_looks_along_z(tmp_path, write_images):
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


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_a_transforms_file_with_pinhole_numbers_counts_from_pixel_corners(tmp_path, write_images, encoding):
    write_images(tmp_path / "images", 2)
    frames = [{"file_path": f"images/{k:06d}.png", "transform_matrix": np.eye(4).tolist()} for k in range(2)]
    document = {"fl_x": 30, "fl_y": 31, "cx": 16, "cy": 12, "w": 32, "h": 24, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(document), encoding)
    assert open_sequence(tmp_path).intrinsics == CAMERA
    assert open_sequence(tmp_path / "transforms.json").intrinsics == CAMERA


def test_a_transforms_file_may_leave_out_the_last_row_of_its_matrices(tmp_path, write_images, poses):
    write_images(tmp_path / "images", 5)
    found = []
    for rows in (4, 3):
        frames = [
            {"file_path": f"images/{k:06d}.png", "transform_matrix": T[:rows].tolist()}
            for k, T in enumerate(poses(5))
        ]
        (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))
        found.append(open_sequence(tmp_path).groundtruth().T_world_cam)
    np.testing.assert_array_equal(found[1], found[0])
    assert found[0].shape == (5, 4, 4)


def test_a_transforms_file_without_frames_has_no_images(tmp_path):
    (tmp_path / "transforms.json").write_text('{"camera_angle_x": 0.8, "frames": []}')
    with pytest.raises(SourceError, match="no images in"):
        open_sequence(tmp_path)


@pytest.mark.parametrize(
    ("focal_px", "message"),
    [((30.0, 30.1), None), ((30.0, 45.0), "fl_x must be the same for all images .*, got 30 to 45")],
)
def test_a_transforms_file_of_several_cameras_is_refused(tmp_path, write_images, focal_px, message):
    write_images(tmp_path / "images", 2)
    frames = [
        {"file_path": f"images/{k:06d}.png", "transform_matrix": np.eye(4).tolist(), "fl_x": focal}
        for k, focal in enumerate(focal_px)
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"w": 32, "h": 24, "frames": frames}))
    if message is None:
        assert open_sequence(tmp_path).intrinsics.fx == 30.0
        return
    with pytest.raises(SourceError, match=message):
        open_sequence(tmp_path)


@pytest.fixture
def transforms_folder(tmp_path, write_images):
    """Return a function that writes a recording of one image with more keys in its transforms.json."""

    def write(**document):
        write_images(tmp_path / "images", 1)
        frames = [{"file_path": "images/000000.png", "transform_matrix": np.eye(4).tolist()}]
        known = {"fl_x": 30, "fl_y": 31, "cx": 16, "cy": 12, "w": 32, "h": 24, "frames": frames}
        (tmp_path / "transforms.json").write_text(json.dumps({**known, **document}))
        return tmp_path

    return write


@pytest.mark.parametrize("model", ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", None])
def test_a_transforms_file_of_a_pinhole_model_is_read(transforms_folder, model):
    folder = transforms_folder(camera_model=model, k1=0.1, k4=0.0, is_fisheye=False)
    assert open_sequence(folder).stored_camera.distortion == (0.1, 0.0, 0.0, 0.0)


def test_a_transforms_file_of_a_fisheye_is_read(transforms_folder):
    stored = open_sequence(transforms_folder(camera_model="OPENCV_FISHEYE", k1=0.1, k4=0.2)).stored_camera
    assert (stored.distortion_model, stored.distortion) == ("equidistant", (0.1, 0.0, 0.0, 0.2))


def test_the_angle_of_a_fisheye_s_view_does_not_tell_its_focal_length(tmp_path, write_images):
    write_images(tmp_path / "images", 1)
    frames = [{"file_path": "images/000000.png", "transform_matrix": np.eye(4).tolist()}]
    document = {"camera_model": "OPENCV_FISHEYE", "camera_angle_x": 2.0, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(SourceError, match="a fisheye must come with fl_x"):
        open_sequence(tmp_path)


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model must be one of OPENCV, .*'EQUIRECTANGULAR'"),
        ({"camera_model": "OPENCV", "k4": 0.01}, "k4 must be 0 or come with k5 and k6, got 0.01"),
        ({"camera_model": "FISHEYE624"}, "camera_model must be one of OPENCV, .*'FISHEYE624'"),
    ],
)
def test_a_transforms_file_of_another_model_is_refused(transforms_folder, document, message):
    with pytest.raises(SourceError, match=f"transforms.json holds no usable intrinsics: {message}"):
        open_sequence(transforms_folder(**document))


@pytest.mark.parametrize(
    ("angle_rad", "matrix", "message"),
    [
        (0.0, np.eye(4), r"camera_angle_x must be in \(0, pi\) radians, got 0"),
        (45.0, np.eye(4), r"camera_angle_x must be in \(0, pi\) radians, got 45"),
        (0.8, np.full((4, 4), np.nan), "transform_matrix must be finite"),
        (0.8, np.eye(3), "transform_matrix must be 4x4 or 3x4, got 3x3"),
    ],
)
def test_nonsense_in_a_transforms_file_is_said(tmp_path, write_images, angle_rad, matrix, message):
    write_images(tmp_path / "images", 1)
    frames = [{"file_path": "images/000000.png", "transform_matrix": matrix.tolist()}]
    document = {"camera_angle_x": angle_rad, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(SourceError, match=message):
        open_sequence(tmp_path)


def test_a_json_file_of_another_kind_is_said_to_have_no_frames(tmp_path):
    (tmp_path / "intrinsics.json").write_text('{"fx": 50}')
    with pytest.raises(SourceError, match="can't be used as transforms.json: 'frames' is missing"):
        open_sequence(tmp_path / "intrinsics.json")
