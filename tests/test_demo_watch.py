"""What a demo sees of its processes while they run, and what it tells."""

import json
import sys
import threading

import pytest

from semcast import demo_watch
from semcast.common.metrics import Metrics
from semcast.common.role import Role
from semcast.common.wire import pack
from semcast.demo_watch import Alive, watch

pytestmark = pytest.mark.xdist_group("real-time")


def test_what_a_role_warns_of_is_told_once_and_nothing_else(tmp_path):
    child = Role("server", [], tmp_path / "log")
    child.log.write_text(
        "2026-03-01T11:58:03 INFO    semcast.server.session: frame 4: a map has begun\n"
        "2026-03-01T11:58:04 WARNING semcast.server.mapping.readout_watch: the focal length seems too short\n"
        "2026-03-01T11:58:05 WARNING semcast.server.session: 1 frames tracked, 0 with a pose\n"
        "2026-03-01T11:58:06 WARNING semcast.server.mapping.readout_watch: the focal length seems too short\n"
    )
    assert child.warnings() == ["the focal length seems too short", "1 frames tracked, 0 with a pose"]


@pytest.mark.parametrize(
    ("role", "says", "ends"),
    [
        ("server", "semcast server: no space left", True),
        ("channel", "semcast channel: no trace", True),
        ("server", 3, False),
        ("server", 0, False),
        ("channel", 0, False),
        ("agent", 0, False),
    ],
)
def test_a_role_that_gives_up_ends_the_demo_and_one_that_is_stopped_does_not(tmp_path, role, says, ends):
    child = Role(role, [sys.executable, "-c", f"import sys; sys.exit({says!r})"], tmp_path / "log")
    child.start()
    stop, told = threading.Event(), []

    def tell(line):
        told.append(line)
        stop.set()

    alive = Alive(set(), threading.Condition())
    error = watch(tmp_path, {"server": child}, alive, stop, tell, lambda *row: None)
    assert error == (f"the {role} gave up: {says}" if ends else None)
    assert ["start it again with" in line for line in told] == ([] if ends else [True])


def test_an_agent_that_has_sent_all_is_not_to_be_started_again(tmp_path, monkeypatch):
    monkeypatch.setattr(demo_watch, "_GRACE_S", 0.0)
    child = Role("agent", [sys.executable, "-c", ""], tmp_path / "log")
    child.start()
    child.wait()
    alive, metrics, stop = Alive(set(), threading.Condition()), Metrics("agent"), threading.Event()
    metrics.end()
    alive.on_status(pack(metrics.status(1)))
    looks, told = [], []

    class Server(Role):
        @property
        def returncode(self):
            looks.append(self.name)
            if len(looks) == 5:
                stop.set()

    children = {"agent": child, "server": Server("server", [], tmp_path / "server.log")}
    assert watch(tmp_path, children, alive, stop, told.append, print) is None
    assert (len(looks), told) == (5, [])


def test_the_status_line_says_what_the_server_is_at_after_the_last_frame(tmp_path):
    rows, stop = [], threading.Event()
    line = {"frame_id": 49, "state": "tracking", "num_inliers": 120, "psnr_db": None}
    (tmp_path / "frames.jsonl").write_text(json.dumps(line) + "\n")
    alive = Alive(set(), threading.Condition())
    metrics = Metrics("server")
    notes = ["last adjustment of 9 keyframes", "depth 3 of 9 keyframes"]

    def progress(done, text):
        rows.append((done, text))
        if not notes:
            stop.set()
            return
        metrics.be_at(notes.pop(0))
        alive.on_status(pack(metrics.status(1)))

    child = Role("server", [], tmp_path / "log")
    child.log.touch()
    watch(tmp_path, {"server": child}, alive, stop, lambda line: None, progress)
    assert rows == [
        (50, "tracking      120 inliers"),
        (50, "last adjustment of 9 keyframes"),
        (50, "depth 3 of 9 keyframes"),
    ]


def test_the_page_of_the_viewer_is_told_once_from_what_the_log_of_the_server_gains(tmp_path, monkeypatch):
    child, stop, told = Role("server", [], tmp_path / "log"), threading.Event(), []
    child.log.write_text("11:58:03 INFO    semcast.server.viewing: viewer: http://127.0.0.1:90")
    alive = Alive(set(), threading.Condition())
    logs = ["90/?url=a\nviewer: http://127.0.0.1:1/\n", "read once: viewer: http://127.0.0.1:2/\n", "x\n"]
    reads, take = [], demo_watch._NewLines.take

    def taken(lines):
        found = take(lines)
        if lines._path == child.log:
            reads.extend(found)
            if not logs:
                stop.set()
            else:
                with child.log.open("a") as log:
                    log.write(logs.pop(0))
        return found

    monkeypatch.setattr(demo_watch._NewLines, "take", taken)
    watch(tmp_path, {"server": child}, alive, stop, told.append, lambda *row: None)
    assert told == ["open http://127.0.0.1:9090/?url=a"]
    assert reads == child.log.read_text().splitlines()
