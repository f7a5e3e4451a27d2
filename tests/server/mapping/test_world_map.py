import numpy as np
import pytest

from semcast.common.geometry import exp_se3, invert_transform, transform_points
from semcast.server.mapping.guessed_place import GuessedPlace
from semcast.server.mapping.world_map import Keyframe, WorldMap


def make_keyframe(frame_id, ids, submap=0, seed=0):
    rng = np.random.default_rng(seed + frame_id)
    ids = np.array(ids, np.int64)
    return Keyframe(
        frame_id=frame_id,
        t_source_ns=frame_id * 10,
        T_world_cam=exp_se3(rng.normal(0, 0.3, 6)),
        submap=submap,
        ids=ids,
        xy=rng.uniform(0, 100, (len(ids), 2)),
        confidence=rng.uniform(0, 1, len(ids)),
        descriptor_ids=ids[::2],
        descriptors=rng.integers(0, 256, (len(ids[::2]), 32), dtype=np.uint8),
        edge=rng.normal(0, 0.5, (len(ids), 2)),
    )


def make_world():
    world = WorldMap()
    for k in range(4):
        world.add_keyframe(make_keyframe(10 * k, range(k, k + 6), submap=k // 2))
        world.add_frame(10 * k + 3, 10 * k, world.poses[10 * k] @ exp_se3(np.full(6, 0.1)))
    add_world(world, [1, 2, 3], 0, 10)
    add_world(world, [5, 6], 1, 30)
    world.guesses = {1: GuessedPlace(20, np.diag(np.arange(1.0, 8.0))), 0: GuessedPlace(10, None)}
    world.drift.restore({"drift.frame_id": np.array([10, 30]), "drift.covariance": np.stack([np.eye(7)] * 2)})
    return world


def add_world(world, ids, submap, frame_id):
    ids = np.array(ids, np.int64)
    xyz = np.random.default_rng(int(ids.sum())).normal(0, 2, (len(ids), 3))
    world.add_landmarks(ids, xyz, np.zeros((len(ids), 3), np.uint8), np.ones(len(ids)), submap, frame_id)


def test_a_keyframe_is_found_by_its_id_until_it_is_thinned_out():
    world = make_world()
    for keyframe in world.keyframes:
        assert world.keyframe(keyframe.frame_id) is keyframe
    assert [world.keyframe(k) for k in (-1, 3, 15, 31)] == [None] * 4
    assert WorldMap().keyframe(0) is None
    gone = world.keyframes.pop(1).frame_id
    assert gone in world.poses
    assert world.keyframe(gone) is None


def test_frames_follow_their_keyframe():
    world = make_world()
    before = world.pose_of_frame(13)
    T = exp_se3([0.1, 0, 0.2, 1, 2, 3])
    world.move_keyframe(10, T @ world.poses[10])
    assert np.allclose(world.pose_of_frame(13), T @ before)
    assert world.pose_of_frame(99) is None
    assert list(world.trajectory()) == [0, 3, 10, 13, 20, 23, 30, 33]


def test_changes_are_reported_once():
    world = make_world()
    changed, removed, keyframes, frames, withdrawn = world.take_changes()
    assert changed.tolist() == [1, 2, 3, 5, 6]
    assert removed.tolist() == []
    assert keyframes.tolist() == [0, 10, 20, 30]
    assert frames.tolist() == withdrawn.tolist() == []
    assert sum(len(part) for part in world.take_changes()) == 0
    world.move_landmarks(np.array([2, 77]), np.ones((2, 3)))
    world.remove_landmarks(world.landmarks.ids == 3)
    world.forget_frames([13, 20, 77])
    world.forget_frames([23])
    world.add_frame(23, 20, world.poses[20])
    changed, removed, _, _, withdrawn = world.take_changes()
    assert changed.tolist() == [2]
    assert removed.tolist() == [3]
    assert withdrawn.tolist() == [13, 20, 77], "23 has a pose again"


def test_a_landmark_that_comes_back_is_not_reported_as_removed():
    world = make_world()
    world.take_changes()
    world.remove_landmarks(world.landmarks.ids == 3)
    add_world(world, [3], 0, 40)
    changed, removed, *_ = world.take_changes()
    assert changed.tolist() == [3]
    assert removed.tolist() == []


def test_a_similarity_moves_everything_of_a_submap_alike():
    world = make_world()
    scale, T = 2.5, exp_se3([0.3, -0.2, 0.1, 4, 5, 6])
    row = world.landmarks.rows(np.array([5, 6]))
    seen_before = transform_points(invert_transform(world.pose_of_frame(33)), world.landmarks.xyz[row])
    others = {k: world.pose_of_frame(k) for k in (0, 3, 13)}
    world.take_changes()
    world.transform_submap(1, 0, scale, T)
    assert world.take_changes().frames.tolist() == sorted(world.frames)
    seen_after = transform_points(invert_transform(world.pose_of_frame(33)), world.landmarks.xyz[row])
    assert np.allclose(seen_after, scale * seen_before)
    assert np.allclose(world.pose_of_frame(33)[:3, :3] @ world.pose_of_frame(33)[:3, :3].T, np.eye(3))
    assert all(np.array_equal(world.pose_of_frame(k), T_k) for k, T_k in others.items())
    assert set(world.submap_of.values()) == {0}
    assert {k.submap for k in world.keyframes} == {0}
    assert set(world.landmarks.submap.tolist()) == {0}
    assert set(world.guesses) == {0}, "of what was guessed of the other one nothing is left"


def test_of_a_guess_nothing_is_left_where_the_submap_is_moved():
    world = make_world()
    world.transform_submap(1, 1, 2.0, np.eye(4))
    assert set(world.guesses) == {0}


def test_bending_moves_what_each_keyframe_made_with_it_and_in_its_scale():
    world = WorldMap()
    for k, submap in enumerate((0, 0, 0, 1)):
        world.add_keyframe(make_keyframe(10 * k, range(k, k + 6), submap=submap))
        world.add_frame(10 * k + 3, 10 * k, world.poses[10 * k] @ exp_se3(np.full(6, 0.1)))
    for ids, submap, born in (([1, 2], 0, 10), ([3, 4, 5], 0, 20), ([7], 1, 30)):
        add_world(world, ids, submap, born)
    scale = np.array([1.5, 2.0])
    T_new = np.stack(
        [exp_se3([0.2, 0, 0, 0, 0, 1]) @ world.poses[0], exp_se3([0.1, 0.2, -0.1, 3, 1, 2]) @ world.poses[20]]
    )
    mine = np.flatnonzero(world.landmarks.submap == 0)
    made_by = np.where(world.landmarks.born[mine] < 20, 0, 20)
    assert set(made_by.tolist()) == {0, 20}
    frames = {k: world.frames[k] for k in (3, 13, 23, 33)}
    others = world.landmarks.xyz[world.landmarks.submap == 1].copy()

    def around():
        seen = [
            transform_points(invert_transform(world.poses[k]), world.landmarks.xyz[[row]])[0]
            for k, row in zip(made_by.tolist(), mine.tolist(), strict=True)
        ]
        return np.array(seen)

    before = around()
    world.take_changes()
    # Keyframe 10 was thinned out: it goes with keyframe 0.
    at_10 = invert_transform(world.poses[0]) @ world.poses[10]
    world.bend(np.array([0, 20]), T_new, scale)
    np.testing.assert_allclose(world.poses[20], T_new[1])
    assert next(k for k in world.keyframes if k.frame_id == 20).T_world_cam is world.poses[20]
    at_10[:3, 3] *= 1.5
    np.testing.assert_allclose(invert_transform(world.poses[0]) @ world.poses[10], at_10, atol=1e-12)
    np.testing.assert_allclose(around(), np.where(made_by == 0, 1.5, 2.0)[:, None] * before, atol=1e-9)
    np.testing.assert_array_equal(world.landmarks.xyz[world.landmarks.submap == 1], others)
    for frame_id, factor in ((3, 1.5), (13, 1.5), (23, 2.0), (33, 1.0)):
        keyframe_id, T = world.frames[frame_id]
        np.testing.assert_allclose(T[:3, 3], factor * frames[frame_id][1][:3, 3])
        np.testing.assert_array_equal(T[:3, :3], frames[frame_id][1][:3, :3])
        assert keyframe_id == frames[frame_id][0]
    changed, _, keyframes, moved, _ = world.take_changes()
    assert set(world.landmarks.ids[mine].tolist()) <= set(changed.tolist())
    assert {0, 10, 20} <= set(keyframes.tolist())
    assert moved.tolist() == sorted(world.frames)


def test_the_map_is_bounded():
    world = WorldMap()
    for k in range(60):
        world.add_keyframe(make_keyframe(k, range(5 * k, 5 * k + 8)))
        add_world(world, range(5 * k, 5 * k + 5), 0, k)
        world.bound(max_landmarks=100, max_keyframes=30, recent=10)
        assert len(world.landmarks) <= 100
        assert len(world.keyframes) <= 30
    assert [k.frame_id for k in world.keyframes[-10:]] == list(range(50, 60))
    assert np.isin(np.arange(250, 300), world.landmarks.ids).all(), "the next frames rest on the newest"
    assert len(world.trajectory()) == 60


def test_places_of_long_ago_keep_keyframes_and_landmarks():
    # Twenty times as long as what the map may keep: seen last is not worth more than seen first.
    world = WorldMap()
    for k in range(600):
        world.add_keyframe(make_keyframe(k, range(5 * k, 5 * k + 8)))
        add_world(world, range(5 * k, 5 * k + 5), 0, k)
        world.bound(max_landmarks=200, max_keyframes=30, recent=10)
    frame_ids = np.array([k.frame_id for k in world.keyframes])
    assert frame_ids[0] < 60
    assert np.diff(frame_ids).max() <= 120, "twice as far apart as on average"
    num_landmarks = [int((world.landmarks.rows(k.ids) >= 0).sum()) for k in world.keyframes]
    assert min(num_landmarks) >= 3


def test_revisits_outlive_the_keyframes_that_are_thinned_out():
    # Two laps of 11 keyframes each: of a pair 11 apart one end always goes.
    world = WorldMap()
    for k in range(22):
        world.add_keyframe(make_keyframe(k, range(4)))
    world.revisits = {k + 11: k for k in range(11)}
    assert world.bound(100, 20, 2)
    kept = {k.frame_id for k in world.keyframes}
    assert len(world.revisits) >= 5
    assert all({new, old} <= kept and 9 <= new - old <= 13 for new, old in world.revisits.items())


def test_revisits_and_gaps_are_in_a_checkpoint_where_it_has_them():
    world = make_world()
    world.revisits, world.gaps = {30: 20, 20: 0}, {0, 20}
    arrays = world.arrays()
    again = WorldMap()
    again.restore(arrays)
    assert again.revisits == world.revisits
    assert again.gaps == world.gaps
    del arrays["revisits"], arrays["gaps"]
    again.restore(arrays)
    assert again.revisits == {}
    assert again.gaps == set()


def test_observations_are_those_of_landmarks():
    ids, frames, xy = make_world().observations()
    assert set(ids.tolist()) <= {1, 2, 3, 5, 6}
    assert len(ids) == len(frames) == len(xy)
    assert sorted(frames[ids == 3].tolist()) == [0, 10, 20, 30]


def test_arrays_bring_the_map_back():
    world = make_world()
    arrays = world.arrays()
    assert all(isinstance(a, np.ndarray) and not a.dtype.hasobject for a in arrays.values())
    again = WorldMap()
    again.restore(arrays)
    for name, array in again.arrays().items():
        assert np.array_equal(array, arrays[name]), name
    assert again.keyframes[2].submap == 1
    assert np.array_equal(again.keyframes[2].edge, world.keyframes[2].edge)
    assert again.guesses[0] == world.guesses[0]
    assert np.array_equal(again.guesses[1].covariance, world.guesses[1].covariance)
    assert again.guesses[1].frame_id == 20


def test_later_parts_of_older_checkpoints_may_be_anywhere():
    arrays = {name: array for name, array in make_world().arrays().items() if not name.startswith("guesses")}
    again = WorldMap()
    again.restore(arrays)
    assert again.guesses == {1: GuessedPlace(20, None)}, "its place was guessed, and nothing tells how well"


def test_observations_of_older_checkpoints_have_no_edges():
    arrays = make_world().arrays()
    del arrays["keyframes.edge"]
    again = WorldMap()
    again.restore(arrays)
    assert not again.keyframes[2].edge.any()
    again.keyframes[2].drop_observations(np.arange(6) == 2)
    assert again.keyframes[2].edge.shape == (5, 2)


def test_contradicting_arrays_are_refused():
    arrays = make_world().arrays()
    with pytest.raises(ValueError, match="refer to keyframe 999"):
        WorldMap().restore({**arrays, "frames.keyframe_id": arrays["frames.keyframe_id"] * 0 + 999})
    with pytest.raises(ValueError, match="guesses refer to keyframe 999"):
        WorldMap().restore({**arrays, "guesses": np.array([[1, 20], [0, 999]])})
    del arrays["guesses.is_known"]
    with pytest.raises(KeyError, match="guesses.is_known"):
        WorldMap().restore(arrays)
    arrays = make_world().arrays()
    missing = {k: v for k, v in arrays.items() if k != "landmarks.xyz"}
    with pytest.raises(KeyError):
        WorldMap().restore(missing)


@pytest.mark.parametrize("name", sorted(make_world().arrays()))
def test_an_array_that_does_not_fit_the_others_is_refused_before_anything_changes(name):
    world = make_world()
    world.revisits, world.gaps = {30: 20, 20: 0}, {20}
    arrays = world.arrays()
    # Of revisits and gaps there may be any number.
    wrong = [arrays[name][:-1]] if name not in ("revisits", "gaps") else [arrays[name].ravel()[:, None]]
    wrong.append(np.stack([arrays[name], arrays[name]], axis=-1))
    if arrays[name].dtype.kind == "f":
        wrong.append(np.full_like(arrays[name], np.nan))
    for array in wrong:
        with pytest.raises(ValueError, match=r"must|refer"):
            world.restore({**arrays, name: array})
    assert np.array_equal(world.arrays()[name], arrays[name])


def test_an_empty_map_travels_too():
    world = WorldMap()
    world.restore(WorldMap().arrays())
    assert world.trajectory() == {}
    assert len(world.observations()[0]) == 0


def test_a_landmark_that_keeps_disagreeing_is_given_up():
    world = make_world()
    bad = world.landmarks.ids[[2]]
    for frame_id in range(3):
        world.note_sight(bad, np.array([False]), frame_id)
    world.note_sight(bad, np.array([True]), 3)
    for frame_id in range(4, 8):
        assert world.landmarks.rows(bad)[0] >= 0
        world.note_sight(bad, np.array([False]), frame_id)
    assert world.landmarks.rows(bad)[0] == -1
