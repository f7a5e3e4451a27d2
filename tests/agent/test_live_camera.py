import functools
import http.server
import threading
import time
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from semcast.agent.source import open_source
from semcast.agent.source_settings import SourceSettings
from semcast.common.camera_settings import CameraSettings
from semcast.common.errors import SourceError

pytestmark = pytest.mark.xdist_group("real-time")

PINHOLE = CameraSettings(fx=50.0, fy=50.0, cx=31.5, cy=23.5)


class Camera:
    """A network camera: motion JPEG over HTTP on loopback, which hangs up after some frames.

    Of those the first ``at_once`` come without delay, the others ``interval_s`` apart.
    """

    def __init__(self, frames_per_connection, at_once=1, interval_s=0.0):
        self.jpegs = [
            cv2.imencode(".jpg", np.full((48, 64, 3), 6 * k, np.uint8))[1].tobytes() for k in range(40)
        ]
        self.connections = 0
        camera = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self):
                camera.connections += 1
                jpegs = camera.jpegs
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                try:
                    parts = [
                        b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(jpeg)
                        + jpeg
                        + b"\r\n"
                        for jpeg in jpegs
                    ]
                    self.wfile.write(b"".join(parts[k % len(parts)] for k in range(at_once)))
                    for k in range(at_once, frames_per_connection):
                        time.sleep(interval_s)
                        self.wfile.write(parts[k % len(parts)])
                except OSError:
                    pass

            def log_message(self, *args):
                pass

        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self._server.server_port}/stream.mjpg"
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()

    def close(self):
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


@pytest.fixture
def make_camera():
    opened = []

    def make(*args):
        opened.append(Camera(*args))
        return opened[-1]

    yield make
    for one in opened:
        one.close()


@pytest.fixture
def camera(make_camera):
    return make_camera(60, 60)


def test_a_network_camera_is_read_and_found_again_when_it_hangs_up(camera, caplog):
    source = open_source(SourceSettings(source=camera.address, camera=PINHOLE, max_frames=70))
    stop = threading.Event()
    frames = list(source.frames(stop))
    source.close()
    assert len(frames) == 70
    assert camera.connections >= 2
    assert "gives no images any more" in caplog.text
    assert np.all(np.diff([f.frame_id for f in frames]) == 1)
    assert np.all(np.diff([f.t_capture_ns for f in frames]) > 0)
    assert all(f.t_source_ns == f.t_capture_ns for f in frames)
    assert [f.final for f in frames] == [False] * 69 + [True]
    assert frames[0].image.shape == (48, 64, 3)


def test_a_camera_that_comes_back_with_another_size_is_said_once_and_waited_for(camera, caplog, monkeypatch):
    monkeypatch.setattr("semcast.agent.video._REOPEN_AFTER_S", 0.01)
    caplog.set_level("INFO", "semcast")
    source = open_source(SourceSettings(source=camera.address, camera=PINHOLE, max_frames=90))
    frames, usual = [], camera.jpegs
    turned = [cv2.imencode(".jpg", np.zeros((64, 48, 3), np.uint8))[1].tobytes()]
    for frame in source.frames(threading.Event()):
        frames.append(frame)
        if len(frames) == 20:
            camera.jpegs = turned  # from the next connection on

            def turn_back(wanted=camera.connections + 4):
                while camera.connections < wanted:
                    time.sleep(0.01)
                camera.jpegs = usual

            threading.Thread(target=turn_back).start()
    source.close()
    assert len(frames) == 90
    assert all(frame.image.shape == (48, 64, 3) for frame in frames)
    said = [r.message.partition(" ")[2] for r in caplog.records if "gives" in r.message]
    assert said.count("gives 48x64 images, must give 64x48 as at its start, or start anew, trying again") == 1
    assert said[-1] == "gives images again"


class Driver:
    """What OpenCV makes of a webcam that is unplugged after five images."""

    def __init__(self, number):
        self.settings, self.left, self.number, self.is_released = {}, 5, number, False

    def isOpened(self):
        return True

    def set(self, what, value):
        self.settings[what] = value

    def get(self, what):
        return 0.0

    def grab(self):
        return False

    def read(self):
        self.left -= 1
        return self.left >= 0, np.zeros((48, 64, 3), np.uint8)

    def release(self):
        self.is_released = True


def test_a_camera_that_is_plugged_in_again_has_no_queue_that_makes_frames_old_either(monkeypatch):
    monkeypatch.setattr("semcast.agent.video._REOPEN_AFTER_S", 0.01)
    opened = []
    monkeypatch.setattr(cv2, "VideoCapture", lambda number: opened.append(Driver(number)) or opened[-1])
    source = open_source(SourceSettings(source="99", camera=PINHOLE, max_frames=8))
    assert len(list(source.frames(threading.Event()))) == 8
    assert [driver.settings for driver in opened] == 2 * [{cv2.CAP_PROP_BUFFERSIZE: 1}]
    assert [driver.number for driver in opened] == [99, 99], "OpenCV takes a text for a file"
    source.close()
    assert all(driver.is_released for driver in opened)


def test_a_rate_that_a_camera_has_no_whole_part_of_is_kept_on_the_whole(monkeypatch):
    """Thirty images a second, of which twenty are wanted."""
    clock = SimpleNamespace(ns=10**9)

    class Ticking(Driver):
        def read(self):
            clock.ns += 10**9 // 30
            return True, np.zeros((48, 64, 3), np.uint8)

    now = SimpleNamespace(monotonic=lambda: clock.ns * 1e-9, monotonic_ns=lambda: clock.ns)
    monkeypatch.setattr("semcast.agent.video.time", now)
    monkeypatch.setattr(cv2, "VideoCapture", Ticking)
    settings = SourceSettings(source="99", camera=PINHOLE, max_frames=41, pace="rate", rate_hz=20.0)
    times_ns = [frame.t_capture_ns for frame in open_source(settings).frames(threading.Event())]
    assert 40 / ((times_ns[-1] - times_ns[0]) * 1e-9) == pytest.approx(20.0, rel=0.03)


@pytest.mark.parametrize(
    ("given_hz", "wanted_hz", "one_in"), [(29.97, 30.0, 1), (30.0, 15.0, 2), (30.0, 10.0, 3)]
)
def test_a_camera_that_is_not_steady_gives_images_as_regularly_as_it_can(
    monkeypatch, given_hz, wanted_hz, one_in
):
    rng, clock = np.random.default_rng(0), SimpleNamespace(ns=10**9, count=0)

    class Unsteady(Driver):
        def read(self):
            clock.count += 1
            clock.ns = 10**9 + round((clock.count / given_hz + rng.uniform(0.0, 0.002)) * 1e9)
            return True, np.zeros((48, 64, 3), np.uint8)

    now = SimpleNamespace(monotonic=lambda: clock.ns * 1e-9, monotonic_ns=lambda: clock.ns)
    monkeypatch.setattr("semcast.agent.video.time", now)
    monkeypatch.setattr(cv2, "VideoCapture", Unsteady)
    settings = SourceSettings(source="99", camera=PINHOLE, max_frames=400, pace="rate", rate_hz=wanted_hz)
    frames = list(open_source(settings).frames(threading.Event()))
    assert set(np.diff([frame.frame_id for frame in frames])) == {one_in}


def test_images_that_waited_before_the_start_are_thrown_away(make_camera):
    camera = make_camera(40, 8, 0.1)
    source = open_source(SourceSettings(source=camera.address, camera=PINHOLE, max_frames=1))
    (frame,) = source.frames(threading.Event())
    source.close()
    assert round(frame.image.mean() / 6) >= 8  # the eight before came at once


def test_a_camera_is_slowed_down_and_nothing_is_made_up_for(make_camera):
    settings = SourceSettings(
        source=make_camera(400, 4, 0.005).address, camera=PINHOLE, max_frames=8, pace="rate", rate_hz=20.0
    )
    source = open_source(settings)
    times_s = []
    for frame in source.frames(threading.Event()):
        times_s.append(frame.t_capture_ns * 1e-9)
        time.sleep(0.3 if len(times_s) == 4 else 0.0)
    source.close()
    assert source.rate_hz == 20.0
    gaps_s = np.diff(times_s)
    assert gaps_s[3] > 0.3
    assert gaps_s.min() > 0.015, "images that had waited would come 0.005 apart"
    assert np.median(np.delete(gaps_s, 3)) == pytest.approx(0.05, abs=0.03)


def test_a_camera_that_is_not_there_is_said(make_camera):
    camera = make_camera(1)
    address = camera.address.replace("http://", "http://user:secret@").replace("/stream.mjpg", "/x")
    camera.close()
    with pytest.raises(SourceError) as caught:
        open_source(SourceSettings(source=address, camera=PINHOLE))
    assert "can't be opened: no stream came from there" in str(caught.value)
    assert "secret" not in str(caught.value)


class Folder(http.server.SimpleHTTPRequestHandler):
    """Files of a folder, from front to back."""

    def log_message(self, *args):
        pass


def test_a_video_whose_index_is_at_its_end_is_no_camera(tmp_path):
    writer = cv2.VideoWriter(str(tmp_path / "a.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (320, 240))
    for k in range(30):
        writer.write(np.random.default_rng(k).integers(0, 256, (240, 320, 3), dtype=np.uint8))
    writer.release()
    handler = functools.partial(Folder, directory=tmp_path)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            address = f"http://127.0.0.1:{server.server_port}/a.mp4"
            with pytest.raises(SourceError, match=r"a.mp4 gives no images: .* its index at its beginning"):
                open_source(SourceSettings(source=address, camera=PINHOLE))
        finally:
            server.shutdown()
            thread.join()
