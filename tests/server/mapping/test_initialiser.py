"""When a map may begin, and from what."""

from dataclasses import replace

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, invert_transform, make_transform
from semcast.server.geometry.edges import alike
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.ambiguity import adjusted
from semcast.server.mapping.initialiser import Initialiser
from semcast.server.mapping.kept_frames import Observed
from semcast.server.mapping.scene_motion import motion_of_scene

CAMERA = Intrinsics(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)
NOISE = NoiseModel(1.0, 0.0)


def ride(num_frames, num_points=150, step_m=0.12, noise_px=0.3, seed=0, turn_rad=0.01, shake_rad=()):
    """Frames of a camera that moves sideways and may shake at first, and their true poses."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-3.0, -2.0, 3.0], [3.0, 2.0, 7.0], (num_points, 3))
    frames, poses = [], []
    for k in range(num_frames):
        yaw_rad = turn_rad * k + (shake_rad[k] if k < len(shake_rad) else 0.0)
        T_world_cam = make_transform(exp_so3(np.array([0.0, yaw_rad, 0.0])), [step_m * k, 0.0, 0.0])
        T = invert_transform(T_world_cam)
        xy = CAMERA.project(xyz @ T[:3, :3].T + T[:3, 3])
        seen = ((xy > 0) & (xy < [640, 480])).all(axis=1)
        xy = xy[seen] + noise_px * rng.standard_normal((int(seen.sum()), 2))
        frames.append(Observed(k, k * 100_000_000, np.flatnonzero(seen), xy, np.ones(len(xy))))
        poses.append(T_world_cam)
    return frames, poses


def begin(frames, *, waits=lambda k: False, noise=NOISE):
    """Index of the frame a map began with, and the map; None without one."""
    initialiser = Initialiser(CAMERA, "off", 1.0, 0)
    for k, frame in enumerate(frames):
        start = initialiser.add(frame, noise, waits=waits(k))
        if start is not None:
            return k, start
    return None


def test_a_map_begins_from_three_views_with_the_true_motion():
    frames, poses = ride(6)
    k, start = begin(frames)
    assert k == 2, "two views can't tell depth from its mirror image"
    assert len(start.keyframes) == 3
    true_way = (invert_transform(poses[0]) @ poses[k])[:3, 3]
    way = start.keyframes[-1].T_world_cam[:3, 3]
    assert way @ true_way / np.linalg.norm(way) / np.linalg.norm(true_way) > 0.99
    assert np.isclose(np.median(start.xyz[:, 2]), 1.0)


def test_a_landmark_of_a_start_has_the_mean_confidence_of_its_observations():
    rng = np.random.default_rng(5)
    frames = [replace(f, confidence=rng.uniform(0.0, 1.0, len(f.ids))) for f in ride(6)[0]]
    _, start = begin(frames)
    for number, landmark in enumerate(start.ids[:20]):
        seen = [k.confidence[k.ids == landmark] for k in start.keyframes]
        assert np.isclose(start.confidence[number], np.mean(np.concatenate(seen)))
    assert start.confidence.std() > 0.1


def test_no_relative_pose_is_looked_for_before_there_is_a_third_view(monkeypatch):
    sizes = []

    def counted(camera, xy0, xy1, *args, **options):
        sizes.append(len(xy0))
        return motion_of_scene(camera, xy0, xy1, *args, **options)

    monkeypatch.setattr("semcast.server.mapping.initialiser.motion_of_scene", counted)
    k, _ = begin(ride(6)[0])
    assert k == 2
    assert len(sizes) == 1


def test_few_points_wait_for_more_but_not_for_ever():
    frames, _ = ride(16, num_points=55, step_m=0.05)
    k, _ = begin(frames)
    assert k >= 11
    k, _ = begin(ride(16, num_points=150, step_m=0.05)[0])
    assert k < 11


def test_two_views_do_where_tracks_last_no_longer():
    frames, _ = ride(8, step_m=0.3)
    renewed = [
        Observed(f.frame_id, f.t_source_ns, f.ids + 1000 * (k // 2), f.xy, f.confidence)
        for k, f in enumerate(frames)
    ]
    k, start = begin(renewed)
    assert k == 5, "the third pair of views"
    assert len(start.keyframes) == 2


def test_standing_still_and_damaged_images_begin_nothing():
    still, _ = ride(20, step_m=0.0)
    still = [
        Observed(f.frame_id, f.t_source_ns, still[0].ids, still[0].xy, still[0].confidence) for f in still
    ]
    assert begin(still) is None
    frames, _ = ride(6)
    k, _ = begin(frames, waits=lambda k: k == 2)
    assert k == 3


@pytest.mark.parametrize("seed", [0, 3, 9])
def test_a_camera_that_turns_begins_nothing_with_tracks_that_err_by_pixels(seed):
    """A way of the camera is always found along which most of them err: two of these would begin a map."""
    rng = np.random.default_rng(seed)
    camera = Intrinsics(fx=260.0, fy=260.0, cx=159.5, cy=119.5, width=320, height=240)
    bearing = rng.uniform(-0.8, 1.6, 750)
    rays = np.column_stack([np.sin(bearing), rng.uniform(-0.5, 0.5, 750), np.cos(bearing)])
    initialiser = Initialiser(camera, "off", 1.0, 0)
    for k in range(14):
        turned = rays @ exp_so3(np.array([0.0, 0.06 * k, 0.0]))
        xy = camera.project(turned) + 2.5 * rng.standard_normal((750, 2))
        seen = (turned[:, 2] > 0.1) & ((xy > 0) & (xy < [320, 240])).all(axis=1)
        frame = Observed(k, k * 10**8, np.flatnonzero(seen), xy[seen], np.ones(int(seen.sum())))
        assert initialiser.add(frame, NOISE) is None


def looking_round(num_frames, way_m, seed=0):
    """Frames, 30 a second, of a hand that turns to and fro before walls and goes little; its true poses.

    Tracks drift, and are others when they come into view again.
    """
    rng = np.random.default_rng(seed)
    bearing = rng.uniform(-1.5, 1.5, 1400)
    depth_m = 2.5 + 0.6 * np.sin(3 * bearing) + 0.15 * rng.standard_normal(1400)
    rays = np.column_stack([np.sin(bearing), rng.uniform(-0.55, 0.55, 1400), np.cos(bearing)])
    xyz, ids, drift_px = depth_m[:, None] * rays, np.zeros(1400, np.int64), np.zeros((1400, 2))
    num_tracks, was_seen = 0, np.zeros(1400, bool)
    frames, poses = [], []
    for k in range(num_frames):
        turn, right, down = np.sin(2 * np.pi / 30 * k * np.array([0.33, 0.4, 0.3]) + (0.0, 1.0, 0.0))
        T_world_cam = make_transform(
            exp_so3(np.array([0.0, 0.55 * turn, 0.0])), [way_m * right, 0.6 * way_m * down, 0.0]
        )
        T = invert_transform(T_world_cam)
        xyz_cam = xyz @ T[:3, :3].T + T[:3, 3]
        xy = CAMERA.project(xyz_cam)
        seen = (xyz_cam[:, 2] > 0.1) & ((xy > 0) & (xy < [640, 480])).all(axis=1)
        begun = np.flatnonzero(seen & ~was_seen)
        ids[begun], drift_px[begun] = num_tracks + np.arange(len(begun)), 0.0
        num_tracks, was_seen = num_tracks + len(begun), seen
        drift_px += 0.15 * rng.standard_normal((1400, 2))
        rows = np.flatnonzero(seen)
        rows = rows[np.argsort(ids[rows])][:450]
        frames.append(Observed(k, k * 33_000_000, ids[rows], xy[rows] + drift_px[rows], np.ones(len(rows))))
        poses.append(T_world_cam)
    return frames, poses


def test_a_map_begins_though_the_oldest_frame_in_sight_shares_but_a_strip():
    frames, poses = looking_round(40, way_m=0.05)
    _, start = begin(frames, waits=lambda k: k < 30, noise=NoiseModel(0.7, 0.0))
    first, last = (poses[start.keyframes[k].frame_id] for k in (0, -1))
    true_way = (invert_transform(first) @ last)[:3, 3]
    way = (invert_transform(start.keyframes[0].T_world_cam) @ start.keyframes[-1].T_world_cam)[:3, 3]
    assert way @ true_way / np.linalg.norm(way) / np.linalg.norm(true_way) > 0.998


def never_decided(monkeypatch):
    """Let no start be decided; the list says for each attempt whether it was to be the last."""
    asked = []

    def never(problem, carried, *, at_last):
        asked.append(at_last)
        return None, []

    monkeypatch.setattr("semcast.server.mapping.initialiser.decide", never)
    return asked


def same_view(frame, num_frames, first_id):
    return [
        Observed(first_id + k, (first_id + k) * 10**8, frame.ids, frame.xy, frame.confidence)
        for k in range(num_frames)
    ]


def test_standing_still_first_does_not_wear_out_the_patience(monkeypatch):
    asked = never_decided(monkeypatch)
    moving, _ = ride(40, step_m=0.05)
    assert begin([*same_view(moving[0], 30, -30), *moving[1:]]) is None
    assert len(asked) > 12
    assert asked[:12] == [False] * 12
    assert asked[12] is True


def test_a_start_is_looked_at_again_when_the_tracks_have_become_longer(monkeypatch):
    asked = never_decided(monkeypatch)
    moving, _ = ride(8, step_m=0.05)
    begin(moving)
    so_far = len(asked)
    assert so_far > 3
    asked.clear()
    begin([*moving, *same_view(moving[-1], 20, 8)])
    assert len(asked) == so_far


def test_a_hand_that_turned_away_and_back_holds_no_second_look_up(monkeypatch):
    asked = never_decided(monkeypatch)
    shaken, _ = ride(10, step_m=0.05, turn_rad=0.0, shake_rad=(0.0, 0.08, 0.12, 0.08))
    begin(shaken)
    assert len(asked) > 3


def test_a_few_tracks_that_last_long_do_not_tie_the_start_to_an_old_frame():
    """A third of them goes its own way: those left are too few to begin with."""
    frames, _ = ride(20, step_m=0.05, turn_rad=0.0)
    last = frames[0].ids[:44]
    own_way = np.random.default_rng(3).uniform(-8.0, 8.0, (150, 2)) * (np.arange(150) < last[14])[:, None]
    later = [
        replace(f, ids=np.where(np.isin(f.ids, last), f.ids, 1000 + f.ids), xy=f.xy + k * own_way[f.ids])
        for k, f in enumerate(frames[3:], start=3)
    ]
    k, start = begin([*frames[:3], *later], waits=lambda k: k < 3)
    assert start.keyframes[0].frame_id >= 3
    assert k < 16


def test_a_camera_that_stops_too_early_gets_the_better_start_in_the_end(monkeypatch):
    asked = never_decided(monkeypatch)
    moving, _ = ride(6, step_m=0.05)
    begin([*moving, *same_view(moving[-1], 62, 6)])
    assert asked[0] is False
    assert asked[-1] is True


@pytest.mark.parametrize(
    "hopeless", [{"doubt": 3.0}, {"doubt": 0.5, "ok": False}], ids=["doubtful", "failed"]
)
def test_structures_go_on_to_the_next_attempt_with_their_doubt(monkeypatch, hopeless):
    frames, poses = ride(8, step_m=0.05)
    asked = []

    def undecided(problem, carried, *, at_last):
        asked.append((problem, carried))
        structure = adjusted(problem)
        return None, [structure, replace(structure, doubt=0.4), replace(structure, **hopeless)]

    monkeypatch.setattr("semcast.server.mapping.initialiser.decide", undecided)
    assert begin(frames) is None
    assert asked[0][1] == []
    problem, carried = asked[-1]
    assert [doubt for _, doubt in carried] == [0.0, 0.4], "the third is beyond hope"
    for again, _ in carried:
        np.testing.assert_array_equal(again.xy, problem.xy)
        way = (invert_transform(again.T_world_cam[0]) @ again.T_world_cam[-1])[:3, 3]
        true_way = (invert_transform(poses[0]) @ poses[7])[:3, 3]
        assert way @ true_way / np.linalg.norm(way) / np.linalg.norm(true_way) > 0.98


def test_a_start_is_the_same_with_ids_that_were_renewed_on_the_way():
    frames, _ = ride(8)
    k, start = begin(frames)
    initialiser = Initialiser(CAMERA, "off", 1.0, 0)
    for o in frames[:k]:
        assert initialiser.add(o, NOISE) is None
    before = initialiser.ids
    after = 10**6 + np.arange(len(before))
    initialiser.renew(before, after)
    assert np.array_equal(initialiser.ids, after)
    last = replace(frames[k], ids=10**6 + np.searchsorted(before, frames[k].ids))
    again = initialiser.add(last, NOISE)
    assert np.array_equal(again.ids - 10**6, np.searchsorted(before, start.ids))
    assert np.array_equal(again.xyz, start.xyz)


def test_of_frames_that_wait_long_a_few_keep_their_image_and_the_start_takes_those():
    image = np.full((480, 640), 128, np.uint8)
    frames = [replace(f, grey=image) for f in ride(140, step_m=0.003, turn_rad=0.0)[0]]
    initialiser = Initialiser(CAMERA, "off", 1.0, 0)
    start = None
    for frame in frames:
        start = initialiser.add(frame, NOISE)
        with_image = [o.frame_id for o in initialiser.history if o.grey is not None]
        assert len(with_image) <= 33
        assert (with_image[0], with_image[-1]) == (0, frame.frame_id)
        if start is not None:
            break
    assert len(initialiser.history) > 50, "all frames wait for their poses"
    chosen = [k.frame_id for k in start.keyframes]
    assert len(chosen) == 5
    assert set(chosen) <= set(with_image)
    assert np.diff(chosen).max() < 0.4 * frame.frame_id, "spread out"


def test_tracks_that_stand_hold_no_start_up_once_they_are_left_out():
    """A bonnet: its tracks last, those of the scene pass, and between far views most tracks stand."""
    rng = np.random.default_rng(7)
    bonnet = np.column_stack((rng.uniform(0, 640, 300), rng.uniform(400, 480, 300)))
    ids = 1000 + np.arange(300)
    frames = [
        replace(
            f,
            ids=np.concatenate([f.ids, ids]),
            xy=np.concatenate([f.xy, bonnet]),
            confidence=np.ones(len(f.ids) + 300),
            edge=alike(),
        )
        for f in ride(8)[0]
    ]
    assert begin(frames) is None
    initialiser = Initialiser(CAMERA, "off", 1.0, 0)
    for frame in frames[:6]:
        assert initialiser.add(frame, NOISE) is None
    initialiser.leave_out(ids)
    assert not np.isin(initialiser.ids, ids).any()
    start = initialiser.add(frames[6].without(ids), NOISE)
    assert start is not None
    assert not np.isin(start.ids, ids).any()


def test_a_start_is_looked_at_anew_without_tracks_that_were_left_out(monkeypatch):
    asked = never_decided(monkeypatch)
    initialiser = Initialiser(CAMERA, "off", 1.0, 0)
    frames, _ = ride(8, step_m=0.05)
    for frame in frames:
        initialiser.add(frame, NOISE)
    so_far = len(asked)
    initialiser.add(same_view(frames[-1], 1, 8)[0], NOISE)
    assert len(asked) == so_far
    left_out = frames[-1].ids[:20]
    initialiser.leave_out(left_out)
    initialiser.add(same_view(frames[-1], 1, 9)[0].without(left_out), NOISE)
    assert len(asked) == so_far + 1


def before_what_stands(frames, num_standing=100):
    """Frames that see a number of points more, which never move, and their ids."""
    rng = np.random.default_rng(7)
    ids = 100_000 + np.arange(num_standing)
    standing = np.column_stack((rng.uniform(0, 640, num_standing), rng.uniform(400, 480, num_standing)))
    both = [
        replace(
            f,
            ids=np.concatenate([f.ids, ids]),
            xy=np.concatenate([f.xy, standing]),
            confidence=np.ones(len(f.ids) + num_standing),
            edge=alike(),
        )
        for f in frames
    ]
    return both, ids


def test_no_start_rests_on_suspect_tracks():
    frames, ids = before_what_stands(ride(6)[0])
    initialiser = Initialiser(CAMERA, "off", 1.0, 0)
    found = [initialiser.add(frame, NOISE, ids) for frame in frames]
    start = next(start for start in found if start is not None)
    assert not np.isin(ids, start.ids).any()
    assert not any(np.isin(ids, keyframe.ids).any() for keyframe in start.keyframes)


def test_what_stands_ties_no_start_to_frames_whose_scene_is_out_of_sight():
    """The camera rests, then sees another scene, and goes: old and new frames share only what stands."""
    rest = same_view(ride(1)[0][0], 3, 0)
    ahead = [
        replace(f, frame_id=f.frame_id + 3, t_source_ns=(f.frame_id + 3) * 100_000_000, ids=f.ids + 1000)
        for f in ride(4)[0]
    ]
    frames, ids = before_what_stands([*rest, *ahead])
    initialiser = Initialiser(CAMERA, "off", 1.0, 0)
    found = [initialiser.add(frame, NOISE, ids) for frame in frames]
    start = next(start for start in found if start is not None)
    assert not np.isin(start.ids, ids).any()
    assert min(k.frame_id for k in start.keyframes) >= 3


def test_a_start_is_made_from_near_frames_when_what_stands_hid_for_long_that_the_scene_moves():
    """Most tracks are a bonnet's, and that shows late: by then the first frames share few of the scene's."""
    frames, ids = before_what_stands(ride(20)[0], 300)
    initialiser = Initialiser(CAMERA, "off", 1.0, 0)
    for frame in frames[:14]:
        assert initialiser.add(frame, NOISE) is None
    start = initialiser.add(frames[14], NOISE, ids) or initialiser.add(frames[15], NOISE, ids)
    assert start is not None
    assert min(keyframe.frame_id for keyframe in start.keyframes) >= 12
