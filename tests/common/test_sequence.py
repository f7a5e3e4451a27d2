import json
import os
import shutil

import cv2
import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.camera_settings import CameraSettings
from semcast.common.errors import SourceError
from semcast.common.geometry import exp_so3
from semcast.common.sequence import open_sequence, retimed
from semcast.common.trajectory import Trajectory, write_tum

CAMERA = Intrinsics(fx=30.0, fy=31.0, cx=15.5, cy=11.5, width=32, height=24)


def test_native_layout_gives_images_times_camera_and_truth(native, poses):
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


def test_a_true_path_follows_the_times_that_a_stream_gives_its_frames(native):
    sequence = open_sequence(native)
    truth, times_ns = sequence.groundtruth(), sequence.times_ns
    same = dict(enumerate(times_ns.tolist()))
    assert retimed(truth, times_ns, same) is truth
    assert retimed(truth, times_ns, {}) is truth
    # Three times as fast, the first frame and one between were lost, and the source begins again.
    stream = {1: 5_000_000_000, 3: 5_066_666_667, 4: 5_100_000_000, 5: 5_133_333_333}
    there = retimed(truth, times_ns, stream)
    np.testing.assert_allclose(there.t_s, [5.0, 5.0333333335, 5.066666667, 5.1], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(there.T_world_cam, truth.T_world_cam[1:])
    assert {stream[k] * 1e-9 for k in (1, 3, 4)} <= set(there.t_s.tolist()), "a frame's time is met exactly"


def test_text_files_may_come_from_windows_editors(native):
    before = open_sequence(native)
    for name in ("times.txt", "groundtruth.txt"):
        text = (native / name).read_text()
        (native / name).write_text(text, "utf-8-sig", newline="\r\n")
    after = open_sequence(native)
    np.testing.assert_array_equal(after.times_ns, before.times_ns)
    np.testing.assert_array_equal(after.groundtruth().T_world_cam, before.groundtruth().T_world_cam)


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
    said = (
        r"that of walk at another size, fx [\d.]+ fy .* for 16x12, got fx 90.0 fy 90.0 cx 7.5 cy 5.5 px for"
    )
    with pytest.raises(ValueError, match=said):
        sequence.image(1, other)


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
    times = ["# seconds", "0.0", "0.1", time, "0.3", "0.4", "0.5"]
    (native / name).write_text("".join(f"{t} images/{k:06d}.png\n" for k, t in enumerate(times)))
    with pytest.raises(SourceError, match=f"{name}:4: {message}"):
        open_sequence(native)


def test_true_poses_at_times_that_are_no_seconds_are_refused(native, poses):
    truth = Trajectory(1.4e18 + 5e7 * np.arange(6), poses(6))
    write_tum(native / "groundtruth.txt", truth)
    with pytest.raises(SourceError, match="groundtruth.txt: times must be in seconds, got 14.*nanoseconds"):
        open_sequence(native)


def seen_by_radtan(camera, point_cam):
    still = np.zeros(3)
    return cv2.projectPoints(point_cam, still, still, camera.K, np.array(camera.distortion))[0].reshape(2)


def seen_by_fisheye(camera, point_cam):
    """Kannala and Brandt 2006, Eq. 6, with the first coefficient in the focal length."""
    x, y, z = point_cam[0]
    angle = np.arctan2(np.hypot(x, y), z)
    away = angle * (1 + sum(k * angle ** (2 * n) for n, k in enumerate(camera.distortion, 1)))
    return camera.K[:2, :2] @ np.array([x, y]) / np.hypot(x, y) * away + camera.K[:2, 2]


@pytest.mark.parametrize(
    ("distortion", "model", "seen", "point"),
    [
        ((-0.25, 0.08, 0.001, -0.002), "radtan", seen_by_radtan, (0.3, -0.2, 1.0)),
        ((0.05, -0.02, 0.01, -0.003), "equidistant", seen_by_fisheye, (0.45, -0.3, 1.0)),
    ],
)
def test_undistortion_moves_points_to_where_the_pinhole_has_them(tmp_path, distortion, model, seen, point):
    camera = Intrinsics(
        fx=300.0,
        fy=300.0,
        cx=159.5,
        cy=119.5,
        width=320,
        height=240,
        distortion=distortion,
        distortion_model=model,
    )
    point_cam = np.array([point])
    distorted_xy = seen(camera, point_cam)
    image = np.zeros((240, 320), dtype=np.uint8)
    # Rendered with sub-pixel precision and blurred, so that its centre of mass is where it is.
    ys, xs = np.mgrid[0:240, 0:320]
    image[:] = 255 * np.exp(-((xs - distorted_xy[0]) ** 2 + (ys - distorted_xy[1]) ** 2) / 8.0)
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "0.png"), image)
    sequence = open_sequence(tmp_path, camera)
    assert sequence.intrinsics.distortion == ()
    assert sequence.stored_camera == camera
    weight = sequence.image(0)[:, :, 0].astype(float)
    centre_xy = [(weight * xs).sum() / weight.sum(), (weight * ys).sum() / weight.sum()]
    expected_xy = sequence.intrinsics.project(point_cam)[0]
    assert np.linalg.norm(expected_xy - distorted_xy) > 3
    np.testing.assert_allclose(centre_xy, expected_xy, atol=0.1)


def test_times_beside_the_images_of_a_folder_are_read(tmp_path, write_images):
    write_images(tmp_path, 3, "img{:d}.png")
    (tmp_path / "times.txt").write_text("0.5\n0.75\n2\n")
    np.testing.assert_array_equal(open_sequence(tmp_path).times_ns, [500_000_000, 750_000_000, 2_000_000_000])


@pytest.mark.parametrize("layout", ["auto", "native"])
def test_a_video_is_sent_to_where_videos_go(tmp_path, layout):
    path = tmp_path / "my film.mp4"
    path.write_bytes(b"video")
    # As a shell takes it, also where a name has spaces.
    with pytest.raises(SourceError, match=f"videos go through: semcast demo --sequence '{path}', or"):
        open_sequence(path, layout=layout)
    (tmp_path / "run.mcap").write_bytes(b"recording")
    with pytest.raises(SourceError, match="run.mcap: recordings of a stream go through: semcast replay"):
        open_sequence(tmp_path / "run.mcap", layout=layout)


def test_a_pipe_among_images_is_no_image(tmp_path, write_images):
    write_images(tmp_path, 3)
    os.mkfifo(tmp_path / "000001b.png")
    assert len(open_sequence(tmp_path)) == 3


def test_a_folder_of_images_needs_a_camera_only_when_it_is_asked_for_one(tmp_path, write_images):
    write_images(tmp_path, 3, "img{:d}.jpg")
    sequence = open_sequence(tmp_path, rate_hz=5.0)
    assert sequence.image(2).shape == (24, 32, 3)
    np.testing.assert_array_equal(sequence.times_ns, [0, 200_000_000, 400_000_000])
    with pytest.raises(SourceError, match=r"camera of .* is unknown: put intrinsics.json"):
        _ = sequence.intrinsics
    given = CameraSettings(fx=30.0, fy=31.0, cx=15.5, cy=11.5)
    assert open_sequence(tmp_path, given).intrinsics == CAMERA


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cx": 5000.0}, r"cx must be in \[-0.5, 31.5\], got 5000"),
        ({"cy": -1.0}, r"cy must be in \[-0.5, 23.5\], got -1"),
        ({"fx": 1.0, "fy": 1.0}, "fx must be at least 2.7 for images of 32x24 .*, got 1; .* in pixels"),
        ({"fy": 1.9}, "fy must be at least 2.0 for images of 32x24 .*, got 1.9; .* in pixels"),
    ],
)
def test_a_camera_that_can_not_be_is_refused(native, change, message):
    camera = {**CAMERA.to_dict(), **change}
    (native / "intrinsics.json").write_text(json.dumps(camera))
    with pytest.raises(SourceError, match=f"intrinsics of .* are not valid: {message}"):
        open_sequence(native)
    given = CameraSettings(**{name: camera[name] for name in ("fx", "fy", "cx", "cy")})
    with pytest.raises(SourceError, match=message):
        open_sequence(native, given, resize=0.5)


@pytest.mark.parametrize(("scale", "is_warned_of"), [(1.0, False), (1.9, True)])
def test_a_calibration_for_larger_images_is_warned_of(native, scale, is_warned_of, caplog):
    values = {**CAMERA.to_dict(), "cx": scale * CAMERA.cx, "cy": scale * CAMERA.cy}
    (native / "intrinsics.json").write_text(json.dumps(values))
    open_sequence(native)
    assert (
        "far from their middle: is the calibration for another image size?" in caplog.text
    ) is is_warned_of


@pytest.mark.parametrize(
    ("factors", "warning"),
    [
        ((1.0, 1.0), ""),
        ((1.0, 1.15), ""),
        ((1.0, 1.33), "pixels that are far from square: is the calibration for images of another shape?"),
        ((1.33, 1.0), "pixels that are far from square"),
        ((100.0, 100.0), "a view of less than 3 degrees in images of"),
    ],
)
def test_focal_lengths_that_are_hardly_meant_are_warned_of(native, factors, warning, caplog):
    focal_px = CAMERA.width * np.array(factors)
    values = {**CAMERA.to_dict(), "fx": focal_px[0], "fy": focal_px[1]}
    (native / "intrinsics.json").write_text(json.dumps(values))
    open_sequence(native)
    assert warning in caplog.text
    assert bool(warning) == bool(caplog.text)


def test_a_wide_camera_with_its_principal_point_in_a_corner_is_taken(native):
    given = CameraSettings(fx=2.7, fy=2.0, cx=-0.5, cy=23.5)
    sequence = open_sequence(native, given, resize=0.5)
    assert (sequence.intrinsics.cx, sequence.intrinsics.cy) == (-0.5, 11.5)


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


def damage_pipe(folder):
    os.mkfifo(folder / "pipe")
    return folder / "pipe"


def damage_truth(folder):
    lines = (folder / "groundtruth.txt").read_text().splitlines()
    (folder / "groundtruth.txt").write_text("\n".join([*lines[:3], "0.25 nan 0 0 0 0 0 1"]))
    return folder


def damage_number(folder):
    (folder / "times.txt").write_text("0\none\n2\n3\n4\n")
    return folder


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (damage_missing, "there is no such file or folder"),
        (damage_pipe, "no sequence at .*pipe: that is a pipe, socket or device"),
        (damage_empty, "expected images/ .native."),
        (damage_size, "intrinsics of walk are for 64x48 images, its images are 32x24: if they are the same"),
        (damage_all_images, "000000.png is not a readable image"),
        (damage_times, "one time per image, got 2 times and 5 images"),
        (damage_order, "times of .*walk must strictly increase, image 3 has 1 s after 1 s"),
        (damage_truth, "groundtruth.txt:4 must be 't tx ty tz qx qy qz qw', got '0.25 nan"),
        (damage_number, "time must be a number of seconds, got 'one'"),
    ],
)
def test_what_is_wrong_with_a_recording_is_said(native, damage, message):
    with pytest.raises(SourceError, match=message):
        open_sequence(damage(native))


def test_a_folder_above_sequences_says_where_they_are(native):
    root = native.parent / "set"
    (root / "sequences").mkdir(parents=True)
    native = native.rename(root / "sequences" / "06")
    with pytest.raises(SourceError, match=f"no sequence at {root} itself, but at {native}$"):
        open_sequence(root)
    shutil.copytree(native, native.with_name("07"))
    with pytest.raises(SourceError, match=f"but at {native} and 1 more$"):
        open_sequence(root)


@pytest.mark.parametrize(("gap", "is_asked"), [(5, False), (100, True)])
def test_times_that_are_hardly_seconds_are_asked_about(native, gap, is_asked, caplog):
    (native / "times.txt").write_text("".join(f"{gap * k}\n" for k in range(5)))
    (native / "groundtruth.txt").unlink()
    open_sequence(native)
    assert (f"images of {native} are 100 s apart: are these times in seconds?" in caplog.text) == is_asked


def test_images_of_which_each_looks_elsewhere_are_no_stream(native, poses):
    def turning(turn_deg, step=1):
        turned = poses(5)
        for k, T in enumerate(turned):
            T[:3, :3] = exp_so3([0.0, np.radians(turn_deg * k), 0.0])
        write_tum(native / "groundtruth.txt", Trajectory(0.1 * np.arange(5)[::step], turned[::step]))
        return open_sequence(native).doubt

    assert turning(15.0) is None
    assert "no stream: from one image to the next the camera turns by 60 degrees" in turning(60.0)
    assert turning(15.0, step=2) is None, "every other image has a true pose: it turns by 15 degrees still"
    (native / "groundtruth.txt").unlink()
    assert open_sequence(native).doubt is None


def test_true_poses_of_another_time_are_said_not_to_be_used(native, poses, caplog):
    assert open_sequence(native).groundtruth() is not None
    assert not caplog.records
    write_tum(native / "groundtruth.txt", Trajectory(1000.0 + np.arange(3), poses(3)))
    assert open_sequence(native).groundtruth() is None
    assert "none of its 3 true poses, from 1000.000 to 1002.000 s, is at the time of an image" in caplog.text
    assert "from 0.000 to 0.400 s" in caplog.text


def test_a_damaged_first_image_is_an_error_of_that_frame_alone(native):
    (native / "images" / "000000.png").write_bytes(b"")
    sequence = open_sequence(native)
    assert (len(sequence), sequence.size_wh) == (5, (32, 24))
    with pytest.raises(SourceError, match="000000.png is not a readable image"):
        sequence.image(0)
    assert sequence.image(1).shape == (24, 32, 3)


def test_images_that_would_be_refused_are_found_beforehand(native, write_images):
    (native / "images" / "000001.png").write_bytes(b"broken")
    write_images(native / "other", 1, size=(10, 12))
    (native / "other" / "000000.png").rename(native / "images" / "000003.png")
    messages, num_skipped = open_sequence(native).refused_images()
    assert "000001.png is not a readable image" in messages[0]
    assert "000003.png is 12x10, the first readable image" in messages[1]
    assert (len(messages), num_skipped) == (2, 0)
    messages, num_skipped = open_sequence(native).refused_images(most_decoded=0)
    assert (len(messages), num_skipped) == (1, 1), "only the damaged one must be decoded"


def test_a_damaged_image_in_the_middle_is_an_error_of_that_frame_alone(native, write_images):
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
