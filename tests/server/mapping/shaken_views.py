"""An adjustment of views of a shaking hand, by a camera that is not quite as believed."""

import functools

import numpy as np

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, invert_transform, make_transform, transform_points
from semcast.server.mapping.bundle import optimise
from semcast.server.mapping.bundle_problem import BundleProblem, ViewMotion
from semcast.server.mapping.readout import Readout, body_velocity

CAMERA = Intrinsics(fx=400.0, fy=400.0, cx=319.5, cy=239.5, width=640, height=480)
NUM_VIEWS, STEP_S = 12, 0.1
SIZE_WH = (CAMERA.width, CAMERA.height)


def pose_at(t_s):
    """A hand that goes sideways and shakes."""
    turn = 0.05 * np.array([np.sin(9.0 * t_s), np.cos(7.0 * t_s), np.sin(11.0 * t_s + 1.0)])
    return make_transform(exp_so3(turn), np.array([0.5 * t_s, 0.04 * np.sin(8.0 * t_s), 0.1 * t_s]))


def rolling_xy(xyz, t_s, camera):
    """Where points are seen when each row, or column, has its own pose."""
    axis = int(camera.readout_from in ("top", "bottom"))
    readout_s = 1e-3 * Readout.of(camera).signed_ms
    xy = camera.project(transform_points(invert_transform(pose_at(t_s)), xyz))
    for _ in range(4 if readout_s else 0):
        late_s = readout_s * (xy[:, axis] / (SIZE_WH[axis] - 1) - 0.5)
        T_world_cam = np.stack([pose_at(t_s + s) for s in late_s])
        in_cam = np.einsum("nji,nj->ni", T_world_cam[:, :3, :3], xyz - T_world_cam[:, :3, 3])
        xy = camera.project(in_cam)
    return xy


@functools.cache  # many tests look at the same few adjustments
def adjusted(camera, noise_px=0.2, seed=0, velocities=True, radial=0.0, radial_2=0.0, put_right=0.0):
    """An adjustment that takes every image for one of a moment and of ``CAMERA``, and what it says.

    Images may have been put right by a multiple of what the readout did to them.
    """
    rng = np.random.default_rng(seed)
    xyz = np.column_stack(
        [rng.uniform(-2.0, 2.5, 150), rng.uniform(-1.5, 1.5, 150), rng.uniform(3.0, 6.0, 150)]
    )
    times_s = STEP_S * np.arange(NUM_VIEWS)
    poses = np.stack([pose_at(t) for t in times_s])
    xy = np.concatenate([rolling_xy(xyz, t, camera) for t in times_s])
    ray = (xy - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    r2 = (ray**2).sum(axis=1, keepdims=True)
    xy += (radial * r2 + radial_2 * r2**2) * (xy - (camera.cx, camera.cy))
    at_once_xy = np.concatenate([rolling_xy(xyz, t, CAMERA) for t in times_s])
    put_right_px = put_right * (xy - at_once_xy)
    view, point = np.divmod(np.arange(len(xy)), len(xyz))
    ms = 1e-3
    velocity = np.stack(
        [
            body_velocity(pose_at(t), np.array([pose_at(t - ms), pose_at(t + ms)]), np.array([-ms, ms]))
            for t in times_s
        ]
    )
    problem = BundleProblem(
        camera=CAMERA,
        keyframe_ids=np.arange(NUM_VIEWS),
        T_world_cam=poses,
        fixed=np.arange(NUM_VIEWS) == 0,
        keep_baseline=True,
        landmark_ids=np.arange(len(xyz)),
        xyz=xyz,
        view=view,
        point=point,
        xy=xy - put_right_px + noise_px * rng.standard_normal(xy.shape),
        sigma_px=np.full(len(xy), 0.5),
        confidence=np.ones(len(xy)),
        iterations=20,
        motion=ViewMotion(SIZE_WH, velocity, put_right_px=put_right_px) if velocities else None,
    )
    return optimise(problem)
