import re
import socket
import time

import cv2
import numpy as np
import pytest

from semcast import SourceError
from semcast.agent.calibrate import (
    BoardView,
    board_points,
    calibrate,
    calibration_picture,
    coverage,
    find_board,
    is_new_view,
)
from semcast.cli import main
from semcast.commands.calibrate import camera_pictures
from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, make_transform

BOARD = (9, 6)
TRUE = Intrinsics(
    fx=410, fy=405, cx=236.3, cy=181.8, width=480, height=360, distortion=(-0.25, 0.08, 1e-3, -5e-4)
)
SUPERSAMPLE = 3


def poses_of_the_board(num_views, seed=0):
    """Tilted boards that move over the whole image."""
    rng = np.random.default_rng(seed)
    centre = (np.array(BOARD) - 1) / 2
    poses = []
    for k in range(num_views):
        R = exp_so3(rng.uniform((-0.6, -0.6, -0.3), (0.6, 0.6, 0.3)))
        at = np.array([(-1, 0, 1)[k % 3] * 2.2, (-1, 0, 1)[k // 3 % 3] * 1.9, 13.0])
        poses.append(make_transform(R, at - R @ (*centre, 0.0)))
    return poses


@pytest.fixture(scope="module")
def rays():
    """Undistorted rays through a grid finer than the pixels, found by OpenCV's inverse distortion."""
    offsets = (np.arange(SUPERSAMPLE) + 0.5) / SUPERSAMPLE - 0.5
    xs = (np.arange(TRUE.width)[:, None] + offsets).ravel()
    ys = (np.arange(TRUE.height)[:, None] + offsets).ravel()
    xy = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 1, 2)
    undistorted = cv2.undistortPoints(xy, TRUE.K, np.array(TRUE.distortion)).reshape(-1, 2)
    return np.column_stack([undistorted, np.ones(len(undistorted))])


def render(T_cam_board, rays):
    """Cast every ray onto the board's plane and average the squares it meets."""
    R, t = T_cam_board[:3, :3], T_cam_board[:3, 3]
    depth = (R[:, 2] @ t) / (rays @ R[:, 2])
    on_board = (depth[:, None] * rays - t) @ R[:, :2]
    square = np.floor(on_board).astype(int)
    inside = np.all((square >= -1) & (square < BOARD), axis=1)
    bright = np.where(inside & (square.sum(axis=1) % 2 == 0), 30.0, 225.0)
    fine = bright.reshape(TRUE.height, SUPERSAMPLE, TRUE.width, SUPERSAMPLE)
    grey = fine.mean(axis=(1, 3))
    return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)


@pytest.fixture(scope="module")
def pictures(rays):
    return [render(T, rays) for T in poses_of_the_board(12)]


def true_corners(T_cam_board):
    rotation, _ = cv2.Rodrigues(T_cam_board[:3, :3])
    return cv2.projectPoints(
        board_points(BOARD), rotation, T_cam_board[:3, 3], TRUE.K, np.array(TRUE.distortion)
    )[0].reshape(-1, 2)


def exact_views(num_views=12):
    return [
        BoardView(f"{k}", true_corners(T).astype(np.float32))
        for k, T in enumerate(poses_of_the_board(num_views))
    ]


def test_corners_are_found_to_a_tenth_of_a_pixel(pictures):
    squared = []
    for picture, T in zip(pictures, poses_of_the_board(12), strict=True):
        found, truth = find_board(picture, BOARD), true_corners(T)
        assert found is not None
        error = min((found - truth, found[::-1] - truth), key=lambda e: np.abs(e).max())
        assert np.abs(error).max() < 0.4
        squared.append(error**2)
    assert np.sqrt(np.mean(squared)) < 0.1


def test_rendered_pictures_give_the_camera_they_were_rendered_with(tmp_path, pictures, capsys):
    for k, picture in enumerate(pictures):
        cv2.imwrite(str(tmp_path / f"{k:02d}.png"), picture)
    out = tmp_path / "sub" / "intrinsics.json"
    words = ["calibrate", str(tmp_path), "--board", "9x6", "--distortion", "radtan4", "--out", str(out)]
    assert main(words) == 0
    found = Intrinsics.load(out)
    assert (found.width, found.height) == (480, 360)
    assert [found.fx, found.fy] == pytest.approx([TRUE.fx, TRUE.fy], rel=0.003)
    assert [found.cx, found.cy] == pytest.approx([TRUE.cx, TRUE.cy], abs=1.0)
    assert found.distortion[:2] == pytest.approx(TRUE.distortion[:2], abs=0.03)
    captured = capsys.readouterr()
    assert "12 views" in captured.out
    for name in ("fx", "fy", "cx", "cy"):
        assert re.search(rf"\b{name} \d+\.\d\d \+- \d\.\d\d px\b", captured.out), name
    assert "doubtful" not in captured.err
    assert cv2.imread(str(out.with_suffix(".png"))).shape == (360, 960, 3)


def test_who_counts_squares_is_told_the_inner_corners(tmp_path, pictures, capsys):
    cv2.imwrite(str(tmp_path / "0.png"), pictures[0])
    assert main(["calibrate", str(tmp_path), "--board", "10x7", "--out", str(tmp_path / "out.json")]) == 1
    assert "these are its squares, give --board 9x6" in capsys.readouterr().err


def turned_by_note(jpeg, orientation):
    """Put an EXIF note before a JPEG's content that says how to turn it for people."""
    entry = b"II*\0\x08\0\0\0\x01\0" + b"\x12\x01\x03\0\x01\0\0\0" + bytes([orientation, 0, 0, 0]) + bytes(4)
    note = b"Exif\0\0" + entry
    return jpeg[:2] + b"\xff\xe1" + (2 + len(note)).to_bytes(2, "big") + note + jpeg[2:]


@pytest.mark.parametrize("orientation", [3, 6])
def test_pictures_are_calibrated_as_stored_however_their_notes_turn_them(
    tmp_path, pictures, orientation, capsys
):
    for k, picture in enumerate(pictures):
        jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
        (tmp_path / f"{k:02d}.jpg").write_bytes(turned_by_note(jpeg, orientation))
    assert cv2.imread(str(tmp_path / "00.jpg"))[0, 0, 0] == pictures[0][-1, -1, 0], "the note is understood"
    out = tmp_path / "intrinsics.json"
    assert main(["calibrate", str(tmp_path), "--distortion", "radtan4", "--out", str(out)]) == 0
    found = Intrinsics.load(out)
    assert (found.width, found.height) == (480, 360)
    assert [found.cx, found.cy] == pytest.approx([TRUE.cx, TRUE.cy], abs=1.5)


def test_exact_corners_give_the_exact_camera_and_no_error():
    result = calibrate(exact_views(), BOARD, (480, 360), "radtan4")
    assert result.rms_px < 1e-3
    c = result.intrinsics
    assert [c.fx, c.fy, c.cx, c.cy] == pytest.approx([410, 405, 236.3, 181.8], abs=0.01)
    assert c.distortion == pytest.approx(TRUE.distortion, abs=1e-4)
    assert result.rejected == ()


def test_a_fisheye_is_found_with_how_well_it_is_known():
    lens = np.array([0.02, -0.01, 0.004, -0.001])
    K = np.array([[210.0, 0.0, 236.3], [0.0, 207.0, 181.8], [0.0, 0.0, 1.0]])
    board, rng = board_points(BOARD).astype(np.float64)[None], np.random.default_rng(1)
    found = []
    for _ in range(8):
        views = []
        for k, T in enumerate(poses_of_the_board(16)):
            t = T[:3, 3] - (0.0, 0.0, 5.0)  # so near that it reaches 70 degrees off the axis
            xy, _ = cv2.fisheye.projectPoints(board, cv2.Rodrigues(T[:3, :3])[0], t, K, lens)
            views.append(BoardView(f"{k}", (xy[0] + rng.normal(0, 0.2, xy[0].shape)).astype(np.float32)))
        found.append(calibrate(views, BOARD, (480, 360), "equidistant"))
    cameras = [result.intrinsics for result in found]
    assert {camera.distortion_model for camera in cameras} == {"equidistant"}
    values = np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras])
    error = (values - [210.0, 207.0, 236.3, 181.8]) / [result.deviations for result in found]
    assert 0.5 < np.sqrt((error**2).mean()) < 1.6
    # Coefficients take each other's place; where a ray ends does not change with that.
    powers = 0.7 ** np.array([3, 5, 7, 9])
    ends = [camera.fx * (0.7 + camera.distortion @ powers) for camera in cameras]
    assert np.mean(ends) == pytest.approx(210.0 * (0.7 + lens @ powers), abs=0.2)
    assert found[0].rms_px == pytest.approx(0.2 * np.sqrt(2.0), rel=0.1)


def test_the_error_is_the_noise_that_was_put_in():
    rng = np.random.default_rng(3)
    views = [
        BoardView(v.name, v.corners_xy + rng.normal(0, 0.3, v.corners_xy.shape).astype(np.float32))
        for v in exact_views(20)
    ]
    result = calibrate(views, BOARD, (480, 360), "radtan4")
    # rms over both coordinates: 0.3 * sqrt(2)
    assert result.rms_px == pytest.approx(0.424, rel=0.06)
    assert np.sqrt((result.residuals_xy**2).sum(axis=2).mean()) == pytest.approx(result.rms_px, rel=1e-3)
    assert abs(result.intrinsics.fx - TRUE.fx) < 5 * result.deviations[0]


def test_a_view_with_wrong_corners_is_left_out():
    views = exact_views()
    shift = 6 * np.random.default_rng(0).random((54, 2), np.float32)
    views[5] = BoardView("wrong", views[5].corners_xy + shift)
    result = calibrate(views, BOARD, (480, 360), "radtan4")
    assert result.rejected == ("wrong",)
    assert result.rms_px < 1e-2


def test_no_distortion_gives_no_coefficients():
    bare = calibrate(exact_views(), BOARD, (480, 360), "none")
    assert bare.intrinsics.distortion == ()
    assert bare.rms_px > 0.5, "a fit without it has its error"
    assert len(calibrate(exact_views(), BOARD, (480, 360), "radtan5").intrinsics.distortion) == 5


def test_coverage_and_new_views_are_counted_by_hand():
    view = BoardView("a", np.array([[0, 0], [10, 10], [59, 59]], dtype=np.float32))
    assert coverage([view], (60, 60)) == 3 / 36
    assert not is_new_view(view.corners_xy + 1, [view], 60)
    assert is_new_view(view.corners_xy + 3, [view], 60)


def test_doubtful_results_say_why():
    views = exact_views(4)
    text = " ".join(calibrate(views, BOARD, (480, 360), "radtan4").warnings())
    assert "only 4 views" in text
    assert calibrate(exact_views(18), BOARD, (480, 360), "radtan4").warnings() == []


def test_the_picture_shows_both_halves_in_the_image_size(pictures):
    picture = calibration_picture(calibrate(exact_views(), BOARD, (480, 360)), pictures[0])
    assert picture.shape == (360, 960, 3)
    assert np.any(picture[:, 480:] != 255)


def test_too_few_views_are_an_error():
    with pytest.raises(SourceError, match="at least 4 views"):
        calibrate(exact_views(3), BOARD, (480, 360))


def test_boards_that_were_never_tilted_are_refused_as_they_fit_any_focal_length():
    rng = np.random.default_rng(0)
    views = []
    for k in range(12):
        straight_on = make_transform(np.eye(3), np.array([k % 4 - 5.5, k // 4 - 3.5, 9.0 + k % 5]))
        noise = rng.normal(0, 0.1, (54, 2))
        views.append(BoardView(f"{k}", (true_corners(straight_on) + noise).astype(np.float32)))
    with pytest.raises(SourceError, match=r"tilted by 20-45 degrees .*parallel to within \d\.\d degrees"):
        calibrate(views, BOARD, (480, 360))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "either pictures"),
        (["--board", "9"], "must look like 9x6"),
        (["--board", "2x6"], "at least 3"),
        (["{}/none.png"], "does not exist"),
        (["{}"], "there is no picture"),
        (["{}/blank"], "count inner"),
        (["{}/mixed"], "one camera"),
        (["{}/broken"], "a.jpg is not a readable image"),
        (["{}/blank", "--picture", "{}/p.json"], "picture must be an image file (.png"),
        (["--camera", "{}/no.mp4"], "can't be opened"),
        (["--camera", "{}/no.mp4", "--picture", "{}/broken/a.jpg/p.png"], "picture can't be written to"),
    ],
)
def test_mistakes_are_one_clear_line(tmp_path, capsys, words, message):
    for name, sizes in (("blank", [(60, 80)]), ("mixed", [(60, 80), (80, 60)])):
        (tmp_path / name).mkdir()
        for k, size in enumerate(sizes):
            cv2.imwrite(str(tmp_path / name / f"{k}.png"), np.full((*size, 3), 200, dtype=np.uint8))
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "a.jpg").write_bytes(b"no picture")
    out = ["--out", str(tmp_path / "out.json")]
    words = [w.format(tmp_path) for w in words]
    if "--board" in words:
        words.append(str(tmp_path))
    assert main(["calibrate", *words, *out]) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out.json").exists()


def test_the_password_of_a_camera_is_not_shown(tmp_path, capsys):
    words = ["--camera", "http://user:secret@127.0.0.1:1/x", "--out", str(tmp_path / "out.json")]
    assert main(["calibrate", *words]) == 1
    said = capsys.readouterr().err
    assert "camera http://127.0.0.1:1/x can't be opened" in said
    assert "secret" not in said


def test_a_file_that_can_not_be_written_is_told_before_any_view_is_taken(tmp_path, capsys):
    (tmp_path / "file").touch()
    words = ["--camera", str(tmp_path / "no.mp4"), "--out", str(tmp_path / "file" / "out.json")]
    assert main(["calibrate", *words]) == 1
    assert "out can't be written to" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["x.png", "x.yaml", "x"])
def test_a_result_is_not_written_to_a_file_of_another_kind(tmp_path, capsys, name):
    cv2.imwrite(str(tmp_path / "0.png"), np.full((60, 80, 3), 200, dtype=np.uint8))
    assert main(["calibrate", str(tmp_path / "0.png"), "--out", str(tmp_path / name)]) == 1
    assert f"out must be a .json file, got {tmp_path / name}" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0.png"]


def test_a_camera_that_says_nothing_is_given_up(monkeypatch):
    monkeypatch.setattr("semcast.agent.video._OPEN_TIMEOUT_MS", 300)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        began_s = time.monotonic()
        with pytest.raises(SourceError, match="camera http://.* can't be opened"):
            next(camera_pictures(f"http://127.0.0.1:{silent.getsockname()[1]}/stream.mjpg"))
    assert time.monotonic() - began_s < 10.0  # by itself OpenCV waits for half a minute


def test_of_a_video_of_the_board_views_are_taken_as_of_a_live_camera(tmp_path, pictures, capsys):
    path = str(tmp_path / "board.avi")
    video = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 30, (480, 360))
    assert video.isOpened()
    for picture in pictures:
        for _ in range(5):
            video.write(picture)
    video.release()
    out = tmp_path / "live.json"
    words = ["--views", "9", "--distortion", "radtan4", "--out", str(out)]
    assert main(["calibrate", path, *words]) == 0
    assert "9 views" in capsys.readouterr().out
    assert Intrinsics.load(out).fx == pytest.approx(TRUE.fx, rel=0.02)
