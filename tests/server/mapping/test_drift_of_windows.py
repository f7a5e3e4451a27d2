"""Window after window along a way: what is stated of its end is what the end is off by."""

from types import SimpleNamespace

import numpy as np

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, make_transform, transform_points
from semcast.server.mapping.dense_bundle import State, Window, minimise
from semcast.server.mapping.drift import Drift
from semcast.server.mapping.window_covariance import window_covariance

CAMERA = Intrinsics(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)
NUM_VIEWS, IN_WINDOW, HELD, STEP = 24, 6, 2, 0.5
NOISE_PX = 0.5


def way(rng):
    """Sideways past a hedge, new landmarks all the way: true poses, landmarks, and which view sees which."""
    T = np.stack([make_transform(np.eye(3), (STEP * k, 0.0, 0.0)) for k in range(NUM_VIEWS)])
    xyz = rng.uniform((-3.0, -2.0, 4.0), (STEP * NUM_VIEWS + 3.0, 2.0, 9.0), (500, 3))
    cam = np.stack([transform_points(invert_transform(pose), xyz) for pose in T])
    xy = CAMERA.project(cam.reshape(-1, 3)).reshape(*cam.shape[:2], 2)
    sees = ((xy > 0) & (xy < (CAMERA.width, CAMERA.height))).all(axis=2)
    return T, xyz, xy + rng.normal(0, NOISE_PX, xy.shape), sees


def window_of(views, xy, sees):
    """Landmarks that two of the views see, and how."""
    points = np.flatnonzero(sees[views].sum(axis=0) >= 2)
    view, point = np.nonzero(sees[np.ix_(views, points)])
    return points, Window(
        camera=CAMERA,
        free=np.arange(len(views)) >= HELD,
        num_points=len(points),
        view=view,
        point=point,
        xy=xy[views[view], points[point]],
        whitener=np.repeat(np.eye(2)[:, :, None] / NOISE_PX, len(view), axis=2),
        limit=np.full(len(view), 1e3),
        baseline=None,
    )


def gone(seed):
    """Poses found on the way, ``(N, 4, 4)``, the true ones, and what is known of the drift."""
    T_true, xyz_true, xy, sees = way(np.random.default_rng(seed))
    T, xyz, drift = T_true.copy(), xyz_true.copy(), Drift()
    known = np.zeros(len(xyz), bool)
    for last in range(IN_WINDOW - 1, NUM_VIEWS):
        views = np.arange(last - IN_WINDOW + 1, last + 1)
        T[last] = T[last - 1] @ invert_transform(T_true[last - 1]) @ T_true[last]
        points, window = window_of(views, xy, sees)
        new = points[~known[points]]
        xyz[new] = transform_points(T[last] @ invert_transform(T_true[last]), xyz_true[new])
        known[new] = True
        state = minimise(window, State(T[views], xyz[points]), 10)
        T[views], xyz[points] = state.T_world_cam, state.xyz
        problem = SimpleNamespace(
            keyframe_ids=views, fixed=~window.free, view=window.view, sets_unit=last == IN_WINDOW - 1
        )
        covariances = window_covariance(window, state)
        drift.take(SimpleNamespace(problem=problem, T_world_cam=state.T_world_cam, covariances=covariances))
    return T, T_true, drift


def test_what_adds_up_is_about_as_large_as_stated():
    # Noise is independent here, and yet not exactly what is stated: windows share most of their observations.
    errors, variances = [], []
    for seed in range(16):
        T, T_true, drift = gone(seed)
        errors.append((invert_transform(T[-1]) @ T_true[-1])[:3, 3])
        variances.append(np.diag(drift.of(NUM_VIEWS - 1))[3:6])
    along, up, ahead = np.sqrt(np.square(errors).mean(axis=0) / np.mean(variances, axis=0))
    assert 0.7 < along < 2.0, "the scale adds up: with landmarks that stay told anew each time, 0.5"
    assert 0.3 < up < 1.5
    assert 0.6 < ahead < 1.5
