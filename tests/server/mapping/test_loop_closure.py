"""A camera that is back where it was, in a map that has drifted: the loop is found, and drift shared out."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, invert_transform, make_transform, rotation_angle_deg
from semcast.server.geometry.klt import TrackedPoints
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.loop_closure import _LOOK_INTERVAL, Loop, LoopFinder, LoopView, share_out
from semcast.server.mapping.relocalisation import MAX_CONSIDERED, Place
from semcast.server.mapping.revisit import Revisit
from semcast.server.mapping.world_map import Keyframe, WorldMap

CAMERA = Intrinsics(fx=300.0, fy=300.0, cx=160.0, cy=120.0, width=320, height=240)
NOISE = NoiseModel(0.7, 0.0)
#: Keyframes once round a square room, looking at the walls; the last one is where the first was.
NUM = 60
#: What the map has drifted by when the camera is back: a similarity ``x' = T (s x)``.
DRIFT, DRIFT_SCALE = make_transform(exp_so3(np.radians([0.5, 3.0, -0.5])), [0.3, -0.1, 0.25]), 1.2


def around(k):
    """True pose of a keyframe."""
    R = exp_so3([0.0, 2 * np.pi * k / (NUM - 1), 0.0])
    return make_transform(R, R @ [0.0, 0.0, 2.0])


def sees(T_world_cam, xyz):
    """Which points are in the image, and where."""
    points = xyz @ T_world_cam[:3, :3] - T_world_cam[:3, 3] @ T_world_cam[:3, :3]
    xy = CAMERA.project(np.where(points[:, 2:] > 0.1, points, (0.0, 0.0, 1.0)))
    inside = (points[:, 2] > 0.1) & (xy > 5).all(axis=1) & (xy < (315, 235)).all(axis=1)
    return np.flatnonzero(inside), xy[inside]


def share_of_drift(k):
    """The similarity keyframe ``k`` has drifted by, growing evenly."""
    share = k / (NUM - 1)
    R = exp_so3(share * np.radians([0.5, 3.0, -0.5]))
    return make_transform(R, share * DRIFT[:3, 3]), DRIFT_SCALE**share


def drifted(T_world_cam, k):
    T, scale = share_of_drift(k)
    moved = T_world_cam.copy()
    moved[:3, 3] *= scale
    return T @ moved


@pytest.fixture
def room(rng):
    """A map that drifted on the way round: every landmark was made where the camera believed to be.

    Ids of points that the first and the last keyframes see differ: nothing told that they are the same.
    """
    angle, height = rng.uniform(0, 2 * np.pi, 3000), rng.uniform(-2, 2, 3000)
    xyz = np.column_stack((5 * np.sin(angle), height, 5 * np.cos(angle)))
    world = WorldMap()
    known = np.zeros(0, np.int64)
    for k in range(NUM):
        T = around(k)
        point, xy = sees(T, xyz)
        ids = point + (10_000 if k > NUM // 2 else 0)
        order = np.argsort(ids)
        ids, point, xy = ids[order], point[order], xy[order]
        believed = drifted(T, k)
        world.add_keyframe(Keyframe(k, k * 10**8, believed, 0, ids, xy, np.ones(len(ids))))
        new = ~np.isin(ids, known)
        known = np.union1d(known, ids)
        T_drift, scale = share_of_drift(k)
        made = scale * xyz[point[new]] @ T_drift[:3, :3].T + T_drift[:3, 3]
        world.add_landmarks(ids[new], made, np.zeros((new.sum(), 3), np.uint8), np.ones(new.sum()), 0, k)
    return world, xyz


def view(room, T_true, frame_id=100):
    """A frame after the last keyframe, posed in the drifted part of the map, with its tracks."""
    world, xyz = room
    point, xy = sees(T_true, xyz)
    ids = point + 10_000
    known = world.landmarks.rows(ids) >= 0
    T_world_cam = drifted(T_true, NUM - 1)
    world.add_frame(frame_id, NUM - 1, T_world_cam)
    sight = SimpleNamespace(frame=SimpleNamespace(frame_id=frame_id))
    return LoopView(sight, T_world_cam, ids[known], xy[known])


def old_landmarks(room, T_true, rng, *, num_wrong=0, off_px=0.3):
    """Landmarks of the first keyframes, found in that frame."""
    world, xyz = room
    ids, xy = sees(T_true, xyz)
    known = world.landmarks.rows(ids) >= 0
    ids, xy = ids[known], xy[known] + rng.normal(0, off_px, (int(known.sum()), 2))
    xy[:num_wrong] = rng.uniform((0, 0), (320, 240), (num_wrong, 2))
    count = len(ids)
    points = TrackedPoints(xy, np.ones(count, bool), np.zeros(count), np.zeros(count), np.full(count, 50.0))
    return Revisit(0, ids, points)


class Recogniser:
    """Stands for the relocaliser: knows the place of the frame, or none."""

    def __init__(self, *places):
        self.places, self.asked = list(places), []

    def recognise(self, sight, world, noise, candidates):
        self.asked.append([k.frame_id for k in candidates])
        return self.places.pop(0) if self.places else None


HERE = around(0) @ make_transform(exp_so3([0.02, -0.03, 0.01]), [0.1, 0.05, -0.1])


def look(finder, room, found=None, T_true=HERE):
    return finder.look(view(room, T_true), room[0], NOISE, 0, found)


def test_landmarks_found_one_by_one_tell_how_the_newest_part_has_to_move(room, rng):
    loop = look(LoopFinder(CAMERA, Recogniser(), 0), room, old_landmarks(room, HERE, rng))
    assert (loop.keyframe_id, loop.place.keyframe_id) == (NUM - 1, 0)
    assert loop.scale == pytest.approx(1 / DRIFT_SCALE, rel=0.03)
    np.testing.assert_allclose(loop.moved(drifted(HERE, NUM - 1)), HERE, atol=0.03)


def test_a_place_proved_by_too_few_is_none(room, rng):
    found = old_landmarks(room, HERE, rng)
    found = old_landmarks(room, HERE, rng, num_wrong=int(0.5 * len(found.ids)))
    finder = LoopFinder(CAMERA, Recogniser(), 0)
    assert look(finder, room, found) is None
    assert not finder.is_in_doubt


def test_landmarks_of_unknown_depth_prove_no_place(room, rng):
    """Most were seen from one place alone, and lie where they fit a pose that is beside the true one."""
    world, _ = room
    found = old_landmarks(room, HERE, rng, off_px=0.1)
    vague = np.zeros(len(found.ids), bool)
    vague[rng.permutation(len(vague))[: int(0.7 * len(vague))]] = True
    for keyframe in world.keyframes[1:]:
        keyframe.drop_observations(np.isin(keyframe.ids, found.ids[vague]))
    wrong = HERE @ make_transform(exp_so3([0.0, 0.2, 0.0]), [1.2, 0.0, 0.3])
    rays = CAMERA.unproject(found.points.xy[vague]) @ wrong[:3, :3].T
    depth = rng.uniform(3.0, 4.0, (int(vague.sum()), 1))
    world.move_landmarks(found.ids[vague], wrong[:3, 3] + depth * rays)
    loop = look(LoopFinder(CAMERA, Recogniser(), 0), room, found)
    np.testing.assert_allclose(loop.moved(drifted(HERE, NUM - 1)), HERE, atol=0.05)


def test_where_nothing_has_drifted_there_is_no_loop_and_none_is_looked_for(room, rng):
    world, _ = room
    put_right(room)
    recogniser = Recogniser()
    finder = LoopFinder(CAMERA, recogniser, 0)
    of_newest = view(room, HERE)
    here = LoopView(of_newest.sight, HERE, of_newest.ids, of_newest.xy)
    finder.refuse()
    for _ in range(_LOOK_INTERVAL):
        assert finder.is_in_doubt
        assert finder.look(here, world, NOISE, 0, old_landmarks(room, HERE, rng)) is None
    assert not finder.is_in_doubt, "what was refused before was a wrong place"
    assert all(finder.look(here, world, NOISE, 0, None) is None for _ in range(19))
    assert recogniser.asked == []
    finder.look(here, world, NOISE, 0, None)
    assert len(recogniser.asked) == 1, "after twenty keyframes something may have drifted"


def put_right(room):
    """Take all drift out of a map."""
    world, xyz = room
    for keyframe in world.keyframes:
        world.move_keyframe(keyframe.frame_id, around(keyframe.frame_id))
    world.landmarks.xyz = xyz[world.landmarks.ids % 10_000]


def test_a_place_that_fits_epipolar_lines_worse_than_the_pose_is_none(room, rng):
    """Landmarks of poor depth may agree with a pose far off, though two images tell better."""
    world, _ = room
    found = old_landmarks(room, HERE, rng, off_px=0.1)
    put_right(room)
    poor = rng.permutation(len(found.ids))[: int(0.7 * len(found.ids))]
    wrong = HERE @ make_transform(exp_so3([0.0, 0.2, 0.0]), [1.2, 0.0, 0.3])
    rays = CAMERA.unproject(found.points.xy[poor]) @ wrong[:3, :3].T
    world.move_landmarks(found.ids[poor], wrong[:3, 3] + rng.uniform(3.0, 4.0, (len(poor), 1)) * rays)
    of_newest = view(room, HERE)
    here = LoopView(of_newest.sight, HERE, of_newest.ids, of_newest.xy)
    assert LoopFinder(CAMERA, Recogniser(), 0).look(here, world, NOISE, 0, found) is None


def test_a_loop_that_is_still_open_is_closed_further_at_once(room, rng):
    finder, found = LoopFinder(CAMERA, Recogniser(), 0), old_landmarks(room, HERE, rng)
    assert look(finder, room, found) is not None
    assert look(finder, room, found) is not None
    assert look(finder, room, replace(found, keyframe_id=NUM - 10)) is None, "these have yet to settle"


def test_what_has_not_drifted_since_a_keyframe_may_have_before_it(room, rng):
    put_right(room)
    found, of_newest = old_landmarks(room, HERE, rng), view(room, HERE)
    here = LoopView(of_newest.sight, HERE, of_newest.ids, of_newest.xy)
    recogniser = Recogniser(Place(HERE, 1, found.ids, found.points.xy, 0))
    finder = LoopFinder(CAMERA, recogniser, 0)
    for _ in range(2 * _LOOK_INTERVAL):
        assert finder.look(here, room[0], NOISE, 0, None) is None
    assert len(recogniser.asked) == 1, "there is none before it from which drift may have led here"
    recogniser = Recogniser(Place(HERE, NUM - 15, found.ids, found.points.xy, 0))
    finder = LoopFinder(CAMERA, recogniser, 0)
    for _ in range(2 * _LOOK_INTERVAL):
        assert finder.look(here, room[0], NOISE, 0, None) is None
    assert len(recogniser.asked) == 2


@pytest.mark.parametrize(("tied_id", "is_prolonged"), [(0, True), (5, False)])
def test_only_ties_as_old_prolong_what_is_known(room, rng, tied_id, is_prolonged):
    put_right(room)
    found, of_newest, recogniser = old_landmarks(room, HERE, rng), view(room, HERE), Recogniser()
    here = LoopView(of_newest.sight, HERE, of_newest.ids, of_newest.xy)
    finder = LoopFinder(CAMERA, recogniser, 0)
    assert finder.look(here, room[0], NOISE, 0, found) is None
    for _ in range(25):
        finder.note_tie(tied_id)
        finder.look(here, room[0], NOISE, 0, None)
    assert (recogniser.asked == []) == is_prolonged


def place(room, T_true, rng):
    found = old_landmarks(room, T_true, rng)
    return Place(T_true, 0, found.ids, found.points.xy, 0)


def test_a_place_has_to_be_recognised_twice(room, rng):
    recogniser = Recogniser(place(room, HERE, rng), place(room, HERE, rng))
    finder = LoopFinder(CAMERA, recogniser, 0)
    loops = [look(finder, room) for _ in range(_LOOK_INTERVAL + 1)]
    assert [loop is not None for loop in loops] == [False] * _LOOK_INTERVAL + [True]
    assert loops[-1].scale == pytest.approx(1 / DRIFT_SCALE, rel=0.03)
    assert set(recogniser.asked[0]) <= set(range(NUM - 20))
    assert 0 in recogniser.asked[0]
    assert not finder.is_in_doubt


def test_two_recognitions_that_contradict_each_other_are_no_loop(room, rng):
    elsewhere = place(room, HERE, rng)
    elsewhere = Place(HERE @ make_transform(np.eye(3), [1.0, 0, 0]), 0, elsewhere.ids, elsewhere.xy, 0)
    finder = LoopFinder(CAMERA, Recogniser(place(room, HERE, rng), elsewhere), 0)
    assert all(look(finder, room) is None for _ in range(_LOOK_INTERVAL + 1))
    assert finder.is_in_doubt


def test_a_place_recognised_once_is_forgotten(room, rng):
    finder = LoopFinder(CAMERA, Recogniser(place(room, HERE, rng)), 0)
    assert all(look(finder, room) is None for _ in range(_LOOK_INTERVAL))
    assert finder.is_in_doubt
    assert all(look(finder, room) is None for _ in range(11))
    assert not finder.is_in_doubt


def test_a_refused_loop_leaves_doubt_until_it_is_found_again_or_long_ago(room, rng):
    found = old_landmarks(room, HERE, rng)
    finder = LoopFinder(CAMERA, Recogniser(), 0)
    for _ in range(2):
        assert look(finder, room, found) is not None
        assert not finder.is_in_doubt
        finder.refuse()
        assert [look(finder, room, found) for _ in range(_LOOK_INTERVAL - 1)] == [None] * (_LOOK_INTERVAL - 1)
        assert finder.is_in_doubt
    assert all(look(finder, room) is None for _ in range(6))
    assert finder.is_in_doubt
    look(finder, room)
    assert not finder.is_in_doubt


def test_far_from_old_keyframes_nothing_is_compared(room):
    recogniser = Recogniser()
    finder = LoopFinder(CAMERA, recogniser, 0)
    away = around(NUM - 1) @ make_transform(np.eye(3), [0, 0, -30.0])
    for _ in range(6):
        finder.look(LoopView(view(room, HERE).sight, away, *sees(HERE, room[1])), room[0], NOISE, 0, None)
    assert recogniser.asked == []


@pytest.mark.parametrize(("num_old", "num_compared"), [(MAX_CONSIDERED, MAX_CONSIDERED), (41, 21), (80, 40)])
def test_old_keyframes_are_thinned_out_only_where_they_are_too_many(num_old, num_compared):
    world, nothing = WorldMap(), (np.zeros(0, np.int64), np.zeros((0, 2)))
    for k in range(num_old + 20):  # the newest are never a loop
        world.add_keyframe(Keyframe(k, k, make_transform(np.eye(3), [k % 2, 0, 0]), 0, *nothing, np.zeros(0)))
    recogniser = Recogniser()
    finder = LoopFinder(CAMERA, recogniser, 0)
    for _ in range(_LOOK_INTERVAL):
        finder.look(LoopView(None, np.eye(4), *nothing), world, NOISE, 0, None)
    assert [len(ids) for ids in recogniser.asked] == [num_compared]


def test_which_keyframes_are_compared_does_not_depend_on_the_shape_of_pixels(room):
    asked = []
    for squeeze in (1.0, 0.1):
        recogniser = Recogniser()
        finder = LoopFinder(CAMERA.scaled_to(round(320 * squeeze), 240), recogniser, 0)
        for _ in range(_LOOK_INTERVAL):
            look(finder, room)
        asked.append(recogniser.asked)
    assert len(asked[0]) == 1
    assert asked[0] == asked[1]


def test_drift_is_shared_out_along_the_way(room, rng):
    world, xyz = room
    loop = look(LoopFinder(CAMERA, Recogniser(), 0), room, old_landmarks(room, HERE, rng))
    ids, solved = share_out(world, 0, loop)
    assert ids.tolist() == list(range(NUM))
    truth = np.stack([around(k)[:3, 3] for k in range(NUM)])
    before = np.stack([world.poses[k][:3, 3] for k in range(NUM)])
    off_before = np.linalg.norm(before - truth, axis=1)
    off = np.linalg.norm(solved.T_world_cam[:, :3, 3] - truth, axis=1)
    assert off[-1] < 0.1 * off_before[-1]
    assert off.max() < 0.35 * off_before.max()
    assert solved.scale[-1] == pytest.approx(1 / DRIFT_SCALE, rel=0.05)
    assert np.all(np.diff(solved.scale) < 0.002), "more and more"
    # The landmarks go with the keyframes that made them.
    true_xyz = xyz[world.landmarks.ids % 10_000]
    error_before = np.linalg.norm(world.landmarks.xyz - true_xyz, axis=1)
    world.bend(ids, solved.T_world_cam, solved.scale)
    error = np.linalg.norm(world.landmarks.xyz - true_xyz, axis=1)
    assert np.median(error) < 0.7 * np.median(error_before)
    assert np.linalg.norm(world.pose_of_frame(100)[:3, 3] - HERE[:3, 3]) < 0.1


def test_keyframes_that_were_thinned_out_leave_no_gap(room, rng):
    world, _ = room
    loop = look(LoopFinder(CAMERA, Recogniser(), 0), room, old_landmarks(room, HERE, rng))
    every, wanted = share_out(world, 0, loop)
    world.keyframes = world.keyframes[:40:10] + world.keyframes[40:]
    shared = np.intersect1d(world.keyframes[0].ids, world.keyframes[1].ids)
    assert len(shared) == 0, "else this tests nothing"
    ids, solved = share_out(world, 0, loop)
    at = np.searchsorted(every, ids)
    moved, moved_wanted = (
        np.linalg.norm(T[:, :3, 3] - np.stack([world.poses[k][:3, 3] for k in ids.tolist()]), axis=1)
        for T in (solved.T_world_cam, wanted.T_world_cam[at])
    )
    np.testing.assert_allclose(moved, moved_wanted, atol=0.15 * moved_wanted.max())


def test_a_gap_takes_most_of_what_has_to_be_shared_out(room, rng):
    world, _ = room
    for keyframe in world.keyframes[30:]:
        keyframe.ids = keyframe.ids + 50_000  # no track goes from one side to the other
    T = make_transform(exp_so3([0.0, 0.1, 0.0]), [0.5, 0.0, 0.0])
    newest = world.keyframes[-1]
    there = Place(T @ newest.T_world_cam, 0, np.zeros(0, np.int64), np.zeros((0, 2)), 0)
    _, solved = share_out(world, 0, Loop(newest.frame_id, there, 1.0, T))
    moved = np.linalg.norm(
        solved.T_world_cam[:, :3, 3] - np.stack([world.poses[k][:3, 3] for k in range(NUM)]), axis=1
    )
    assert moved[29] < 0.1 * moved[30]


@pytest.mark.parametrize(("turn_deg", "is_drift"), [(2.0, True), (30.0, False)])
def test_a_loop_that_no_drift_explains_is_none(room, turn_deg, is_drift):
    world, _ = room
    newest, old_id = world.keyframes[-1], NUM // 2 + 5  # no gap between them, which would explain anything
    T_world_new = newest.T_world_cam @ make_transform(exp_so3(np.radians([turn_deg, 0.0, 0.0])), np.zeros(3))
    place = Place(T_world_new, old_id, np.zeros(0, np.int64), np.zeros((0, 2)), 0)
    loop = Loop(newest.frame_id, place, 1.0, T_world_new @ invert_transform(newest.T_world_cam))
    shared = share_out(world, 0, loop)
    assert (shared is not None) == is_drift
    if shared is not None:
        left_deg = rotation_angle_deg(T_world_new[:3, :3].T @ shared[1].T_world_cam[-1, :3, :3])
        assert left_deg < 0.02, "landmarks of there are to be found where they are"


def test_ties_made_before_hold(room, rng):
    world, _ = room
    loop = look(LoopFinder(CAMERA, Recogniser(), 0), room, old_landmarks(room, HERE, rng))
    _, free = share_out(world, 0, loop)
    world.revisits |= {30: 0, 7: NUM + 5, NUM + 6: 3}  # and two with keyframes of another part
    _, tied = share_out(world, 0, loop)

    def moved(solved):
        return np.linalg.norm(solved.T_world_cam[30, :3, 3] - world.poses[30][:3, 3])

    assert moved(tied) < 0.5 * moved(free)
    assert invert_transform(tied.T_world_cam[0])[:3, 3] == pytest.approx(
        invert_transform(world.poses[0])[:3, 3], abs=1e-4
    )
