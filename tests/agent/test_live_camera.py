import http.server
import threading

import cv2
import numpy as np
import pytest

from semcast.agent.source import open_source
from semcast.agent.source_settings import SourceSettings
from semcast.common.camera_settings import CameraSettings
from semcast.common.errors import SourceError

PINHOLE = CameraSettings(fx=50.0, fy=50.0, cx=31.5, cy=23.5)


class Camera:
    """A network camera: motion JPEG over HTTP on loopback, which hangs up after some frames."""

    def __init__(self, frames_per_connection):
        jpegs = [
            cv2.imencode(".jpg", np.full((48, 64, 3), 20 * k % 255, np.uint8))[1].tobytes() for k in range(12)
        ]
        self.connections = 0
        camera = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self):
                camera.connections += 1
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                try:
                    for k in range(frames_per_connection):
                        jpeg = jpegs[k % len(jpegs)]
                        self.wfile.write(
                            b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(jpeg)
                            + jpeg
                            + b"\r\n"
                        )
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
def camera():
    opened = Camera(frames_per_connection=60)
    yield opened
    opened.close()


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
    assert source.groundtruth() is None


def test_a_camera_that_is_not_there_is_said(camera):
    address = camera.address.replace("http://", "http://user:secret@").replace("/stream.mjpg", "/x")
    camera.close()
    with pytest.raises(SourceError) as caught:
        open_source(SourceSettings(source=address, camera=PINHOLE))
    assert "can't be opened" in str(caught.value)
    assert "secret" not in str(caught.value)
