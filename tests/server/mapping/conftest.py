"""Scenes of points for tests of how a map begins, and the boards that whole maps are made of."""

import numpy as np
import pytest
from drawn_boards import render, sideways

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, invert_transform, make_transform
from semcast.evaluation.scenes import render as render_module
from semcast.evaluation.scenes.render import RenderSettings, render_scene
from semcast.server.mapping.bundle_problem import BundleProblem


def _problem_of(camera, poses, xyz, *, noise_px=0.0, rng=None):
    """The problem of all cameras seeing all points, started from the truth."""
    xy = [camera.project(xyz @ T[:3, :3].T + T[:3, 3]) for T in invert_transform(poses)]
    view, point = np.divmod(np.arange(len(poses) * len(xyz)), len(xyz))
    clean = np.concatenate(xy)
    noise = noise_px * rng.standard_normal(clean.shape) if noise_px else 0.0
    return BundleProblem(
        camera=camera,
        keyframe_ids=np.arange(len(poses)),
        T_world_cam=poses,
        fixed=np.arange(len(poses)) == 0,
        keep_baseline=True,
        landmark_ids=np.arange(len(xyz)),
        xyz=xyz,
        view=view,
        point=point,
        xy=clean + noise,
        sigma_px=np.full(len(clean), max(noise_px, 0.5)),
        confidence=np.ones(len(clean)),
        iterations=20,
    )


def _arc(*, focal_px, depth, noise_px=0.0, num_views=4, turn_deg=8.0, seed=0):
    """Cameras on an arc around a ball of points, and the problem started from the truth."""
    rng = np.random.default_rng(seed)
    camera = Intrinsics(fx=focal_px, fy=focal_px, cx=320.0, cy=240.0, width=640, height=480)
    middle = np.array([0.0, 0.0, depth])
    xyz = rng.uniform(-1.0, 1.0, (120, 3)) + middle
    poses = []
    for k in range(num_views):
        R = exp_so3(np.array([0.0, np.radians(turn_deg) * k / (num_views - 1), 0.0]))
        poses.append(make_transform(R, middle - R @ middle))
    return _problem_of(camera, np.stack(poses), xyz, noise_px=noise_px, rng=rng)


def _wall(*, way=(0.4, 0.15, 0.25), turn_deg=(2.0, -4.0, 0.0), bend=0.0, num_views=4, noise_px=0.0, seed=0):
    """A camera before a slanted wall; ``bend`` takes its path off the straight line."""
    rng = np.random.default_rng(seed)
    camera = Intrinsics(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)
    rays = np.column_stack((rng.uniform(-0.4, 0.4, 120), rng.uniform(-0.3, 0.3, 120), np.ones(120)))
    normal = np.array([0.2, -0.1, 1.0])
    xyz = rays * (3.0 / (rays @ normal))[:, None]
    poses = []
    for share in np.linspace(0.0, 1.0, num_views):
        off = bend * share * (1.0 - share) * np.array([-1.0, 2.0, 0.0])
        poses.append(make_transform(exp_so3(np.radians(turn_deg) * share), share * np.array(way) + off))
    return _problem_of(camera, np.stack(poses), xyz, noise_px=noise_px, rng=rng)


def _relative(T_world_cam):
    """Last camera in the frame of the first."""
    return invert_transform(T_world_cam[0]) @ T_world_cam[-1]


def _direction_error_deg(found, truth):
    """Angle between the ways of the last camera."""
    a, b = _relative(found)[:3, 3], _relative(truth)[:3, 3]
    return np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def _projected(problem):
    T_cam_world = invert_transform(problem.T_world_cam)[problem.view]
    seen = np.einsum("mij,mj->mi", T_cam_world[:, :3, :3], problem.xyz[problem.point]) + T_cam_world[:, :3, 3]
    return problem.camera.project(seen)


@pytest.fixture(scope="session")
def orbit_folder(tmp_path_factory):
    """A sequence of 25 frames of a camera that goes round a still life, by 3.5 degrees a frame."""
    folder = tmp_path_factory.mktemp("scenes") / "orbit"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(render_module, "_SAMPLES", ((0.0, 0.0),))  # a fourth of the time to draw it
        render_scene(RenderSettings(scene="orbit", seconds=2.5, out=folder))
    return folder


@pytest.fixture(scope="session")
def arc():
    return _arc


@pytest.fixture(scope="session")
def wall():
    return _wall


@pytest.fixture(scope="session")
def projected():
    return _projected


@pytest.fixture(scope="session")
def relative():
    return _relative


@pytest.fixture(scope="session")
def direction_error_deg():
    return _direction_error_deg


@pytest.fixture(scope="session")
def room():
    """Poses along the boards, and what a camera sees there."""
    poses = sideways()
    return poses, [render(T) for T in poses]
