import threading
from dataclasses import replace

import numpy as np
import pytest
from waiting import until

from semcast.common.geometry import exp_so3, make_transform, transform_points
from semcast.common.keys import map_key
from semcast.common.map_mirror import _EMPTY, MapMirror
from semcast.common.messages import MapMessage, MetricPose
from semcast.common.network_settings import NetworkSettings
from semcast.common.transport import open_client
from semcast.common.wire import pack

AGENT = "cam0"


def message(ids, *, removed=(), keyframes=(), offset=0.0, agent_epoch=7, map_epoch=0):
    count = len(ids)
    return MapMessage(
        agent_epoch=agent_epoch,
        map_epoch=map_epoch,
        ids=np.array(ids, np.int64),
        xyz=(np.array(ids, np.float32)[:, None] + offset) * np.ones((1, 3), np.float32),
        rgb=np.full((count, 3), 9, np.uint8),
        confidence=np.full(count, 0.5, np.float32),
        removed=np.array(removed, np.int64),
        keyframe_ids=np.array(keyframes, np.int64),
        keyframe_poses=np.array([np.eye(4) * (k + offset) for k in keyframes]).reshape(-1, 4, 4),
    )


@pytest.fixture
def client(hub):
    with open_client(NetworkSettings(connect=(hub[1],)), 60) as session:
        yield session


class Serving:
    """A server's side of the map."""

    def __init__(self, session, whole):
        self.whole = whole
        session.answer(map_key(AGENT), lambda _: None if self.whole is None else pack(self.whole))
        self.publisher = session.publisher(map_key(AGENT), "every")

    def put(self, change):
        self.publisher.put(pack(change))


def test_landmarks_and_keyframes_are_added_moved_and_removed(hub, client):
    serving = Serving(hub[0], message([1, 5, 9], keyframes=[0, 10]))
    mirror = MapMirror(client, AGENT)
    before = mirror.map
    assert before.ids.tolist() == [1, 5, 9]
    serving.put(message([3, 5], removed=[9, 77], keyframes=[10, 20], offset=0.25))
    until(lambda: mirror.map is not before)
    now = mirror.map
    assert (now.ids.tolist(), now.keyframe_ids.tolist()) == ([1, 3, 5], [0, 10, 20])
    assert now.xyz[:, 0].tolist() == [1.0, 3.25, 5.25]
    assert now.keyframe_poses[:, 0, 0].tolist() == [0.0, 10.25, 20.25]
    assert before.ids.tolist() == [1, 5, 9], "a map once taken stays as it was"


def test_changes_that_come_before_the_answer_are_the_last_word(hub, client):
    """Of landmark 5 the answer knows nothing yet; 9 was removed before the answer was made."""
    serving, arrived = Serving(hub[0], None), []
    client.subscribe(map_key("late"), "every", arrived.append)

    def late(_):
        serving.put(message([9]))
        serving.put(message([5], removed=[9]))
        # Answers and changes take different ways: these are there before the answer is.
        until(lambda: len(arrived) == 2)
        return pack(message([1, 2]))

    hub[0].answer(map_key("late"), late)
    serving.publisher = hub[0].publisher(map_key("late"), "every")
    mirror = MapMirror(client, "late")
    until(lambda: mirror.map.ids.tolist() == [1, 2, 5])


def test_a_new_map_replaces_the_one_before(hub, client):
    serving = Serving(hub[0], message([1, 2], keyframes=[0]))
    mirror = MapMirror(client, AGENT)
    for change in (message([4], map_epoch=1), message([6], agent_epoch=3)):
        serving.whole = change
        serving.put(change)
        until(lambda ids=change.ids: np.array_equal(mirror.map.ids, ids))
        assert len(mirror.map.keyframe_ids) == 0


def test_a_server_that_was_away_is_asked_again(hub, client, caplog):
    serving = Serving(hub[0], None)
    mirror = MapMirror(client, AGENT)
    assert len(mirror.map.ids) == 0
    serving.whole = message([1, 2])
    with open_client(NetworkSettings(connect=(hub[1],)), 60) as server:
        server.declare_alive(AGENT, "server")
        until(lambda: mirror.map.ids.tolist() == [1, 2])
    serving.whole = message([1, 8])
    with open_client(NetworkSettings(connect=(hub[1],)), 60) as server:
        server.declare_alive(AGENT, "server")
        until(lambda: mirror.map.ids.tolist() == [1, 8])
    serving.publisher.put(b"\x93garbage")
    until(lambda: "a map message can't be read" in caplog.text)
    assert mirror.map.ids.tolist() == [1, 8]


def test_nothing_is_left_of_a_former_server_whose_successor_had_no_map_at_first(hub, client):
    serving = Serving(hub[0], message([1, 8], keyframes=[0, 10]))
    with open_client(NetworkSettings(connect=(hub[1],)), 60) as server:
        server.declare_alive(AGENT, "server")
        mirror = MapMirror(client, AGENT)
        assert mirror.map.ids.tolist() == [1, 8]
    until(lambda: mirror._is_behind)
    asked = []
    serving.whole = None
    hub[0].answer(map_key(AGENT), lambda _: asked.append(1))
    with open_client(NetworkSettings(connect=(hub[1],)), 60) as server:
        server.declare_alive(AGENT, "server")
        until(lambda: asked)
        # It restored a map of before 8 and keyframe 10, takes up the stream and says what it has.
        serving.whole = message([1, 2], keyframes=[0])
        serving.put(serving.whole)
        until(lambda: mirror.map.ids.tolist() == [1, 2])
        assert mirror.map.keyframe_ids.tolist() == [0]
        serving.put(message([3]))
        until(lambda: mirror.map.ids.tolist() == [1, 2, 3])


class ScriptedSession:
    """Does something of a test's while an answer is on its way."""

    def __init__(self):
        self.whole, self.on_the_way = None, lambda: None

    def subscribe(self, key, service, deliver):
        self.deliver = deliver

    def watch_alive(self, agent_id, on_change):
        self.on_role = on_change

    def request(self, key, payload, timeout_s):
        answer = None if self.whole is None else pack(self.whole)
        # As in life, on the thread that watches who is alive.
        watching = threading.Thread(target=self.on_the_way)
        watching.start()
        watching.join(60)
        return answer


def test_a_server_that_goes_while_its_answer_is_on_its_way_is_not_taken_for_the_next_one():
    session = ScriptedSession()
    mirror = MapMirror(session, AGENT)
    session.whole = message([1, 2])
    session.on_the_way = lambda: session.on_role("server", False)
    session.deliver(pack(message([2])))
    assert mirror.map.ids.tolist() == [1, 2]
    # The next one took the map up again, as it was once, and goes on.
    session.on_the_way, session.whole = lambda: None, message([1, 5, 6], offset=0.5)
    session.on_role("server", True)
    assert mirror.map.ids.tolist() == [1, 5, 6]
    session.whole = None
    session.deliver(pack(message([7], removed=[6])))
    assert mirror.map.ids.tolist() == [1, 5, 7]
    assert mirror.map.xyz[:, 0].tolist() == [1.5, 5.5, 7.0]


def test_a_server_that_begins_its_map_while_it_is_asked_is_asked_again():
    session = ScriptedSession()
    session.whole = message([1, 8])
    mirror = MapMirror(session, AGENT)
    session.on_role("server", False)

    def begins():
        session.on_the_way, session.whole = lambda: None, message([1, 2])
        session.deliver(pack(session.whole))

    session.on_the_way, session.whole = begins, None
    session.on_role("server", True)
    assert mirror.map.ids.tolist() == [1, 2], "8 was of the one before"
    session.deliver(pack(message([3])))
    assert mirror.map.ids.tolist() == [1, 2, 3]


@pytest.mark.parametrize(("before", "after"), [((7, 4), (7, 0)), ((7, 0), (7, 4)), ((9, 0), (3, 0))])
def test_a_map_that_is_begun_anew_while_it_is_asked_for_is_followed_whatever_its_number(before, after):
    """Its numbers fall where a server began without its checkpoint, or the clock of an agent was set back."""
    former, present = ({"agent_epoch": epoch, "map_epoch": number} for epoch, number in (before, after))
    session = ScriptedSession()

    def begins_anew():
        session.on_the_way, session.whole = lambda: None, message([5], **present)
        session.deliver(pack(message([2], **former)))
        session.deliver(pack(message([5], **present)))

    session.on_the_way, session.whole = begins_anew, message([1, 2], **former)
    mirror = MapMirror(session, AGENT)
    assert mirror.map.ids.tolist() == [5]
    session.whole = None  # it is not asked any more
    session.deliver(pack(message([6], **present)))
    assert mirror.map.ids.tolist() == [5, 6]


def test_a_change_of_a_former_map_that_comes_behind_the_answer_does_not_bring_it_back():
    session = ScriptedSession()
    session.whole = message([1, 2], map_epoch=2)
    mirror = MapMirror(session, AGENT)
    session.deliver(pack(message([9], map_epoch=1)))
    assert (mirror.map.map_epoch, mirror.map.ids.tolist()) == (2, [1, 2])


def test_a_map_is_brought_to_metres_as_a_pose_tells():
    ids = np.arange(5)
    change = message(ids, keyframes=(2, 4))
    change.keyframe_poses[:] = np.eye(4)
    change.keyframe_poses[:, :3, 3] = [[1.0, 2, 3], [3, 2, 2]]
    before = _EMPTY.updated(change)
    T_marker_world = make_transform(exp_so3((0.3, -1.0, 0.5)), (4.0, -2.0, 1.0))
    pose = MetricPose(
        agent_epoch=7, frame_id=4, t_capture_ns=0, t_source_ns=0, T_marker_cam=(0.0,) * 16, covariance=None,
        m_per_unit=0.4, relative_sigma=0.01, T_marker_world=tuple(T_marker_world.ravel().tolist()),
        marker_id=7, num_keyframes=3, map_epoch=0, submap=0,
    )  # fmt: skip
    after = before.in_metres(pose)
    np.testing.assert_allclose(after.xyz, transform_points(T_marker_world, 0.4 * before.xyz), atol=1e-5)
    centres = before.keyframe_poses[:, :3, 3]
    np.testing.assert_allclose(
        after.keyframe_poses[:, :3, 3], transform_points(T_marker_world, 0.4 * centres), atol=1e-9
    )
    turned = T_marker_world[:3, :3] @ before.keyframe_poses[:, :3, :3]
    np.testing.assert_allclose(after.keyframe_poses[:, :3, :3], turned, atol=1e-9)
    np.testing.assert_array_equal(after.ids, before.ids)
    np.testing.assert_array_equal(before.keyframe_poses, change.keyframe_poses)
    for other in ({"map_epoch": 1}, {"agent_epoch": 8}):
        with pytest.raises(ValueError, match=r"pose must be of agent_epoch and map_epoch \(7, 0\), got"):
            before.in_metres(replace(pose, **other))
