"""A camera that goes along a shelf, and a map of it that from some keyframe on takes that for a turn."""

import numpy as np

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, invert_transform, make_transform, transform_points
from semcast.server.mapping.world_map import Keyframe, WorldMap

CAMERA = Intrinsics(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)
NUM_KEYFRAMES, FIRST_BENT = 18, 8
_STEP_M, _DEPTH_M = 0.06, 1.6
#: Share of the way that a bent map keeps.
_KEPT_SHARE = 0.4


def true_poses():
    """``T_world_cam`` of all keyframes: along the shelf, turning to and fro a little."""
    return [
        make_transform(
            exp_so3((0.01 * np.sin(k), 0.03 * np.sin(0.5 * k), 0.0)),
            (_STEP_M * k, 0.01 * np.sin(0.7 * k), 0.02 * np.sin(0.4 * k)),
        )
        for k in range(NUM_KEYFRAMES)
    ]


def bent_poses():
    """The same as a map may have them that went wrong."""
    poses = true_poses()[:FIRST_BENT]
    for before, now in zip(true_poses()[FIRST_BENT - 1 :], true_poses()[FIRST_BENT:], strict=False):
        step = invert_transform(before) @ now
        missing = (1.0 - _KEPT_SHARE) * step[0, 3]
        step[0, 3] -= missing
        step[:3, :3] = step[:3, :3] @ exp_so3((0.0, missing / _DEPTH_M, 0.0))
        poses.append(poses[-1] @ step)
    return poses


def make_map(poses, *, mover_px=0.0, movers_of_3=1, noise_px=0.2, seed=0):
    """Keyframes 0, 2, 4 ... as a map has them; what they saw is the truth.

    Args:
        poses: ``T_world_cam`` of the map.
        mover_px: From keyframe to keyframe, how far some tracks go by themselves; they have no landmark.
        movers_of_3: How many of three tracks do.
        noise_px: Of the tracks.
        seed: Of scene and noise.

    Returns:
        The map, with a landmark for each other track, where it is.
    """
    rng = np.random.default_rng(seed)
    xyz = rng.uniform((-1.5, -0.8, _DEPTH_M - 0.15), (3.0, 0.8, _DEPTH_M + 0.15), (900, 3))
    moves = np.arange(len(xyz)) % 3 < movers_of_3
    world = WorldMap()
    for k, (T_map, T_true) in enumerate(zip(poses, true_poses(), strict=True)):
        xy = CAMERA.project(transform_points(invert_transform(T_true), xyz))
        xy[moves, 1] += mover_px * k
        xy += rng.normal(0.0, noise_px, xy.shape)
        ids = np.flatnonzero(((xy > 0.0) & (xy < (CAMERA.width, CAMERA.height))).all(axis=1))
        world.add_keyframe(Keyframe(2 * k, k * 10**8, T_map, 0, ids, xy[ids], np.ones(len(ids))))
    has_landmark = np.flatnonzero(~moves if mover_px else np.arange(len(xyz)) % 2 == 0)
    rgb = np.zeros((len(has_landmark), 3), np.uint8)
    world.add_landmarks(has_landmark, xyz[has_landmark], rgb, np.ones(len(has_landmark)), 0, 0)
    return world
