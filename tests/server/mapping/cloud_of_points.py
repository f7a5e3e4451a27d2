"""Keyframes of a camera that goes past a cloud of points, for tests of what a map makes of them."""

import numpy as np

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_se3, exp_so3, invert_transform, make_transform, transform_points
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.world_map import Keyframe, WorldMap

CAMERA = Intrinsics(fx=500, fy=500, cx=320, cy=240, width=640, height=480)
NOISE = NoiseModel(0.5, 0.0)
IMAGE = np.full((480, 640, 3), (10, 20, 30), np.uint8)


def make_world(num_keyframes=5, num_points=80, noise_px=0.2, step=0.3, seed=0, shake=0.0, way=None):
    rng = np.random.default_rng(seed)
    world = WorldMap()
    points = rng.uniform((-2, -1.5, 5), (3, 1.5, 10), (num_points, 3))
    truth = []
    for k, x in enumerate(step * np.arange(num_keyframes) if way is None else way):
        centre = (x, 0.15 * step * rng.normal(), 0.15 * x)
        T = make_transform(exp_so3(rng.normal(0, 0.02, 3)), centre)
        truth.append(T)
        xy = CAMERA.project(transform_points(invert_transform(T), points)) + rng.normal(
            0, noise_px, (num_points, 2)
        )
        shaken = T @ exp_se3(rng.normal(0, shake, 6)) if k >= 2 else T
        world.add_keyframe(
            Keyframe(
                frame_id=10 * k,
                t_source_ns=k,
                T_world_cam=shaken,
                submap=0,
                ids=np.arange(num_points),
                xy=xy,
                confidence=np.full(num_points, 0.8),
            )
        )
    return world, points, np.stack(truth)


def put_landmarks(world, xyz):
    """Every point is a landmark, made by the first keyframe."""
    count = len(xyz)
    colour = np.zeros((count, 3), np.uint8)
    world.add_landmarks(np.arange(count), xyz, colour, np.ones(count), 0, 0)
