"""What adds up on the way, and what becomes of it when parts are moved, joined and bent."""

from types import SimpleNamespace

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, make_transform
from semcast.server.mapping import map_builder
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.drift import Drift
from semcast.server.mapping.guessed_place import similarity_adjoint
from semcast.server.mapping.map_builder import MapBuilder
from semcast.server.mapping.pose_covariance import pose_covariance
from semcast.server.mapping.pose_graph import SolvedGraph
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.world_map import Keyframe

CAMERA = Intrinsics(fx=500, fy=500, cx=320, cy=240, width=640, height=480)


def pose(x, turned_deg=0.0):
    return make_transform(exp_so3((0.0, 0.0, np.radians(turned_deg))), (x, 0.0, 0.0))


def adjusted(frame_ids, fixed, covariances, poses, seen=None, *, sets_unit=False):
    """What an adjustment says; ``seen`` is how often each keyframe sees the window."""
    seen = seen or [1] * len(frame_ids)
    view = np.repeat(np.arange(len(frame_ids)), seen)
    problem = SimpleNamespace(
        keyframe_ids=np.array(frame_ids), fixed=np.array(fixed), view=view, sets_unit=sets_unit
    )
    return SimpleNamespace(
        problem=problem,
        T_world_cam=np.stack(list(poses)),
        covariances=None if covariances is None else np.stack(covariances),
    )


def of_window(turn=0.01, place=0.02, scale=0.03):
    return np.diag(np.repeat((turn, place, scale), (3, 3, 1)) ** 2)


NONE = np.zeros((7, 7))


def test_what_holds_a_window_is_behind_what_the_window_says():
    drift = Drift()
    drift.take(adjusted([0, 5], [True, False], [NONE, of_window()], [pose(0), pose(1)], sets_unit=True))
    np.testing.assert_allclose(drift.of(5), of_window())
    np.testing.assert_array_equal(drift.of(0), NONE, err_msg="all is told against it")
    drift.take(adjusted([5, 9], [True, False], [NONE, of_window()], [pose(1), pose(3)]))
    # Two units on, a turn moves by twice its angle to the sides, and the scale by twice its share along.
    carried = [2 * 0.01**2] * 3 + [2 * 0.02**2 + (2 * 0.03) ** 2] + [2 * 0.02**2 + (2 * 0.01) ** 2] * 2
    np.testing.assert_allclose(np.diag(drift.of(9)), [*carried, 2 * 0.03**2], rtol=1e-9)


def test_keyframes_that_hold_a_window_count_by_what_they_see_of_it():
    drift = Drift()
    start = adjusted([0, 5], [True, False], [NONE, of_window(place=1.0)], [pose(0)] * 2, sets_unit=True)
    holding = [True, True, False], [NONE, NONE, NONE], [pose(0)] * 3, [30, 10, 50]
    drift.take(start)
    drift.take(adjusted([0, 5, 9], *holding))
    np.testing.assert_allclose(drift.of(9), 0.25 * of_window(place=1.0))
    drift.take(adjusted([3, 5, 12], *holding))
    np.testing.assert_allclose(drift.of(12), of_window(place=1.0), err_msg="nothing is known of one of them")


def test_an_adjustment_that_fixed_nothing_changes_nothing():
    drift = Drift()
    drift.take(adjusted([0, 5], [True, False], None, [pose(0), pose(1)]))
    assert drift.of(5) is None


def some_drift():
    drift = Drift()
    poses = {10 * k: pose(k) for k in range(5)}
    drift.take(
        adjusted(
            list(poses),
            [True] + [False] * 4,
            [NONE] + [k * of_window() for k in range(1, 5)],
            poses.values(),
            sets_unit=True,
        )
    )
    return drift, poses


def test_another_unit_is_that_of_places():
    drift, _ = some_drift()
    drift.rescale({10: 2.0, 99: 3.0})
    np.testing.assert_allclose(np.diag(drift.of(10)), [0.01**2] * 3 + [0.04**2] * 3 + [0.03**2])
    np.testing.assert_allclose(drift.of(20), 2 * of_window())
    assert drift.of(99) is None


def test_a_part_that_was_put_in_place_by_another_is_off_by_what_that_is():
    drift, poses = some_drift()
    drift.follow([30, 40], 10, poses)
    carried = similarity_adjoint(pose(2))
    np.testing.assert_allclose(drift.of(30), 3 * of_window() + carried @ of_window() @ carried.T)
    np.testing.assert_allclose(drift.of(20), 2 * of_window())
    drift.follow([0], 10, poses)
    carried = similarity_adjoint(pose(-1))
    np.testing.assert_allclose(drift.of(0), carried @ of_window() @ carried.T, err_msg="the first of a part")
    drift.follow([40], 99, poses)
    assert drift.of(40)[0, 0] == pytest.approx(5 * 0.01**2), "the start is off by nothing"


def test_the_end_of_a_loop_is_known_as_well_as_its_place():
    drift, poses = some_drift()
    before = drift.of(30).copy()
    poses = {**poses, 40: pose(1.0)}
    drift.close(10, 40, list(poses), poses)
    np.testing.assert_allclose(drift.of(10), of_window())
    np.testing.assert_allclose(drift.of(40), of_window(), atol=1e-12)
    carried = similarity_adjoint(pose(2)) @ of_window() @ similarity_adjoint(pose(2)).T
    np.testing.assert_allclose(drift.of(30), before / 3.0 + 2.0 / 3.0 * carried)


def test_it_goes_through_a_checkpoint_and_forgets_what_is_gone():
    drift, _ = some_drift()
    drift.keep([20, 40, 77])
    again = Drift()
    again.restore(drift.arrays())
    assert [again.of(k) is not None for k in (0, 10, 20, 30, 40, 77)] == [
        False,
        False,
        True,
        False,
        True,
        False,
    ]
    np.testing.assert_array_equal(again.of(40), drift.of(40))
    again.restore({})
    assert again.of(40) is None, "an older checkpoint"


@pytest.fixture
def builder():
    """A map of two parts, five keyframes each, with some drift."""
    builder = MapBuilder(CAMERA, ReconstructionSettings(), InlineBundle(), on_moved=lambda _: None)
    none = np.zeros(0, np.int64)
    for submap in (0, 1):
        for k in range(5):
            about = (100 * submap + 10 * k, 0, pose(k), submap)
            builder.world.add_keyframe(Keyframe(*about, none, np.zeros((0, 2)), np.zeros(0)))
    posed = np.array(sorted(builder.world.poses))
    builder.world.drift.restore(
        {"drift.frame_id": posed, "drift.covariance": np.stack([(1 + k % 100) * of_window() for k in posed])}
    )
    return builder


def test_a_map_that_closes_a_loop_is_known_there_as_its_place_is(builder, monkeypatch):
    none, newest = np.zeros(0, np.int64), 200
    builder.world.add_keyframe(Keyframe(newest, 0, pose(5), 0, none, np.zeros((0, 2)), np.zeros(0)))
    drift = builder.world.drift.arrays()
    frame_ids, covariances = [*drift["drift.frame_id"], newest], [*drift["drift.covariance"], of_window()]
    builder.world.drift.restore(
        {"drift.frame_id": np.array(frame_ids), "drift.covariance": np.stack(covariances)}
    )
    ids = np.array([0, 10, 20, 30, 40, newest])
    bent = np.stack([pose(min(k, 1)) for k in range(6)])
    solved = SolvedGraph(bent, np.array([1.0, 1.0, 1.0, 1.0, 1.0, 2.0]), 0.0)
    monkeypatch.setattr(map_builder, "share_out", lambda *_: (ids, solved))
    assert builder._close(SimpleNamespace(keyframe_id=newest, place=SimpleNamespace(keyframe_id=10)))
    np.testing.assert_allclose(builder.world.drift.of(newest), 11 * of_window())
    np.testing.assert_allclose(builder.world.drift.of(0), of_window())
    np.testing.assert_allclose(builder.world.drift.of(140), 41 * of_window(), err_msg="another part")
    at_end = pose_covariance(builder.world, 0, 1e-9 * np.eye(6), pose(1))
    np.testing.assert_allclose(at_end, 1e-9 * np.eye(6) + 11 * of_window()[:6, :6])


def join(builder, monkeypatch, submap, keyframe_id):
    """Recognise a keyframe of the other part, whose unit is twice as large; the factor on the current one."""
    monkeypatch.setattr(map_builder, "submap_similarity", lambda *_: (2.0, np.eye(4)))
    monkeypatch.setattr(map_builder, "may_join", lambda *_, **__: True)
    builder.enter(1 - submap)
    place = SimpleNamespace(submap=submap, keyframe_id=keyframe_id)
    tracks = SimpleNamespace(visible=np.ones(0, bool), ids=np.zeros(0, np.int64), xy=np.zeros((0, 2)))
    return builder.join(place, pose(0), tracks)


def test_a_part_that_is_joined_is_off_by_what_its_place_is_and_in_the_unit_there(builder, monkeypatch):
    assert join(builder, monkeypatch, 0, 20) == 2.0
    own = 11 * of_window(place=2 * 0.02)
    np.testing.assert_allclose(builder.world.drift.of(110), own + 21 * of_window(), atol=1e-12)
    np.testing.assert_allclose(builder.world.drift.of(10), 11 * of_window())


def test_an_older_part_that_the_camera_is_in_stays_and_the_other_is_behind_its_newest_keyframe(
    builder, monkeypatch
):
    assert join(builder, monkeypatch, 1, 120) == 1.0
    # Keyframe 40 is at 4, and so is 140 at half the scale: at 2.
    own, moved = 41 * of_window(place=0.5 * 0.02), similarity_adjoint(pose(-2))
    np.testing.assert_allclose(builder.world.drift.of(140), own + 41 * moved @ of_window() @ moved.T)
    np.testing.assert_allclose(builder.world.drift.of(40), 41 * of_window())
