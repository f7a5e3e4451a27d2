import shutil
import subprocess
import sys
import threading
import time

import cv2
import numpy as np
import pytest

from semcast.agent.source import (
    MAX_BAD_IN_A_ROW,
    Pacer,
    is_camera_number,
    is_live,
    open_source,
    playback_order,
)
from semcast.agent.source_settings import SourceSettings
from semcast.agent.video import public_name
from semcast.common.camera_settings import CameraSettings
from semcast.common.errors import SourceError

PINHOLE = CameraSettings(fx=50.0, fy=50.0, cx=31.5, cy=23.5)


def fast(path, **changes):
    return SourceSettings(source=str(path), **{"pace": "receiver", **changes})


def play(settings, most=100):
    source = open_source(settings)
    frames = []
    for frame in source.frames(threading.Event()):
        frames.append(frame)
        if len(frames) == most:
            break
    source.close()
    return source, frames


class Clock:
    """Time that passes only while somebody waits."""

    def __init__(self):
        self.now_s = 100.0
        self.waits_s = []

    def __call__(self):
        return self.now_s

    def wait(self, seconds):
        self.waits_s.append(seconds)
        self.now_s += seconds
        return False


def test_a_recording_is_played_with_its_ids_and_times(recording):
    source, frames = play(fast(recording))
    assert [f.frame_id for f in frames] == list(range(12))
    assert [f.t_source_ns for f in frames] == [5_000_000_000 + 20_000_000 * k for k in range(12)]
    assert [int(f.image[0, 0, 0]) for f in frames] == [20 * k for k in range(12)]
    assert [f.final for f in frames] == [False] * 11 + [True]
    assert (source.name, source.num_frames, source.rate_hz) == ("steps", 12, 0.0)
    assert frames[0].image.shape == (48, 64, 3)


def test_stride_size_and_length_can_be_chosen(recording):
    source, frames = play(fast(recording, stride=3, max_frames=2, resize=0.5))
    assert [f.frame_id for f in frames] == [0, 3]
    assert frames[1].final
    assert frames[0].image.shape == (24, 32, 3)
    assert (source.intrinsics.fx, source.intrinsics.cx, source.num_frames) == (25.0, 15.5, 2)


def test_repeated_playing_counts_ids_and_times_on(recording):
    source, frames = play(fast(recording, stride=4, repeat="loop"), most=7)
    assert [int(f.image[0, 0, 0]) for f in frames] == [0, 80, 160, 0, 80, 160, 0]
    assert [f.frame_id for f in frames] == [0, 4, 8, 9, 10, 11, 12]
    assert np.diff([f.t_source_ns for f in frames]).tolist() == [80_000_000] * 6
    assert (source.num_frames, source.last_frame_id) == (None, None)
    _, frames = play(fast(recording, stride=4, repeat="swing"), most=8)
    assert [int(f.image[0, 0, 0]) for f in frames] == [0, 80, 160, 80, 0, 80, 160, 80]
    assert np.diff([f.t_source_ns for f in frames]).tolist() == [80_000_000] * 7
    assert not any(f.final for f in frames)


@pytest.mark.parametrize("most", [2, 12, 15])
def test_repeated_playing_ends_after_the_frames_asked_for(recording, most):
    for repeat in ("loop", "swing"):
        source, frames = play(fast(recording, max_frames=most, repeat=repeat))
        assert len(frames) == source.num_frames == most
        assert frames[-1].frame_id == source.last_frame_id == most - 1
        assert [f.final for f in frames] == [False] * (most - 1) + [True]


def test_a_swing_over_one_frame_stays_there():
    order = playback_order(1, "swing")
    assert [next(order) for _ in range(4)] == [0, 0, 0, 0]


def test_pacing_follows_the_recording_or_the_rate():
    clock = Clock()
    pacer = Pacer(SourceSettings(source="x"), clock.wait, clock)
    times_ns = [7_000_000_000, 7_100_000_000, 7_400_000_000]
    assert all(pacer.until_due(t) for t in times_ns)
    np.testing.assert_allclose(clock.waits_s, [0.0, 0.1, 0.3], atol=1e-9)
    clock = Clock()
    pacer = Pacer(SourceSettings(source="x", pace="rate", rate_hz=4.0), clock.wait, clock)
    assert all(pacer.until_due(t) for t in times_ns)
    np.testing.assert_allclose(clock.waits_s, [0.0, 0.25, 0.25], atol=1e-9)
    clock.now_s += 10.0
    assert pacer.until_due(0)
    assert clock.waits_s[-1] == 0.0, "a late frame is due at once"
    assert not Pacer(SourceSettings(source="x"), lambda s: True, clock).until_due(0)


def test_a_rate_that_recorded_times_overrule_is_said(recording, tmp_path, caplog):
    for changes in ({}, {"rate_hz": 7.0, "pace": "rate"}):
        open_source(SourceSettings(source=str(recording), **changes)).close()
    plain = tmp_path / "plain"
    shutil.copytree(recording / "images", plain)
    open_source(SourceSettings(source=str(plain), camera=PINHOLE, rate_hz=7.0, stride=2)).close()
    assert not caplog.text
    open_source(SourceSettings(source=str(recording), rate_hz=7.0)).close()
    assert "rate_hz: no effect on" in caplog.text


@pytest.mark.parametrize(
    ("how", "step_ns"),
    [
        ({"pace": "receiver"}, 100_000_000),
        ({"pace": "receiver", "rate_hz": 20.0}, 50_000_000),
        ({"pace": "rate", "rate_hz": 1000.0}, 100_000_000),
    ],
)
def test_a_folder_without_times_has_the_same_however_fast_it_is_played(recording, how, step_ns):
    _, frames = play(SourceSettings(source=str(recording / "images"), camera=PINHOLE, **how), 3)
    assert [frame.t_source_ns for frame in frames] == [0, step_ns, 2 * step_ns]


def test_a_rate_and_a_layout_that_a_video_overrules_are_said(tmp_path, caplog):
    video = tmp_path / "steady.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (64, 48))
    for k in range(3):
        writer.write(np.full((48, 64, 3), 20 * k, np.uint8))
    writer.release()
    same = {"source": str(video), "camera": PINHOLE}
    for changes in ({}, {"rate_hz": 7.0, "pace": "rate"}, {"rate_hz": 25.0, "stride": 2}):
        open_source(SourceSettings(**same, **changes)).close()
    assert not caplog.text
    open_source(SourceSettings(**same, rate_hz=7.0)).close()
    assert "rate_hz: no effect on steady.avi" in caplog.text
    caplog.clear()
    open_source(SourceSettings(**same, layout="tum")).close()
    assert [r.getMessage() for r in caplog.records] == ["layout: no effect on steady.avi, which is no folder"]


def test_recorded_pace_takes_the_recorded_time(recording):
    started_s = time.monotonic()
    _, frames = play(SourceSettings(source=str(recording)))
    assert len(frames) == 12
    assert time.monotonic() - started_s >= 11 * 0.02 - 0.001


def test_stopping_ends_the_waiting(recording):
    source = open_source(SourceSettings(source=str(recording), pace="rate", rate_hz=0.01))
    stop = threading.Event()
    frames = source.frames(stop)
    next(frames)
    threading.Timer(0.05, stop.set).start()
    assert list(frames) == []


def test_a_damaged_image_is_left_out_and_many_end_the_source(recording, tmp_path, caplog):
    folder = tmp_path / "damaged"
    shutil.copytree(recording, folder)
    (folder / "images" / "000004.png").write_bytes(b"broken")
    _, frames = play(fast(folder))
    assert [f.frame_id for f in frames] == [0, 1, 2, 3, 5, 6, 7, 8, 9, 10, 11]
    assert "frame 4 is left out" in caplog.text
    for k in range(1, 1 + MAX_BAD_IN_A_ROW):
        (folder / "images" / f"{k:06d}.png").write_bytes(b"broken")
    with pytest.raises(SourceError, match=r"^10 images in a row .*000010.png is not a readable image"):
        play(fast(folder))


def test_images_that_can_not_be_read_take_their_time(recording, tmp_path):
    folder = tmp_path / "away"
    shutil.copytree(recording, folder)
    for k in range(1, MAX_BAD_IN_A_ROW):
        (folder / "images" / f"{k:06d}.png").write_bytes(b"broken")
    _, frames = play(SourceSettings(source=str(folder), pace="rate", rate_hz=50.0))
    assert [f.frame_id for f in frames] == [0, MAX_BAD_IN_A_ROW, MAX_BAD_IN_A_ROW + 1]
    assert frames[1].t_capture_ns - frames[0].t_capture_ns > 0.9e9 * MAX_BAD_IN_A_ROW / 50.0


@pytest.mark.parametrize("damaged", [1, MAX_BAD_IN_A_ROW - 1])
def test_a_recording_ends_with_its_last_readable_image(recording, tmp_path, caplog, damaged):
    folder = tmp_path / "damaged"
    shutil.copytree(recording, folder)
    for k in range(12 - damaged, 12):
        (folder / "images" / f"{k:06d}.png").write_bytes(b"broken")
    source, frames = play(fast(folder))
    assert [f.frame_id for f in frames] == list(range(12 - damaged))
    assert [f.final for f in frames] == [False] * (11 - damaged) + [True]
    assert (source.num_frames, source.last_frame_id) == (12 - damaged, 11 - damaged)
    left_out = [record.getMessage().split(":")[0] for record in caplog.records]
    assert left_out == [f"frame {k} is left out" for k in range(12 - damaged, 12)]
    assert source.num_unreadable == damaged


@pytest.mark.parametrize("repeat", ["loop", "swing"])
def test_a_repeated_recording_makes_up_for_damaged_images(recording, tmp_path, repeat):
    folder = tmp_path / "damaged"
    shutil.copytree(recording, folder)
    (folder / "images" / "000011.png").write_bytes(b"broken")
    source, frames = play(fast(folder, repeat=repeat, max_frames=12))
    assert [f.frame_id for f in frames] == [*range(11), 12]
    assert [f.final for f in frames] == [False] * 11 + [True]
    assert source.num_frames == 12


def test_a_damaged_first_image_is_left_out_like_any_other(recording, tmp_path, caplog):
    folder = tmp_path / "damaged"
    shutil.copytree(recording, folder)
    (folder / "images" / "000000.png").write_bytes(b"broken")
    _, frames = play(fast(folder))
    assert [f.frame_id for f in frames] == list(range(1, 12))
    assert "frame 0 is left out" in caplog.text


def test_a_video_file_is_played(video):
    source, frames = play(fast(video, camera=PINHOLE, stride=2))
    assert [f.frame_id for f in frames] == [0, 2, 4, 6, 8]
    assert [f.t_source_ns for f in frames] == [40_000_000 * k for k in range(5)]
    np.testing.assert_allclose([f.image.mean() for f in frames], [0, 40, 80, 120, 160], atol=3)
    assert [f.final for f in frames] == [False] * 4 + [True]
    assert (source.num_frames, source.intrinsics.fx) == (5, 50.0)
    assert source.last_frame_id == 8


def test_a_video_can_be_cut_and_repeated(video):
    source, frames = play(fast(video, camera=PINHOLE, max_frames=3))
    assert [(f.frame_id, f.final) for f in frames] == [(0, False), (1, False), (2, True)]
    assert (source.num_frames, source.last_frame_id) == (3, 2)
    source, frames = play(fast(video, camera=PINHOLE, repeat="loop"), most=20)
    assert [f.frame_id for f in frames] == list(range(20))
    np.testing.assert_allclose(frames[9].image.mean(), 0, atol=3)
    assert source.num_frames is None
    with pytest.raises(SourceError, match="can't be played backwards"):
        open_source(fast(video, camera=PINHOLE, repeat="swing"))


@pytest.fixture(scope="module")
def uneven_video(tmp_path_factory):
    """Nine images at 0, 1, 2, 3, 6, 9 ... times 40 ms, or a skip where OpenCV can't write Matroska."""
    path = tmp_path_factory.mktemp("videos") / "uneven.mkv"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (64, 48))
    if not writer.isOpened():
        pytest.skip("this OpenCV can't write Matroska")
    for k in range(9):
        writer.write(np.full((48, 64, 3), 20 * k, np.uint8))
    writer.release()
    data = path.read_bytes()
    # OpenCV writes even times only; a block has its own as 16 bits between track and flags.
    for k in range(8, 3, -1):
        even, uneven = (b"\x81" + (40 * n).to_bytes(2, "big") + b"\x80" for n in (k, 3 * k - 6))
        assert data.count(even) == 1
        data = data.replace(even, uneven)
    path.write_bytes(data)
    return path


def test_a_video_of_varying_rate_keeps_its_times_over_all_passes(video, uneven_video):
    _, frames = play(fast(uneven_video, camera=PINHOLE, repeat="loop", max_frames=18))
    times_ms = np.array([f.t_source_ns for f in frames]) / 1e6
    np.testing.assert_allclose(times_ms[:9], [40 * k for k in (0, 1, 2, 3, 6, 9, 12, 15, 18)], atol=1.0)
    np.testing.assert_allclose(np.diff(times_ms[9:]), np.diff(times_ms[:9]), atol=1e-3)
    assert times_ms[9] > times_ms[8]
    source, frames = play(fast(video, camera=PINHOLE, repeat="loop", max_frames=30))
    assert (source.num_frames, source.last_frame_id) == (len(frames), frames[-1].frame_id) == (30, 29)
    assert [f.t_source_ns for f in frames] == [20_000_000 * k for k in range(30)]


def test_one_wrong_stamp_of_a_video_holds_up_no_frame(uneven_video, tmp_path):
    data, wrong = uneven_video.read_bytes(), tmp_path / "wrong.mkv"
    third, far = (b"\x81" + (40 * n).to_bytes(2, "big") + b"\x80" for n in (2, 800))
    wrong.write_bytes(data.replace(third, far))
    frames, expected = (play(fast(path, camera=PINHOLE))[1] for path in (wrong, uneven_video))
    times_ms, expected_ms = ([f.t_source_ns / 1e6 for f in of] for of in (frames, expected))
    np.testing.assert_allclose(times_ms, expected_ms, atol=1.0)


def test_a_damaged_video_says_how_much_of_it_can_be_read(tmp_path, caplog):
    whole, cut = tmp_path / "whole.avi", tmp_path / "cut.avi"
    writer = cv2.VideoWriter(str(whole), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (64, 48))
    for seed in range(60):
        writer.write(np.random.default_rng(seed).integers(0, 256, (48, 64, 3), dtype=np.uint8))
    writer.release()
    data = whole.read_bytes()
    cut.write_bytes(data[: len(data) * 2 // 3])
    for path, is_damaged in ((whole, False), (cut, True)):
        caplog.clear()
        _, frames = play(fast(path, camera=PINHOLE))
        assert (len(frames) < 60) == is_damaged
        assert ("of its 60 frames could be read; it may be damaged" in caplog.text) == is_damaged
    caplog.clear()
    play(fast(cut, camera=PINHOLE, repeat="loop"))
    assert caplog.text.count("may be damaged") == 1, "once, not in every pass"
    caplog.clear()
    play(fast(cut, camera=PINHOLE, max_frames=5))
    assert not caplog.text, "an end that was asked for is none"


def test_a_video_needs_a_camera_that_fits(video, tmp_path):
    with pytest.raises(SourceError, match="camera of .* is unknown: put intrinsics.json"):
        open_source(fast(video))
    beside = tmp_path / "steps.avi"
    shutil.copy(video, beside)
    (tmp_path / "intrinsics.json").write_text(
        '{"fx": 50, "fy": 50, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48}'
    )
    assert open_source(fast(beside)).intrinsics.fx == 50.0
    (tmp_path / "intrinsics.json").write_text(
        '{"fx": 50, "fy": 50, "cx": 31.5, "cy": 23.5, "width": 640, "height": 480}'
    )
    with pytest.raises(SourceError, match="steps.avi are for 640x480 images, its images are 64x48"):
        open_source(fast(beside))
    with pytest.raises(SourceError, match=r"of .*steps.avi are not valid: cx must be in \[-0.5, 63.5\]"):
        open_source(fast(video, camera=CameraSettings(fx=50.0, fy=50.0, cx=5000.0, cy=23.5)))
    (tmp_path / "steps.json").write_text('{"title": "a film"}')
    with pytest.raises(SourceError, match="steps.json: intrinsics need .*, missing 'fx'"):
        open_source(fast(beside))


@pytest.mark.parametrize("name", [b"film\xe9.avi", b"/dev/video\xe9", b"rtsp://me:secret@host/\xe9"])
def test_a_name_that_is_no_text_is_refused_and_does_not_end_the_process(name):
    code = "import sys; from semcast.agent.video import open_capture; open_capture(sys.argv[1], live={})"
    done = subprocess.run(
        [sys.executable, "-c", code.format(b"avi" not in name), name],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 1, "as of an exception"
    assert "must be text in UTF-8" in done.stderr
    assert "secret" not in done.stderr.splitlines()[-1]


def test_what_can_not_be_opened_is_said(tmp_path):
    (tmp_path / "notes.txt").write_text("no video")
    with pytest.raises(SourceError, match=r"video .*notes.txt can't be opened: it is in no format"):
        open_source(fast(tmp_path / "notes.txt", camera=PINHOLE))
    cv2.imwrite(str(tmp_path / "one.JPG"), np.zeros((48, 64, 3), np.uint8))
    with pytest.raises(SourceError, match="one.JPG is a single picture: give the folder"):
        open_source(fast(tmp_path / "one.JPG", camera=PINHOLE))
    (tmp_path / "run.mcap").write_bytes(b"recording")
    with pytest.raises(SourceError, match="run.mcap can't be opened: 'semcast replay' takes recordings"):
        open_source(fast(tmp_path / "run.mcap", camera=PINHOLE))
    with pytest.raises(SourceError, match="there is no such file or folder"):
        open_source(fast(tmp_path / "nowhere"))


def test_a_number_is_a_camera_unless_something_has_that_name(recording, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(recording, "2024")
    assert open_source(fast("2024")).name == "2024"
    with pytest.raises(SourceError, match="camera 2025 can't be opened"):
        open_source(fast("2025", camera=PINHOLE))


@pytest.mark.parametrize("text", ["2²", "²", "٣", "20240101123000", "front"])
def test_what_only_looks_like_a_camera_number_is_a_folder(text):
    assert not is_camera_number(text)
    with pytest.raises(SourceError, match=f"no sequence at {text}: there is no such file or folder"):
        open_source(fast(text))


def test_a_device_is_a_camera_whether_it_is_plugged_in_or_not(tmp_path):
    assert is_live("/dev/video0")
    assert is_live("/dev/v4l/by-id/usb-none")
    with pytest.raises(SourceError, match="camera /dev/video99 can't be opened"):
        open_source(fast("/dev/video99", camera=PINHOLE))
    # A folder in memory is none, and neither is what is missing there.
    assert not is_live("/dev/shm")
    assert not is_live("/dev/shm/none")


@pytest.mark.skipif(sys.platform != "linux", reason="devices have other names")
def test_why_a_camera_can_not_be_opened_is_said(monkeypatch):
    def why(source):
        with pytest.raises(SourceError) as caught:
            open_source(fast(source, camera=PINHOLE))
        return str(caught.value).partition(" can't be opened: ")[2]

    assert why("2025") == "there is no /dev/video2025"
    assert why("/dev/video99") == "there is no /dev/video99"
    assert why("/dev/null") == "/dev/null gives no images; it may be in use, or no camera"
    monkeypatch.setattr("semcast.agent.video.os.access", lambda path, mode: False)
    assert "may not use /dev/null" in why("/dev/null")


def test_an_address_is_shown_without_its_password():
    assert public_name("rtsp://user:secret@10.0.0.7/stream") == "rtsp://10.0.0.7/stream"
    assert public_name("clip@home.mp4") == "clip@home.mp4"
    in_query = "http://10.0.0.7/video.cgi?usr=me&loginPas=secret&rate=5#1"
    assert public_name(in_query) == "http://10.0.0.7/video.cgi?usr=me&loginPas=***&rate=5#1"
    in_path = "rtsp://10.0.0.7:554/user=me&password=secret&channel=1&stream=0.sdp"
    assert public_name(in_path) == "rtsp://10.0.0.7:554/user=me&password=***&channel=1&stream=0.sdp"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"source": ""}, "source must name"),
        ({"resize": 2.0}, r"resize must be in \[0.05, 1\], got 2"),
        ({"stride": 0}, "stride must be at least 1, got 0"),
        ({"max_frames": 0}, "max_frames must be at least 1, got 0"),
        ({"rate_hz": 0.0}, r"rate_hz must be in \[0.01, 1000\], got 0"),
        ({"pace": "rate"}, "rate_hz must be given for pace 'rate'"),
    ],
)
def test_settings_are_checked(changes, message):
    with pytest.raises(ValueError, match=message):
        SourceSettings(**{"source": "x", **changes})
