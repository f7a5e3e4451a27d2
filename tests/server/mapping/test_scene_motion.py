"""Something large that moves from the first frame on is not taken for the scene."""

from dataclasses import replace

import numpy as np

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, invert_transform, make_transform
from semcast.server.geometry.two_view import estimate_two_view
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.initialiser import Initialiser
from semcast.server.mapping.kept_frames import Observed
from semcast.server.mapping.scene_motion import motion_of_scene

CAMERA = Intrinsics(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)
#: Points of the scene, and of a lorry: it has more of them on less of the image.
NUM_SCENE, NUM_LORRY = 120, 220
STEP_M = 0.12
NOISE = NoiseModel(0.7, 0.0)


def lorry_way_m(frame_id):
    """How far the lorry has gone; not straight on, or no image would tell that it moves."""
    return np.array([0.06, 0.05, -0.1]) * frame_id + np.array([0.0, -0.01, 0.0]) * frame_id**2


def frames_of(num_frames, *, is_there=True, moves=1.0, step_m=STEP_M, seed=0, noise_px=0.3):
    """Frames of a camera that moves sideways, and its poses; ids from ``NUM_SCENE`` on are the lorry's."""
    rng = np.random.default_rng(seed)
    scene = CAMERA.unproject(rng.uniform((230, 0), (640, 480), (NUM_SCENE, 2))) * rng.uniform(
        3, 9, (NUM_SCENE, 1)
    )
    lorry = CAMERA.unproject(rng.uniform((10, 150), (200, 390), (NUM_LORRY, 2)))
    lorry *= rng.uniform(2.5, 4.0, (NUM_LORRY, 1))
    frames, poses = [], []
    for k in range(num_frames):
        T_world_cam = make_transform(exp_so3(np.array([0.0, 0.01 * k, 0.0])), [step_m * k, 0.0, 0.0])
        xyz = np.concatenate([scene, lorry + moves * lorry_way_m(k)]) if is_there else scene
        T = invert_transform(T_world_cam)
        xy = CAMERA.project(xyz @ T[:3, :3].T + T[:3, 3])
        seen = ((xy > 0) & (xy < [640, 480])).all(axis=1)
        xy = xy[seen] + noise_px * rng.standard_normal((int(seen.sum()), 2))
        frames.append(Observed(k, k * 10**8, np.flatnonzero(seen), xy, np.ones(len(xy))))
        poses.append(T_world_cam)
    return frames, poses


def way_off_deg(way, true_way):
    cos = way @ true_way / np.linalg.norm(way) / np.linalg.norm(true_way)
    return float(np.degrees(np.arccos(np.clip(cos, -1.0, 1.0))))


def begin(frames):
    """The newest frame when a map began, and the map; None without one."""
    initialiser = Initialiser(CAMERA, "off", 1.0, 0)
    for frame in frames:
        start = initialiser.add(frame, NoiseModel(1.0, 0.0))
        if start is not None:
            return frame.frame_id, start
    return None


def compared(frame0, frame1):
    """What is taken for the scene's motion between two frames, and the motion of most tracks."""
    ids, row0, row1 = np.intersect1d(frame0.ids, frame1.ids, return_indices=True)
    xy0, xy1, confidence = frame0.xy[row0], frame1.xy[row1], np.ones(len(ids))
    found = estimate_two_view(CAMERA, xy0, xy1, threshold_px=1.0)
    return ids, motion_of_scene(CAMERA, xy0, xy1, confidence, NOISE, mode="off", seed=0), found


def test_the_scene_is_what_takes_up_more_of_the_image_not_what_has_more_tracks():
    frames, poses = frames_of(3)
    ids, scene, found = compared(frames[0], frames[2])
    true_way = invert_transform(poses[2])[:3, 3]
    assert way_off_deg(found.T_cam1_cam0[:3, 3], true_way) > 30, "else this tests nothing"
    assert way_off_deg(scene.motion.T_cam1_cam0[:3, 3], true_way) < 3
    assert scene.alone[ids >= NUM_SCENE].mean() > 0.9
    assert scene.alone[ids < NUM_SCENE].mean() < 0.05


def test_where_all_is_at_rest_the_motion_of_most_tracks_stays():
    frames, _ = frames_of(3, moves=0.0)
    _, scene, found = compared(frames[0], frames[2])
    assert np.allclose(scene.motion.T_cam1_cam0, found.T_cam1_cam0, atol=0.02)
    assert not scene.alone.any()
    assert not scene.is_contested


def walker_frames():
    """Two frames of a hand that went 26 mm in a room, and of someone who walked before it; and the way."""
    rng = np.random.default_rng(3)
    room = CAMERA.unproject(rng.uniform((0, 0), (640, 480), (240, 2))) * rng.uniform(2.0, 4.0, (240, 1))
    walker = CAMERA.unproject(rng.uniform((230, 60), (400, 470), (80, 2))) * rng.uniform(1.3, 1.5, (80, 1))
    T_cam1_cam0 = invert_transform(
        make_transform(exp_so3(np.array([0.006, 0.012, 0.0])), [0.0, 0.009, 0.024])
    )
    frames = []
    for k, T in enumerate((np.eye(4), T_cam1_cam0)):
        xyz = np.concatenate([room, walker + np.array([0.12, 0.03, 0.0]) * k])
        xy = CAMERA.project(xyz @ T[:3, :3].T + T[:3, 3])
        seen = ((xy > 0) & (xy < [640, 480])).all(axis=1)
        xy = xy[seen] + 0.05 * rng.standard_normal((int(seen.sum()), 2))
        frames.append(Observed(k, k * 10**8, np.flatnonzero(seen), xy, np.ones(len(xy))))
    return frames, T_cam1_cam0[:3, 3]


def test_a_motion_that_explains_room_and_walker_a_little_badly_is_neither_s():
    frames, true_way = walker_frames()
    ids, scene, found = compared(*frames)
    assert way_off_deg(found.T_cam1_cam0[:3, 3], true_way) > 20, "else this tests nothing"
    assert way_off_deg(scene.motion.T_cam1_cam0[:3, 3], true_way) < 4
    assert scene.alone[ids >= 240].mean() > 0.9
    assert scene.alone[ids < 240].mean() < 0.05


def test_noise_is_what_tracks_of_the_scene_show_and_no_more_than_was_expected():
    for noise_px, expected_px in ((0.2, 0.2), (1.5, NOISE.sigma0_px)):
        frames, _ = frames_of(3, is_there=False, noise_px=noise_px)
        _, scene, _ = compared(frames[0], frames[2])
        assert 0.7 * expected_px < scene.noise.sigma0_px < 1.3 * expected_px


def test_a_map_begins_with_the_scene_and_without_what_moves_by_itself():
    frames, poses = frames_of(8)
    k, start = begin(frames)
    way, true_way = start.keyframes[-1].T_world_cam[:3, 3], poses[k][:3, 3]
    assert way_off_deg(way, true_way) < 3
    assert (start.ids < NUM_SCENE).sum() > 80
    # Some were out of sight in one of the two images that were compared.
    assert (start.ids >= NUM_SCENE).sum() < 0.2 * NUM_LORRY


def test_a_start_waits_while_two_motions_explain_about_as_much_but_not_for_ever(monkeypatch):
    frames, _ = frames_of(20, is_there=False, step_m=0.04)
    at_once, _ = begin(frames)

    def contested(*args, **options):
        return replace(motion_of_scene(*args, **options), is_contested=True)

    monkeypatch.setattr("semcast.server.mapping.initialiser.motion_of_scene", contested)
    k, _ = begin(frames)
    assert at_once + 12 <= k < 19
