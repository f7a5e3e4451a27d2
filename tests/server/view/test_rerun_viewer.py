"""Viewers: what lands in the file, and that a dead, frozen or late viewer never holds the tracker up."""

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from threading import Thread

import numpy as np
import pytest
from waiting import until

from semcast.common.camera import Intrinsics
from semcast.common.errors import ConfigError
from semcast.common.geometry import make_transform
from semcast.server.dense.cloud import DensePatch
from semcast.server.mapping.state import Marker
from semcast.server.settings import ServerSettings
from semcast.server.stream_identity import StreamIdentity
from semcast.server.view.frame_view import FrameView
from semcast.server.view.settings import ViewSettings

pytest.importorskip("rerun")

import rerun as rr

from semcast.server.view.feed import ViewerFeed, check_view, resolve_view
from semcast.server.view.file_stream import FileStream
from semcast.server.view.live_stream import MAX_REFUSALS, LiveStream
from semcast.server.view.picture import compress_picture
from semcast.server.view.process import ViewerProcess, is_listening, rerun_binary
from semcast.server.view.rerun_viewer import SERIES, RerunStream, blueprint
from semcast.server.view.scene import Cursor, Scene
from semcast.server.viewing import check_viewer, open_viewer

pytestmark = pytest.mark.xdist_group("real-time")

CAMERA = Intrinsics(fx=50.0, fy=50.0, cx=31.5, cy=23.5, width=64, height=48)
DEADLINE_S = 60.0


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def frame(k):
    rng = np.random.default_rng(k)
    return FrameView(
        frame_id=k,
        t_source_ns=k * 100_000_000,
        T_world_cam=make_transform(np.eye(3), (0.0, 0.0, 0.1 * k)),
        state="tracking",
        scalars={"link/psnr_db": 20.0 + k, "drops/stale": float(k // 3)},
        image=rng.integers(0, 255, (48, 64, 3), dtype=np.uint8),
        confidence=rng.random((48, 64), dtype=np.float32),
        keypoints_xy=rng.random((20, 2), dtype=np.float32) * 40,
        keypoint_inlier=rng.random(20) < 0.5,
    )


class Update:
    """What the reconstruction hands over, one landmark per frame."""

    def __init__(self, k, marker=None):
        self.marker = marker
        self.ids = np.array([k], np.int64)
        self.xyz = np.array([[0.0, 0.0, 5.0 + k]])
        self.rgb = np.full((1, 3), 200, np.uint8)
        self.confidence = np.full(1, 0.5, np.float32)
        self.removed = np.zeros(0, np.int64)
        self.keyframe_ids = np.array([k], np.int64)
        self.keyframe_poses = make_transform(np.eye(3), (0.0, 0.0, 0.1 * k))[None]
        self.frame_ids = np.zeros(0, np.int64)
        self.frame_poses = np.zeros((0, 4, 4))
        self.withdrawn = np.zeros(0, np.int64)


def rerun_output(*arguments):
    done = subprocess.run(
        [str(rerun_binary()), *arguments], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


class Proxy(ViewerProcess):
    """A real Rerun server without window or browser: takes the stream like a viewer does."""

    def _arguments(self):
        return [*self._command, "--bind", "127.0.0.1", "--port", str(self._port), "--serve-grpc"]


@pytest.fixture
def feed_and_proxy():
    port = free_port()
    process = Proxy("web", port, free_port(), "64MB")
    feed = ViewerFeed(ViewSettings(view="web", port=port), CAMERA, "test-live", process=process)
    yield feed, process, port
    feed.close()
    assert not is_listening(port)


def test_the_file_can_be_read_back_and_holds_everything(tmp_path):
    file = tmp_path / "run.rrd"
    feed = ViewerFeed(ViewSettings(view="file", image_rate_hz=60), CAMERA, "test-file", file=file)
    for k in range(5):
        points = DensePatch(
            k, np.ones((2, 3), np.float32), np.full((2, 3), 9, np.uint8), np.ones(2, np.float32)
        )
        feed.submit(frame(k), Update(k), [points] if k < 2 else [])
    feed.submit(None, Update(5, marker=Marker(np.eye(4)[:, :3], "1 unit of the map is 0.4 m")))
    feed.close()
    rerun_output("rrd", "verify", str(file))
    text = rerun_output("rrd", "print", "-vv", str(file))
    for entity in (
        "/world/camera/image",
        "/world/camera/image/keypoints",
        "/world/trajectory/0000",
        "/world/map_confidence/0000",
        "/world/map_colour/0000",
        "/world/dense/000000",
        "/world/dense/000001",
        "/world/marker",
        "/confidence",
        "/plots/link/psnr_db",
        "/plots/drops/stale",
        "/state",
    ):
        assert entity in text, entity
    states = rerun_output("rrd", "print", "-vvv", "--entity", "/state", str(file))
    for k in range(5):
        assert f"**tracking**, frame {k}" in states, k


def test_plot_values_go_out_together_and_none_is_lost(tmp_path):
    file = tmp_path / "run.rrd"
    stream = RerunStream(recording_id="plots", camera=CAMERA, has_truth=False, has_confidence=True, file=file)
    scene, cursor = Scene(None), Cursor()
    for k in range(10):
        scene.add_frame(frame(k).without_image())
        stream.write(scene.changes_since(cursor))
    assert stream.is_holding, "the last ones wait for more"
    assert stream.close()
    text = rerun_output("rrd", "print", "-vvv", "--entity", "/plots/link/psnr_db", str(file))
    assert re.findall(r"\[(2\d\.0)\]", text) == [f"{20 + k}.0" for k in range(10)]
    assert re.findall(r"with (\d+) rows? .*- \[?/?plots/link/psnr_db", text).count("4") == 2


def test_what_comes_behind_an_older_picture_is_of_the_newest_frame(tmp_path):
    file = tmp_path / "run.rrd"
    stream = RerunStream(recording_id="late", camera=CAMERA, has_truth=False, has_confidence=True, file=file)
    scene, cursor = Scene(None), Cursor()
    scene.set_picture(compress_picture(frame(3), 80))
    for k in (4, 5):
        scene.add_frame(frame(k).without_image())
    stream.write(scene.changes_since(cursor))
    # The last adjustment comes without a frame: a viewer that stands at frame 5 must show it.
    scene.set_marker(Marker(np.eye(4)[:, :3], "1 unit of the map is 0.4 m"))
    stream.write(scene.changes_since(cursor))
    assert stream.close()
    for entity, frame_id in (("/world/camera/image/keypoints", 3), ("/world/marker", 5)):
        text = rerun_output("rrd", "print", "-vvv", "--entity", entity, str(file))
        assert re.findall(r"row_\w+ +\S (\d+) ", text) == [str(frame_id)], entity


def test_plot_values_of_a_stream_that_rests_go_out_all_the_same(tmp_path):
    stream = RerunStream(
        recording_id="rest", camera=CAMERA, has_truth=False, has_confidence=True, file=tmp_path / "run.rrd"
    )
    scene, cursor = Scene(None), Cursor()
    scene.add_frame(frame(0).without_image())

    def is_out():
        stream.write(scene.changes_since(cursor))
        return not stream.is_holding

    until(is_out, "nothing waits")
    stream.close()


def test_the_state_has_a_place_of_its_own_above_the_images():
    for has_confidence, names in (
        (True, ["State", "Received image", "Confidence"]),
        (False, ["State", "Re"]),
    ):
        top, _ = blueprint(has_truth=False, has_confidence=has_confidence).root_container.contents
        _, right = top.contents
        assert len(right.contents) == len(names)
        assert all(view.name.startswith(name) for view, name in zip(right.contents, names, strict=True))


def test_a_plot_has_a_legend_where_it_has_several_curves():
    _, plots = blueprint(has_truth=True, has_confidence=True).root_container.contents
    assert len(plots.contents) == 5
    for plot in plots.contents:
        (is_shown,) = plot.properties["PlotLegend"].visible.as_arrow_array().to_pylist()
        num_curves = sum(path.startswith(plot.origin.removeprefix("/plots/") + "/") for path in SERIES)
        assert is_shown == (num_curves > 1 or plot.origin == "/plots/drops"), plot.name


def test_file_mode_without_a_folder_is_a_clear_error():
    with pytest.raises(ConfigError, match="--out"):
        ViewerFeed(ViewSettings(view="file"), CAMERA, "x")


@pytest.fixture
def no_display(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)


def test_auto_opens_a_window_only_where_there_is_a_display(monkeypatch, no_display):
    assert resolve_view("auto", has_folder=True) == "file"
    assert resolve_view("auto", has_folder=False) == "none"
    monkeypatch.setenv("DISPLAY", ":7")
    assert resolve_view("auto", has_folder=False) == "native"
    assert resolve_view("web", has_folder=False) == "web"


def test_a_window_without_a_display_is_refused_unless_a_viewer_is_open_elsewhere(monkeypatch, no_display):
    with socket.socket() as tunnel:
        tunnel.bind(("127.0.0.1", 0))
        settings = ViewSettings(view="native", port=tunnel.getsockname()[1])
        with pytest.raises(ConfigError, match="^no display: use --view web or --view file$"):
            check_view(settings, has_folder=True)
        tunnel.listen()
        check_view(settings, has_folder=True)
    monkeypatch.setenv("DISPLAY", ":7")
    check_view(settings, has_folder=True)


def test_a_page_on_the_port_of_another_program_is_refused():
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = other.getsockname()[1]
        settings = ServerSettings(view=ViewSettings(view="web", port=free_port(), web_port=taken))
        with pytest.raises(ConfigError, match=f"page can't be served on port {taken}, .* with --web-port"):
            check_viewer(settings)
        # Where a viewer is open already, the page is its own.
        with socket.create_server(("127.0.0.1", 0)) as viewer:
            check_viewer(replace(settings, view=replace(settings.view, port=viewer.getsockname()[1])))


def test_what_listens_and_is_no_viewer_is_left_alone(caplog, monkeypatch):
    rounds, serve = [], LiveStream.serve

    def counted(live, *, may_connect):
        rounds.append(may_connect)
        serve(live, may_connect=may_connect)

    monkeypatch.setattr(LiveStream, "serve", counted)

    class Quiet(BaseHTTPRequestHandler):
        def log_message(self, *_):
            pass

    with HTTPServer(("127.0.0.1", 0), Quiet) as other:
        Thread(target=other.serve_forever, daemon=True).start()
        feed = ViewerFeed(ViewSettings(view="web", port=other.server_port, web_port=free_port()), CAMERA, "r")
        feed.submit(frame(0))
        until(lambda: "is no viewer, nothing is shown" in caplog.text, "it is told")
        more = len(rounds) + 3
        until(lambda: len(rounds) >= more, "it is not tried again")
        feed.close()
        other.shutdown()
    assert feed.num_connections == MAX_REFUSALS


def test_a_killed_viewer_is_back_soon_and_gets_the_stream_again(feed_and_proxy):
    feed, process, _ = feed_and_proxy
    until(lambda: feed.num_connections == 1, "first connection")
    feed.submit(frame(0))
    first = process.pid
    os.kill(first, signal.SIGKILL)
    killed_s = time.monotonic()
    k = 1
    # What the killed one had started may listen for a moment longer.
    while feed.num_connections < 2 or process.pid in (first, None):
        feed.submit(frame(k))
        k += 1
        assert time.monotonic() - killed_s < DEADLINE_S
        time.sleep(0.02)


def test_a_frozen_viewer_never_holds_up_the_tracker(feed_and_proxy):
    feed, process, _ = feed_and_proxy
    until(lambda: feed.num_connections == 1, "first connection")
    os.kill(process.pid, signal.SIGSTOP)
    took_s = []
    for k in range(80):
        before = time.perf_counter()
        feed.submit(frame(k), Update(k))
        took_s.append(time.perf_counter() - before)
        time.sleep(0.01)
    # A full pipe to a frozen viewer would hold each one up; other processes hold up one or the other.
    assert np.percentile(took_s, 90) < 0.1
    closing_s = time.monotonic()
    feed.close()
    assert time.monotonic() - closing_s < 20.0
    assert process.pid is None


def test_a_viewer_opened_by_hand_later_gets_the_whole_scene(tmp_path):
    port, saved = free_port(), tmp_path / "late.rrd"

    class Absent(Proxy):
        def start(self):
            self._done = True

    feed = ViewerFeed(
        ViewSettings(view="web", port=port), CAMERA, "late", process=Absent("web", port, 1, "64MB")
    )
    feed.submit(frame(0), Update(0))
    late = subprocess.Popen(
        [str(rerun_binary()), "--bind", "127.0.0.1", "--port", str(port), "--save", str(saved)],
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        until(lambda: feed.num_connections == 1, "the late viewer")
        feed.submit(frame(1), Update(1))
        until(lambda: saved.exists() and b"map_confidence" in saved.read_bytes(), "scene at the viewer")
    finally:
        feed.close()
        assert late.poll() is None, "a viewer that is not ours was ended"
        os.killpg(late.pid, signal.SIGKILL)
        late.wait(10)


def test_a_viewer_shows_the_next_run_as_well(feed_and_proxy):
    feed, process, port = feed_and_proxy
    until(lambda: feed.num_connections == 1, "the viewer")
    feed.submit(frame(0), Update(0))
    child = process.pid
    assert feed.hand_over() is process
    following = ViewerFeed(ViewSettings(view="web", port=port), CAMERA, "test-next", process=process)
    until(lambda: following.num_connections == 1, "the viewer again")
    assert process.pid == child is not None
    os.killpg(child, signal.SIGKILL)
    until(lambda: process.pid not in (None, child), "a viewer that is still looked after")
    following.close()
    assert process.pid is None


def test_a_file_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "run.rrd").mkdir()
    with pytest.raises(ConfigError, match="run.rrd can't be written: .*Is a directory"):
        ViewerFeed(ViewSettings(view="file"), CAMERA, "x", file=tmp_path / "run.rrd")


def test_the_file_is_finished_when_the_viewer_cannot_start(tmp_path, monkeypatch):
    closed, close = [], FileStream.close

    def noted(stream):
        close(stream)
        closed.append(stream)

    monkeypatch.setattr(FileStream, "close", noted)
    port = free_port()
    absent = ViewerProcess("native", port, 1, "1GB", command=(str(tmp_path / "nowhere"),))
    settings = ViewSettings(view="native", port=port)
    with pytest.raises(ConfigError, match="the viewer can't be started"):
        ViewerFeed(settings, CAMERA, "x", file=tmp_path / "run.rrd", process=absent)
    assert len(closed) == 1
    rr.chunk.RrdReader(tmp_path / "run.rrd")  # warns of a file without its end


def test_a_viewer_that_cannot_start_is_given_up_with_its_last_words(caplog):
    script = "import sys; sys.exit('no display here')"
    process = ViewerProcess("native", free_port(), 1, "1GB", command=(sys.executable, "-c", script))
    process.start()
    with caplog.at_level("WARNING"):
        deadline = time.monotonic() + DEADLINE_S
        while "no display here" not in caplog.text and time.monotonic() < deadline:
            process.supervise()
            time.sleep(0.02)
    assert "no display here" in caplog.text
    process.close()


def test_a_window_the_user_closed_stays_closed():
    process = ViewerProcess("native", free_port(), 1, "1GB", command=(sys.executable, "-c", ""))
    process.start()
    until(lambda: process.supervise() or process.pid is None, "the end of the child")
    process.supervise()
    assert process.pid is None
    process.close()


@pytest.mark.parametrize(("num_frames", "footer"), [(3, True), (None, False), (100_000, False)])
def test_a_file_of_a_stream_without_end_collects_no_footer_in_memory(tmp_path, num_frames, footer):
    identity = StreamIdentity("a", 1, "cnn", "0" * 16, CAMERA, num_frames)
    feed = open_viewer(ServerSettings(out=tmp_path, view=ViewSettings(view="file")), identity, None)
    feed.submit(frame(0))
    feed.close()
    expected = contextlib.nullcontext() if footer else pytest.warns(match="no footer")
    with expected:
        rr.chunk.RrdReader(tmp_path / "run.rrd")


def test_a_window_is_left_open_for_the_user_when_asked():
    sleeper = (sys.executable, "-c", "import time; time.sleep(60)")
    for leave, expected in ((True, None), (False, -signal.SIGTERM)):
        port = free_port()
        process = ViewerProcess("native", port, 1, "1GB", command=sleeper)
        feed = ViewerFeed(ViewSettings(view="native", port=port), CAMERA, "left", process=process)
        child = process._child
        feed.close(leave_window=leave)
        child.returncode = None
        if expected is None:
            assert child.poll() is None
            os.killpg(child.pid, signal.SIGKILL)
            child.wait(10)
        else:
            assert not is_listening(port)
            with pytest.raises(ProcessLookupError):
                os.kill(child.pid, 0)
            child.returncode = expected


def test_closing_takes_the_whole_process_group():
    script = "import subprocess,sys,time;print(subprocess.Popen(['sleep','60']).pid);time.sleep(60)"
    process = ViewerProcess("native", free_port(), 1, "1GB", command=(sys.executable, "-c", script))
    process.start()
    group = process.pid
    process.close()

    def gone():
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        return False

    until(gone, "end of the group")
    process.close()
