"""What is submitted comes into the scene, all of it and in order, whatever fails on the way."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest
from waiting import until

from semcast.common.camera import Intrinsics
from semcast.common.geometry import make_transform
from semcast.server.mapping.state import MapUpdate
from semcast.server.settings import ViewSettings
from semcast.server.view.frame_view import FrameView
from semcast.server.view.scene import Cursor

pytest.importorskip("rerun")

from semcast.server.view import feed as feed_module
from semcast.server.view import live_stream
from semcast.server.view.feed import ViewerFeed
from semcast.server.view.rerun_viewer import Delivery

CAMERA = Intrinsics(fx=50.0, fy=50.0, cx=31.5, cy=23.5, width=64, height=48)


def frame(k):
    none = np.zeros((0, 2), np.float32)
    T_world_cam = make_transform(np.eye(3), (0.1 * k, 0.0, 0.0))
    return FrameView(k, k, T_world_cam, "tracking", {}, None, None, none, np.zeros(0, bool))


def update(k):
    """Landmark ``k`` is new, and keyframe 0 moves."""
    return MapUpdate(
        map_epoch=0,
        ids=np.array([k]),
        xyz=np.full((1, 3), float(k)),
        rgb=np.zeros((1, 3), np.uint8),
        confidence=np.ones(1, np.float32),
        removed=np.zeros(0, np.int64),
        keyframe_ids=np.array([0]),
        keyframe_poses=make_transform(np.eye(3), (0.0, 0.01 * k, 0.0))[None],
        frame_ids=np.zeros(0, np.int64),
        frame_poses=np.zeros((0, 4, 4)),
        withdrawn=np.zeros(0, np.int64),
    )


@pytest.fixture
def held(monkeypatch):
    """A feed for which five updates are many, and whose scene thread waits until it may go on."""
    monkeypatch.setattr(feed_module, "MAX_PENDING", 5)
    may_go_on, take = threading.Event(), ViewerFeed._take_pending

    def wait_and_take(self, force):
        assert may_go_on.wait(30)
        take(self, force)

    monkeypatch.setattr(ViewerFeed, "_take_pending", wait_and_take)
    feed = ViewerFeed(ViewSettings(view="none"), CAMERA, "held")
    yield feed, may_go_on
    may_go_on.set()
    feed.close()


def seen(feed):
    """Return frames, landmarks and path that a viewer would be shown now."""
    changes = feed.changes_since(Cursor())
    path = np.concatenate([strip for strips in changes.segments.values() for strip in strips])
    points = np.concatenate([np.zeros((0, 3)), *(chunk.xyz for chunk in changes.chunks)])
    return [row.frame_id for row in changes.rows], sorted(points[:, 0].tolist()), path


def test_a_scene_that_is_far_behind_misses_nothing(held):
    feed, may_go_on = held
    for k in range(40):
        feed.submit(frame(k), update(k))
    assert len(feed._pending) <= 5
    may_go_on.set()
    feed.close()
    in_time = ViewerFeed(ViewSettings(view="none"), CAMERA, "in time")
    for k in range(40):
        in_time.submit(frame(k), update(k))
    in_time.close()
    frames, landmarks, path = seen(feed)
    assert frames == list(range(40))
    assert landmarks == list(range(40))
    np.testing.assert_array_equal(path, seen(in_time)[2])


def test_an_update_that_makes_no_sense_costs_itself_alone(held, caplog):
    feed, may_go_on = held
    for k in range(4):
        feed.submit(frame(k), SimpleNamespace() if k == 1 else update(k))
    may_go_on.set()
    feed.close()
    assert seen(feed)[:2] == ([0, 2, 3], [0.0, 2.0, 3.0])
    assert caplog.text.count("bringing an update into the scene failed: ") == 1


class Viewer:
    """A viewer that fails at the first change, and all streams to it."""

    kind, url, is_holding = "web", None, False
    opened = 0

    def __init__(self):
        self.rows = []

    def start(self):
        pass

    def supervise(self):
        raise RuntimeError("lost sight of it")

    def open(self, file):
        self.opened += 1
        return self

    def write(self, changes):
        if self.opened == 1:
            raise RuntimeError("no such entity")
        self.rows += [row.frame_id for row in changes.rows]

    def flush(self, timeout_s):
        return Delivery.DONE

    def close(self):
        return True


def test_a_viewer_that_fails_is_connected_to_anew_and_gets_everything(monkeypatch, caplog):
    viewer = Viewer()
    monkeypatch.setattr(live_stream, "is_listening", lambda port: True)
    monkeypatch.setattr(ViewerFeed, "_open_stream", lambda self, file: viewer.open(file))
    feed = ViewerFeed(ViewSettings(view="web", image_rate_hz=60), CAMERA, "anew", process=viewer)
    feed.submit(frame(0), update(0))
    until(lambda: viewer.rows)
    feed.submit(frame(1), update(1))
    feed.close()
    assert viewer.rows == [0, 1]
    assert feed.num_connections == 2
    assert caplog.text.count("showing the run failed: no such entity") == 1
    assert caplog.text.count("looking after the viewer failed: lost sight of it") == 1
