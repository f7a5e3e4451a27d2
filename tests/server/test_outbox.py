"""What is published reaches who is slow: all of the map, and the newest poses."""

import threading
from types import SimpleNamespace

import numpy as np
from waiting import until

from semcast.common.map_mirror import _EMPTY
from semcast.common.messages import MapMessage, PoseMessage
from semcast.common.metrics import Metrics
from semcast.common.wire import unpack
from semcast.server.mapping.state import FrameResult, MapUpdate, TrackingState
from semcast.server.outbox import CAPACITY, Outbox, map_message, merged

AGENT = "cam0"
ARRIVAL = SimpleNamespace(message=SimpleNamespace(agent_epoch=5))


class SlowSession:
    """Publishers that hold the first message until they may go on."""

    def __init__(self):
        self.sent: list[bytes] = []
        self.holding, self.may_go_on = threading.Event(), threading.Event()

    def publisher(self, key, service):
        return self

    def put(self, payload):
        self.holding.set()
        assert self.may_go_on.wait(30.0)
        self.sent.append(payload)


def some_change(rng, map_epoch):
    ids = rng.choice(40, size=rng.integers(0, 6), replace=False)
    keyframe_ids = rng.choice(9, size=rng.integers(0, 3), replace=False)
    return MapUpdate(
        map_epoch=map_epoch,
        ids=ids,
        xyz=rng.normal(size=(len(ids), 3)),
        rgb=rng.integers(0, 256, (len(ids), 3), dtype=np.uint8),
        confidence=rng.random(len(ids)).astype(np.float32),
        removed=np.setdiff1d(rng.choice(40, size=3, replace=False), ids),
        keyframe_ids=keyframe_ids,
        keyframe_poses=rng.normal(size=(len(keyframe_ids), 4, 4)),
        frame_ids=np.zeros(0, np.int64),
        frame_poses=np.zeros((0, 4, 4)),
        withdrawn=np.zeros(0, np.int64),
    )


def test_a_slow_subscriber_misses_nothing_of_the_map(rng):
    for map_epochs in ((0,), (0, 1)):
        updates = [some_change(rng, e) for e in map_epochs for _ in range(CAPACITY + 50)]
        session, metrics = SlowSession(), Metrics("server")
        outbox = Outbox(session, AGENT, metrics)
        outbox.put_map(ARRIVAL.message.agent_epoch, updates[0])
        assert session.holding.wait(30.0)
        for update in updates[1:]:
            outbox.put_map(ARRIVAL.message.agent_epoch, update)
        session.may_go_on.set()
        outbox.close()
        expected = found = _EMPTY
        for update in updates:
            expected = expected.updated(map_message(5, update))
        for payload in session.sent:
            found = found.updated(unpack(payload, MapMessage))
        assert len(expected.ids) > 10
        for name in ("map_epoch", "ids", "xyz", "rgb", "confidence", "keyframe_ids", "keyframe_poses"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
        assert len(session.sent) == 2, "what waits is sent as one"
        assert not metrics.drops


def test_what_can_not_be_sent_costs_itself_alone(rng, monkeypatch):
    session, metrics = SlowSession(), Metrics("server")
    session.may_go_on.set()
    outbox = Outbox(session, AGENT, metrics)
    with monkeypatch.context() as patch:
        patch.setattr("semcast.server.outbox.pack", lambda message: 1 / 0)
        outbox.put_map(5, some_change(rng, 0))
        until(lambda: metrics.drops)
    outbox.put_map(5, some_change(rng, 0))
    outbox.close()
    assert len(session.sent) == 1
    assert metrics.drops == {"unsent": 1}
    assert metrics.status(5).last_error == "sending what was found failed: division by zero"


def arrival(frame_id, epoch=5):
    return SimpleNamespace(message=SimpleNamespace(agent_epoch=epoch, t_capture_ns=1000 + frame_id))


def result(frame_id, backfilled=(), **changes):
    values = {
        "frame_id": frame_id,
        "t_source_ns": 10 * frame_id,
        "state": TrackingState.TRACKING,
        "T_world_cam": np.eye(4) * 2,
        "num_tracked": 9,
        "num_inliers": 7,
        "reprojection_error_px": 0.5,
        "covariance": np.eye(6),
        "is_keyframe": False,
        "map_epoch": 3,
        "submap": 1,
        "keypoints_xy": np.zeros((0, 2), np.float32),
        "keypoint_inlier": np.zeros(0, bool),
        "backfilled": tuple((k, 10 * k, np.eye(4) * k) for k in backfilled),
        "stage_ms": {},
    }
    return FrameResult(**{**values, **changes})


def poses_of(*frames):
    """What is sent of frames, each with what became of it."""
    session = SlowSession()
    session.may_go_on.set()
    outbox = Outbox(session, AGENT, Metrics("server"))
    for arrived, found in frames:
        outbox.put_pose(arrived, found)
    outbox.close()
    return [unpack(payload, PoseMessage) for payload in session.sent]


def test_poses_that_were_found_late_go_before_the_frame_that_found_them():
    lost = result(1, T_world_cam=None, covariance=None, num_inliers=0, state=TrackingState.INITIALIZING)
    # Of frame 9 nothing came; frame 2 came in another start of the agent.
    sent = poses_of((arrival(2, epoch=4), lost), (arrival(1), lost), (arrival(3), result(3, (1, 2, 9))))
    assert [(p.agent_epoch, p.frame_id) for p in sent] == [(4, 1), (5, 1), (5, 1), (5, 3)]
    _, none_yet, late, own = sent
    assert none_yet.T_world_cam is none_yet.covariance is None
    assert (late.T_world_cam, own.T_world_cam) == (tuple(np.eye(4).ravel()), tuple(2 * np.eye(4).ravel()))
    assert (late.t_capture_ns, late.t_source_ns) == (1001, 10)
    assert (late.num_inliers, late.covariance, late.map_epoch, late.submap) == (0, None, 3, 1)
    assert (own.t_capture_ns, own.t_source_ns, own.num_inliers) == (1003, 30, 7)
    assert own.covariance == tuple(np.eye(6).ravel())
    assert (own.map_epoch, own.submap, late.state, own.state) == (3, 1, "tracking", "tracking")


def test_a_covariance_that_is_no_number_is_left_out():
    (sent,) = poses_of((arrival(3), result(3, covariance=np.diag([1.0, 1, 1, 1, 1, np.inf]))))
    assert sent.covariance is None
    assert sent.T_world_cam is not None


def test_of_a_long_stream_the_newest_capture_times_are_known():
    frames = [(arrival(k), result(k)) for k in range(CAPACITY)]
    sent = poses_of(*frames, (arrival(CAPACITY), result(CAPACITY, (0,))))
    assert [p.frame_id for p in sent[-2:]] == [CAPACITY - 1, CAPACITY]
    late, _ = poses_of(*frames, (arrival(CAPACITY), result(CAPACITY, (1,))))[-2:]
    assert (late.frame_id, late.t_capture_ns) == (1, 1001)


def change(ids, removed=(), keyframes=(), map_epoch=0, at=0.0):
    count = len(ids)
    return MapMessage(
        agent_epoch=5,
        map_epoch=map_epoch,
        ids=np.array(ids, np.int64),
        xyz=np.full((count, 3), at, np.float32),
        rgb=np.zeros((count, 3), np.uint8),
        confidence=np.ones(count, np.float32),
        removed=np.array(removed, np.int64),
        keyframe_ids=np.array(keyframes, np.int64),
        keyframe_poses=np.tile(np.eye(4), (len(keyframes), 1, 1)),
    )


def test_two_changes_are_one_and_of_another_map_only_the_later_counts():
    earlier = change([1, 2, 3], removed=[8, 9], keyframes=[0, 4], at=1.0)
    one = merged(earlier, change([2, 9], removed=[3], keyframes=[4, 6], at=2.0))
    assert dict(zip(one.ids.tolist(), one.xyz[:, 0].tolist(), strict=True)) == {1: 1.0, 2: 2.0, 9: 2.0}
    assert one.removed.tolist() == [3, 8]
    assert one.keyframe_ids.tolist() == [0, 4, 6]
    later = change([5], map_epoch=1)
    assert merged(earlier, later) is later
