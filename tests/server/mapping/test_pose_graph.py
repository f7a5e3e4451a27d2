"""Keyframes held by what is known of pairs of them."""

from itertools import pairwise

import numpy as np
import pytest

from semcast.common.geometry import exp_se3, invert_transform, make_transform, rotation_angle_deg
from semcast.server.mapping.pose_graph import PoseConstraint, solve_graph

SIGMA = (0.003, 0.02, 0.01)


def circle(count, radius=5.0):
    """Cameras once round a circle, looking along it."""
    poses = []
    for angle in np.linspace(0.0, 2 * np.pi, count, endpoint=False):
        R = exp_se3([0, angle, 0, 0, 0, 0])[:3, :3]
        poses.append(make_transform(R, R @ [radius, 0, 0]))
    return np.stack(poses)


def drifted(truth, rng, scale_step):
    """Path and scales that steps with errors lead to; each step is in the unit of the keyframe before."""
    poses, scale = [truth[0]], [1.0]
    for before, now in pairwise(truth):
        step = invert_transform(before) @ now @ exp_se3(rng.normal(0, [0.002] * 3 + [0.01] * 3))
        step[:3, 3] *= scale[-1]
        poses.append(poses[-1] @ step)
        scale.append(scale[-1] * scale_step)
    return np.stack(poses), np.array(scale)


def steps(poses):
    return [
        PoseConstraint(k, k + 1, invert_transform(poses[k]) @ poses[k + 1], 1.0, SIGMA)
        for k in range(len(poses) - 1)
    ]


def test_an_edge_says_where_and_how_large():
    first, apart = exp_se3([0.2, -0.1, 0.3, 1, 2, 3]), exp_se3([0.1, 0.4, -0.2, 0.5, -1, 2])
    solved = solve_graph(np.stack([first, np.eye(4)]), [PoseConstraint(0, 1, apart, 1.7, (1.0, 1.0, 1.0))])
    np.testing.assert_allclose(solved.T_world_cam[0], first, atol=1e-6)
    np.testing.assert_allclose(solved.T_world_cam[1], first @ apart, atol=1e-5)
    np.testing.assert_allclose(solved.scale, [1.0, 1.7], atol=1e-5)
    assert solved.cost < 1e-6


@pytest.mark.parametrize("scale_step", [1.0, 0.995])
def test_a_loop_takes_out_what_drifted(rng, scale_step):
    truth = circle(60)
    path, scale = drifted(truth, rng, scale_step)
    where_first_is_again = invert_transform(truth[0]) @ truth[-1]
    loop = PoseConstraint(0, 59, where_first_is_again, 1.0 / scale[-1], (0.001, 0.005, 0.01))
    solved = solve_graph(path, [*steps(path), loop])

    def error(poses):
        return float(np.sqrt(np.mean(np.sum((poses[:, :3, 3] - truth[:, :3, 3]) ** 2, axis=1))))

    assert error(solved.T_world_cam) < 0.7 * error(path)
    np.testing.assert_allclose(solved.T_world_cam[-1][:3, 3], truth[-1][:3, 3], atol=0.1)
    np.testing.assert_allclose(solved.scale, 1.0 / scale, rtol=0.02)
    assert rotation_angle_deg(solved.T_world_cam[-1][:3, :3].T @ truth[-1][:3, :3]) < 0.3


def test_edges_are_weighed_by_what_they_are_worth():
    poses = np.stack([make_transform(np.eye(3), [k, 0, 0]) for k in range(3)])
    loop = PoseConstraint(0, 2, make_transform(np.eye(3), [3.0, 0, 0]), 1.0, (1.0, 1e-4, 1.0))
    sure = PoseConstraint(0, 1, make_transform(np.eye(3), [1.0, 0, 0]), 1.0, (0.01, 0.01, 0.001))
    doubtful = PoseConstraint(1, 2, make_transform(np.eye(3), [1.0, 0, 0]), 1.0, (0.01, 0.1, 0.001))
    x = solve_graph(poses, [sure, doubtful, loop]).T_world_cam[:, 0, 3]
    assert x[2] == pytest.approx(3.0, abs=0.01)
    # The error is shared out by variance: 1 to 100.
    assert x[1] == pytest.approx(1.0 + 1 / 101, abs=0.005)


@pytest.mark.parametrize("of", ["turn", "scale"])
def test_what_contradicts_itself_is_weighed_by_the_deviations_of_its_kind(of):
    turn = exp_se3([0, 0.02, 0, 0, 0, 0]) if of == "turn" else np.eye(4)
    scale = np.exp(0.02) if of == "scale" else 1.0
    sure, doubtful = ((s, 1.0, 5.0) if of == "turn" else (5.0, 1.0, s) for s in (0.01, 0.02))
    said = [PoseConstraint(0, 1, np.eye(4), 1.0, sure), PoseConstraint(0, 1, turn, scale, doubtful)]
    solved = solve_graph(np.stack([np.eye(4)] * 2), said)
    found = np.radians(rotation_angle_deg(solved.T_world_cam[1][:3, :3])) + np.log(solved.scale[1])
    assert found == pytest.approx(0.2 * 0.02, rel=0.01), "by variance: 1 to 4"
    assert solved.cost == pytest.approx(0.5 * (0.4**2 + 0.8**2), rel=0.01)


def test_a_keyframe_that_nothing_holds_stays():
    poses = circle(4)
    solved = solve_graph(poses, steps(poses)[:2])
    np.testing.assert_allclose(solved.T_world_cam[3], poses[3], atol=1e-9)
