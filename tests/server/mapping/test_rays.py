"""Tracks without a depth hold the rotation, and carry the pose on where landmarks run out."""

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, invert_transform, log_so3, make_transform
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping import tracker
from semcast.server.mapping.rays import rays_of
from semcast.server.mapping.sight import Seen
from semcast.server.mapping.tracker import track_pose
from semcast.server.mapping.world_map import Keyframe, WorldMap

CAMERA = Intrinsics(fx=500, fy=500, cx=319.5, cy=239.5, width=640, height=480)
NOISE = NoiseModel(0.5, 0.0)
NUM = 240


def project(xyz, T_world_cam):
    T = invert_transform(T_world_cam)
    return CAMERA.project(xyz @ T[:3, :3].T + T[:3, 3])


def scene(num_landmarks, seed=0, noise_px=0.5):
    """A keyframe at the origin with tracks all over the image, of which those furthest left are landmarks.

    Returns the map and where the points truly are.
    """
    rng = np.random.default_rng(seed)
    depth = rng.uniform(2.5, 6.0, NUM)
    xy = np.column_stack((np.sort(rng.uniform(20, 620, NUM)), rng.uniform(20, 460, NUM)))
    xyz = CAMERA.unproject(xy) * depth[:, None]
    ids = np.arange(NUM)
    world = WorldMap()
    world.add_keyframe(
        Keyframe(
            frame_id=0,
            t_source_ns=0,
            T_world_cam=np.eye(4),
            submap=0,
            ids=ids,
            xy=xy + noise_px * rng.standard_normal(xy.shape),
            confidence=np.ones(NUM),
        )
    )
    some = slice(0, num_landmarks)
    rgb = np.zeros((num_landmarks, 3), np.uint8)
    world.add_landmarks(ids[some], xyz[some], rgb, np.ones(num_landmarks), 0, 0)
    return world, xyz


MOVED = make_transform(exp_so3(np.array([0.01, -0.04, 0.005])), [0.06, 0.01, 0.03])


def rotation_error_deg(T_world_cam):
    return np.degrees(np.linalg.norm(log_so3(T_world_cam[:3, :3].T @ MOVED[:3, :3])))


def track(world, ids, xy, guess, **options):
    seen = Seen(ids, xy, np.ones(len(ids)))
    return track_pose(CAMERA, world, NOISE, seen, guess, submap=0, seed=0, **options)


def rays_among(world, ids, xy, noise=NOISE, confidence=1.0, **options):
    """Rays of the tracks with these ids; none in the first part of the map is another one's."""
    seen = Seen(ids, xy, np.full(len(ids), confidence))
    return rays_of(CAMERA, world, noise, seen, **{"submap": 0, **options})


def test_a_track_is_on_a_ray_from_the_newest_keyframe_that_saw_it():
    world, xyz = scene(20, noise_px=0.0)
    some, rest = np.arange(100), np.arange(20, NUM)
    world.add_keyframe(Keyframe(1, 1, MOVED, 0, some, project(xyz[some], MOVED), np.full(100, 0.5)))
    rays = rays_among(world, rest, project(xyz[rest], MOVED), NoiseModel(0.5, 2.0))
    by_newest = rest < 100
    # The newest keyframe comes first; it is in the same place, and what it saw is known to half the variance.
    assert len(rays) == NUM - 20
    np.testing.assert_allclose(rays.origin.T, np.where(np.sort(~by_newest)[:, None], 0.0, MOVED[:3, 3]))
    away = xyz[rest] - rays.origin.T
    away /= (invert_transform(MOVED)[2, :3] @ away.T)[:, None] ** by_newest[:, None]
    away /= away[:, 2:] ** ~by_newest[:, None]
    np.testing.assert_allclose(rays.direction.T, away, atol=1e-9)
    variance = 0.25 + 0.25 * np.where(by_newest, np.exp(2.0 * 0.5), 1.0)
    np.testing.assert_allclose(rays.covariance, [variance, np.zeros(NUM - 20), variance], atol=1e-12)
    depth = np.median(xyz[:20] @ invert_transform(MOVED)[2, :3] + invert_transform(MOVED)[2, 3])
    np.testing.assert_allclose(rays.min_depth[by_newest], 0.05 * depth)


def test_what_neither_image_is_sure_of_is_no_proof():
    world, xyz = scene(20, noise_px=0.0)
    ids = np.arange(20, NUM)
    sure, unsure = (
        rays_among(world, ids, project(xyz[ids], MOVED), NoiseModel(1.0, 8.0), c) for c in (1.0, 0.0)
    )
    np.testing.assert_allclose(sure.gate, 3.035)
    # Its standard deviation is e^4 times as large, and the gate grows to three times as many pixels at most.
    np.testing.assert_allclose(unsure.gate, 3.035 * 3.0 / np.exp(4.0))


def test_true_points_are_on_their_rays():
    world, xyz = scene(20, noise_px=0.0)
    rays = rays_among(world, np.arange(20, NUM), project(xyz[20:], MOVED))
    sizes = rays.sizes(CAMERA, invert_transform(MOVED))
    assert sizes.max() < 1e-6
    turned = MOVED @ make_transform(exp_so3(np.array([0.0, 0.03, 0.01])), np.zeros(3))
    assert np.median(rays.sizes(CAMERA, invert_transform(turned))) > 3.0


def test_tracks_no_keyframe_of_this_part_saw_are_no_rays():
    world, xyz = scene(20)
    xy = project(xyz, MOVED)
    assert rays_among(world, np.arange(1000, 1100), xy[:100]) is None
    assert rays_among(world, np.arange(20, NUM), xy[20:], submap=1) is None
    mixed = rays_among(world, np.array([30, 31, 5000]), xy[:3])
    np.testing.assert_allclose(mixed.observed.T + np.array([CAMERA.cx, CAMERA.cy]), xy[:2])


def test_tracks_without_depth_hold_the_rotation():
    with_rays, without = [], []
    for seed in range(16):
        world, xyz = scene(25, seed)
        rng = np.random.default_rng(100 + seed)
        xy = project(xyz, MOVED) + 0.5 * rng.standard_normal((NUM, 2))
        ids = np.arange(NUM)
        with_rays.append(rotation_error_deg(track(world, ids, xy, np.eye(4)).T_world_cam))
        without.append(rotation_error_deg(track(world, ids[:25], xy[:25], np.eye(4)).T_world_cam))
    assert np.median(with_rays) < 0.75 * np.median(without)


@pytest.mark.parametrize("times_as_deep", [0.4, 3.0])
def test_a_wrong_usual_depth_costs_little(times_as_deep):
    """All new tracks are nearer or further than the landmarks: what is wrong with one is wrong with all."""
    errors = []
    for seed in range(12):
        world, xyz = scene(100, seed)
        xyz[100:] *= times_as_deep
        rng = np.random.default_rng(100 + seed)
        xy = project(xyz, MOVED) + 0.5 * rng.standard_normal((NUM, 2))
        ids = np.arange(NUM)
        poses = track(world, ids, xy, np.eye(4)), track(world, ids[:100], xy[:100], np.eye(4))
        errors.append([np.linalg.norm(p.T_world_cam[:3, 3] - MOVED[:3, 3]) for p in poses])
    with_rays, without = np.median(errors, axis=0)
    assert with_rays < 1.5 * without


def tilted_patch_scene(seed):
    """Sixty landmarks on a small part of a wall, which the map takes to be turned by a few degrees.

    Returns the map and where the points truly are.
    """
    rng = np.random.default_rng(seed)
    world, xyz = scene(0, seed)
    xy, patch = world.keyframes[-1].xy, slice(0, 60)
    xy[patch] = rng.uniform((300, 200), (340, 290), (60, 2))
    xyz[patch] = CAMERA.unproject(xy[patch]) * 4.0
    in_map = xyz[patch] * (1.0 + 0.03 * (xy[patch, :1] - 320.0) / 40.0)
    world.add_landmarks(np.arange(60), in_map, np.zeros((60, 3), np.uint8), np.ones(60), 0, 0)
    return world, xyz


def test_landmarks_that_lie_together_leave_the_turn_to_the_other_tracks(monkeypatch):
    """A small flat patch seen after a wide step fits two poses, and its own small error decides which."""
    turned = make_transform(exp_so3(np.array([0.02, -0.2, 0.01])), [0.8, 0.05, 0.1])
    guess = turned @ make_transform(exp_so3(np.array([0.0, 0.02, 0.0])), np.zeros(3))
    errors = {}
    for in_doubt_px in (tracker._TURN_IN_DOUBT_PX, np.inf):
        monkeypatch.setattr(tracker, "_TURN_IN_DOUBT_PX", in_doubt_px)
        errors[in_doubt_px] = []
        for seed in range(4):
            world, xyz = tilted_patch_scene(seed)
            rng = np.random.default_rng(100 + seed)
            xy = project(xyz, turned) + 0.5 * rng.standard_normal((NUM, 2))
            pose = track(world, np.arange(NUM), xy, guess)
            off = log_so3(pose.T_world_cam[:3, :3].T @ turned[:3, :3])
            errors[in_doubt_px].append(np.degrees(np.linalg.norm(off)))
    with_rays, without = errors.values()
    assert max(with_rays) < 0.2
    assert min(without) > 5.0, "otherwise this shows nothing"


def test_tracks_that_slid_together_do_not_overrule_landmarks_that_lie_together():
    """Few landmarks leave the turn in doubt; what slid along an edge elsewhere is sure of a wrong one."""
    turned = make_transform(exp_so3(np.array([0.02, -0.2, 0.01])), [0.8, 0.05, 0.1])
    errors = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        world, xyz = scene(0, seed)
        xy, patch, corner = world.keyframes[-1].xy, slice(0, 26), slice(26, 58)
        xy[patch], xy[corner] = rng.uniform((300, 200), (340, 260), (26, 2)), (500, 380)
        xy[corner] += rng.uniform(0, (100, 80), (32, 2))
        xyz[patch] = CAMERA.unproject(xy[patch]) * rng.uniform(3.9, 4.1, (26, 1))
        xyz[corner] = CAMERA.unproject(xy[corner]) * 5.0
        world.add_landmarks(np.arange(26), xyz[patch], np.zeros((26, 3), np.uint8), np.ones(26), 0, 0)
        seen_xy = project(xyz, turned)[:58] + 0.5 * rng.standard_normal((58, 2))
        seen_xy[corner] += (0, 35)
        pose = track(world, np.arange(58), seen_xy, turned)
        off = log_so3(pose.T_world_cam[:3, :3].T @ turned[:3, :3])
        errors.append(np.degrees(np.linalg.norm(off)))
    assert np.median(errors) < 2.0


def test_tracks_carry_the_pose_on_where_landmarks_all_but_run_out():
    world, xyz = scene(20)
    xy = project(xyz, MOVED)
    ids = np.arange(NUM)
    assert track(world, ids[12:], xy[12:], np.eye(4)) is None, "eight landmarks are too few"
    pose = track(world, ids[12:], xy[12:], np.eye(4), may_carry=True)
    assert rotation_error_deg(pose.T_world_cam) < 0.3
    assert len(pose.ids) == 8, "only landmarks are reported"
    few = {"few tracks": slice(12, 60), "no landmark to hold the scale": slice(20, NUM)}
    for why, used in few.items():
        assert track(world, ids[used], xy[used], np.eye(4), may_carry=True) is None, why
    assert track(world, ids[12:], xy[12:], None, may_carry=True) is None, "nothing to go on from"


def test_a_pose_is_not_carried_on_against_the_landmarks_in_sight():
    world, xyz = scene(28)
    xy = project(xyz, MOVED)
    xy[5:28] += np.random.default_rng(2).uniform(20, 60, (23, 2))
    assert track(world, np.arange(NUM), xy, MOVED, may_carry=True) is None


@pytest.mark.parametrize("num_landmarks", [60, 8])
def test_tracks_that_fit_no_pose_change_nothing(num_landmarks):
    world, xyz = scene(60)
    xy = project(xyz, MOVED)
    rng = np.random.default_rng(1)
    xy[60:] += rng.uniform(-60, 60, (NUM - 60, 2))
    ids = np.arange(NUM)
    used = np.r_[0:num_landmarks, 60:NUM]
    pose = track(world, ids[used], xy[used], np.eye(4), may_carry=True)
    if num_landmarks == 60:
        alone = track(world, ids[:60], xy[:60], np.eye(4))
        np.testing.assert_array_equal(pose.T_world_cam, alone.T_world_cam)
    else:
        assert pose is None


@pytest.mark.parametrize(("num_refuted", "asked"), [(40, False), (60, True)])
def test_a_few_refuted_tracks_have_slipped_and_are_never_asked(num_refuted, asked):
    world, _ = scene(20)
    world.keyframes[-1].refuted = np.arange(NUM - num_refuted, NUM)
    ids, xy = np.arange(20, NUM), np.zeros((NUM - 20, 2))
    assert len(rays_among(world, ids, xy, with_refuted=True)) == NUM - 20 - (0 if asked else num_refuted)
    assert len(rays_among(world, ids, xy)) == NUM - 20 - num_refuted


def refuted_scene(seed):
    """A map whose keyframe refutes all tracks but its landmarks; what it sees after ``MOVED``."""
    world, xyz = scene(25, seed)
    world.keyframes[-1].refuted = np.arange(25, NUM)
    xy = project(xyz, MOVED) + 0.5 * np.random.default_rng(100 + seed).standard_normal((NUM, 2))
    return world, xy


def test_refuted_tracks_hold_the_rotation_where_landmarks_bear_them_out():
    """Keyframes that turned wrongly refute the far view, whatever it tells of the next frame."""
    with_rays, without = [], []
    ids = np.arange(NUM)
    for seed in range(16):
        world, xy = refuted_scene(seed)
        with_rays.append(rotation_error_deg(track(world, ids, xy, np.eye(4)).T_world_cam))
        without.append(rotation_error_deg(track(world, ids[:25], xy[:25], np.eye(4)).T_world_cam))
    assert np.median(with_rays) < 0.75 * np.median(without)


def test_refuted_tracks_that_landmarks_contradict_leave_the_others_to_hold_the_rotation():
    """They are on a lorry that turns otherwise than the camera; those that are not still steady it."""
    ids, turned = np.arange(NUM), make_transform(exp_so3(np.array([0.0, 0.02, 0.0])), np.zeros(3))
    still = np.r_[0:80]
    for seed in range(4):
        world, xyz = scene(25, seed)
        world.keyframes[-1].refuted = ids[80:]
        xy = project(xyz, MOVED) + 0.5 * np.random.default_rng(100 + seed).standard_normal((NUM, 2))
        xy[80:] = project(xyz[80:], MOVED @ turned)
        pose, alone = track(world, ids, xy, np.eye(4)), track(world, still, xy[still], np.eye(4))
        np.testing.assert_array_equal(pose.T_world_cam, alone.T_world_cam)
