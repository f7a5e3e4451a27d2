"""Tracks without a depth hold the rotation, and carry the pose on where landmarks run out."""

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, invert_transform, log_so3, make_transform
from semcast.server.geometry.weighting import NoiseModel
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


def test_a_camera_that_only_turns_needs_no_depth():
    world, xyz = scene(20, noise_px=0.0)
    turned = make_transform(exp_so3(np.array([0.02, -0.05, 0.01])), np.zeros(3))
    rays = rays_of(CAMERA, world, NOISE, np.arange(20, NUM), turned, submap=0)
    assert len(rays.row) == NUM - 20
    np.testing.assert_allclose(rays.spread_px, 0.0, atol=1e-9)
    np.testing.assert_allclose(project(rays.xyz, turned), project(xyz[20:], turned), atol=1e-6)
    np.testing.assert_allclose(rays.sigma_px, 0.5)


def test_a_track_is_known_from_the_newest_keyframe_that_saw_it():
    world, xyz = scene(20, noise_px=0.0)
    some = np.arange(100)
    seen = project(xyz[some], MOVED)
    world.add_keyframe(Keyframe(1, 1, MOVED, 0, some, seen, np.full(100, 0.5)))
    rays = rays_of(CAMERA, world, NoiseModel(0.5, 2.0), np.arange(20, NUM), np.eye(4), submap=0)
    assert rays.row.tolist() == list(range(NUM - 20))
    np.testing.assert_allclose(rays.sigma_px, np.where(rays.row < 80, 0.5 * np.exp(0.5), 0.5))


def test_what_is_not_known_of_the_depth_lies_along_the_spread():
    world, xyz = scene(20, noise_px=0.0)
    rays = rays_of(CAMERA, world, NOISE, np.arange(20, NUM), MOVED, submap=0)
    off = project(xyz[20:], MOVED) - project(rays.xyz, MOVED)
    length = np.linalg.norm(rays.spread_px, axis=1) / np.sqrt(len(rays.row))
    assert length.min() > 1.0
    along = rays.spread_px / np.linalg.norm(rays.spread_px, axis=1)[:, None]
    across = np.abs(off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0])
    assert np.linalg.norm(off, axis=1).max() > 3.0
    assert across.max() < 0.02, "but for rounding the true point lies on the line"
    # Inverse depths are within two standard deviations of the usual one here.
    assert (np.linalg.norm(off, axis=1) < 2.0 * length).all()


def test_tracks_no_keyframe_of_this_part_saw_are_no_rays():
    world, _ = scene(20)
    assert rays_of(CAMERA, world, NOISE, np.arange(1000, 1100), MOVED, submap=0) is None
    assert rays_of(CAMERA, world, NOISE, np.arange(20, NUM), MOVED, submap=1) is None
    mixed = rays_of(CAMERA, world, NOISE, np.array([30, 31, 5000]), MOVED, submap=0)
    assert mixed.row.tolist() == [0, 1]


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
    ids = np.arange(20, NUM)
    rays = rays_of(CAMERA, world, NOISE, ids, MOVED, submap=0, with_refuted=True)
    assert len(rays.row) == NUM - 20 - (0 if asked else num_refuted)
    assert len(rays_of(CAMERA, world, NOISE, ids, MOVED, submap=0).row) == NUM - 20 - num_refuted


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
