"""A map must not begin as the mirror image in depth of what is there."""

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, invert_transform, make_transform
from semcast.server.mapping.bundle_problem import BundleProblem
from semcast.server.mapping.reversal import decide, mirrored


def scene(*, focal_px, depth, noise_px=0.0, num_views=4, turn_deg=8.0, seed=0):
    """Cameras on an arc around a ball of points, and the problem started from the truth."""
    rng = np.random.default_rng(seed)
    camera = Intrinsics(fx=focal_px, fy=focal_px, cx=320.0, cy=240.0, width=640, height=480)
    xyz = rng.uniform(-1.0, 1.0, (120, 3))
    middle = np.array([0.0, 0.0, depth])
    xyz += middle
    poses = []
    for k in range(num_views):
        R = exp_so3(np.array([0.0, np.radians(turn_deg) * k / (num_views - 1), 0.0]))
        poses.append(make_transform(R, middle - R @ middle))
    poses = np.stack(poses)
    T_cam_world = invert_transform(poses)
    xy = []
    for T in T_cam_world:
        xy.append(camera.project(xyz @ T[:3, :3].T + T[:3, 3]))
    view, point = np.divmod(np.arange(num_views * len(xyz)), len(xyz))
    clean = np.concatenate(xy)
    return BundleProblem(
        intrinsics=(focal_px, focal_px, 320.0, 240.0),
        keyframe_ids=np.arange(num_views),
        T_world_cam=poses,
        fixed=np.arange(num_views) == 0,
        keep_baseline=True,
        landmark_ids=np.arange(len(xyz)),
        xyz=xyz,
        view=view,
        point=point,
        xy=clean + noise_px * rng.standard_normal(clean.shape),
        sigma_px=np.full(len(clean), max(noise_px, 0.5)),
        confidence=np.ones(len(clean)),
        iterations=20,
    )


def projected(problem):
    T_cam_world = invert_transform(problem.T_world_cam)[problem.view]
    seen = np.einsum("mij,mj->mi", T_cam_world[:, :3, :3], problem.xyz[problem.point]) + T_cam_world[:, :3, 3]
    fx, fy, cx, cy = problem.intrinsics
    return seen[:, :2] / seen[:, 2:] * [fx, fy] + [cx, cy]


def relative(T_world_cam):
    return invert_transform(T_world_cam[0]) @ T_world_cam[-1]


def direction_error_deg(found, truth):
    a, b = relative(found)[:3, 3], relative(truth)[:3, 3]
    return np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def test_from_far_away_the_mirror_image_looks_the_same():
    far = scene(focal_px=160_000.0, depth=800.0)
    near = scene(focal_px=800.0, depth=4.0)
    shift_far = np.abs(projected(mirrored(far)) - far.xy).max()
    shift_near = np.abs(projected(mirrored(near)) - near.xy).max()
    assert shift_far < 1.5
    assert shift_near > 20 * shift_far


def test_the_mirror_image_turns_the_other_way_and_mirrors_depth():
    problem = scene(focal_px=800.0, depth=4.0)
    other = mirrored(problem)
    turn = relative(problem.T_world_cam)[:3, :3]
    np.testing.assert_allclose(relative(other.T_world_cam)[:3, :3], turn.T, atol=0.02)
    depth, mirrored_depth = problem.xyz[:, 2], other.xyz[:, 2]
    assert np.corrcoef(depth, mirrored_depth)[0, 1] < -0.95
    np.testing.assert_allclose(mirrored(other).xyz, problem.xyz, atol=0.2)


@pytest.mark.parametrize("seed", range(4))
def test_the_true_structure_is_found_from_either_start(seed):
    truth = scene(focal_px=600.0, depth=4.0, noise_px=0.7, seed=seed)
    for start in (truth, mirrored(truth)):
        side = decide(start)
        assert side is not None
        assert direction_error_deg(side.T_world_cam, truth.T_world_cam) < 5.0
        assert np.corrcoef(side.xyz[:, 2], truth.xyz[:, 2])[0, 1] > 0.9


def test_without_perspective_nothing_is_decided_before_the_last_chance():
    far = scene(focal_px=40_000.0, depth=200.0, noise_px=1.0, turn_deg=3.0)
    assert decide(far) is None
    assert decide(far, at_last=True) is not None
