"""Trajectory errors against hand-computed values and against evo."""

from dataclasses import replace

import numpy as np
import pytest

from semcast.common.geometry import exp_se3, exp_so3, make_transform
from semcast.common.trajectory import Trajectory
from semcast.common.trajectory_error import ate, completeness, match_times, rpe, trajectory_summary


def wandering(num, seed, noise=0.0):
    rng = np.random.default_rng(seed)
    T, poses = np.eye(4), []
    for _ in range(num):
        T = T @ exp_se3(np.concatenate([rng.normal(0, 0.1, 3), [0.1, 0.0, 0.5]]))
        poses.append(T @ exp_se3(rng.normal(0, noise, 6)) if noise else T)
    return Trajectory(0.1 * np.arange(num), np.array(poses).reshape(-1, 4, 4))


def moved(trajectory, scale, R, t):
    poses = trajectory.T_world_cam.copy()
    poses[:, :3, :3] = R @ poses[:, :3, :3]
    poses[:, :3, 3] = scale * poses[:, :3, 3] @ R.T + t
    return Trajectory(trajectory.t_s, poses)


def line(xs, ys=None):
    ys = np.zeros(len(xs)) if ys is None else ys
    poses = [make_transform(np.eye(3), (x, y, 0.0)) for x, y in zip(xs, ys, strict=True)]
    return Trajectory(np.arange(len(xs), dtype=float), np.array(poses).reshape(-1, 4, 4))


def test_a_similarity_copy_has_no_error_and_gives_its_scale_back():
    truth = wandering(30, 1)
    estimate = moved(truth, 0.2, exp_so3([0.3, -1.0, 2.0]), [5.0, 6.0, 7.0])
    result = ate(estimate, truth)
    assert result.rmse < 1e-9
    assert result.scale == pytest.approx(5.0)
    relative = rpe(estimate, truth, result.scale)
    assert relative.trans_percent < 1e-6
    assert relative.rot_deg < 1e-6


def test_the_error_of_a_square_with_one_corner_off_is_what_paper_and_pencil_say():
    # x = 0..3 on a line; the estimate zigzags by +-h in y, which no similarity can remove by symmetry.
    h = 0.1
    truth = line([0.0, 1.0, 2.0, 3.0])
    result = ate(line([0.0, 1.0, 2.0, 3.0], [h, -h, -h, h]), truth)
    # Umeyama's scale is s = sum(x * x') / sum(x'^2 + y'^2) = 5 / (5 + 4 h^2); residuals follow.
    scale = 5.0 / (5.0 + 4 * h * h)
    x = np.array([-1.5, -0.5, 0.5, 1.5])
    expected = np.sqrt(np.mean((scale * x - x) ** 2 + (scale * h) ** 2))
    assert result.scale == pytest.approx(scale)
    assert result.rmse == pytest.approx(expected)
    assert result.percent == pytest.approx(100 * expected / 3.0)


def test_one_degree_per_step_too_much_is_an_rpe_of_one_degree():
    truth = line(np.arange(10.0))
    poses = truth.T_world_cam.copy()
    poses[:, :3, :3] = [exp_so3([0.0, 0.0, np.radians(k)]) for k in range(10)]
    assert rpe(Trajectory(truth.t_s, poses), truth, 1.0).rot_deg == pytest.approx(1.0)


def test_there_is_no_rpe_of_a_single_pose_nor_of_a_true_camera_that_stands():
    truth = wandering(4, 0)
    single = Trajectory(truth.t_s[:1], truth.T_world_cam[:1])
    assert rpe(single, truth, 1.0) is None
    standing = Trajectory(truth.t_s, np.repeat(truth.T_world_cam[:1], 4, axis=0))
    assert rpe(truth, standing, 1.0) is None


def test_ate_and_rpe_agree_with_evo():
    pytest.importorskip("evo")
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D

    truth = wandering(60, 2)
    estimate = moved(wandering(60, 2, noise=0.05), 0.3, exp_so3([1.0, 0.2, -0.4]), [1.0, 2.0, 3.0])
    evo_truth = PoseTrajectory3D(poses_se3=list(truth.T_world_cam), timestamps=truth.t_s)
    evo_estimate = PoseTrajectory3D(poses_se3=list(estimate.T_world_cam.copy()), timestamps=estimate.t_s)
    evo_estimate.align(evo_truth, correct_scale=True)
    absolute = metrics.APE(metrics.PoseRelation.translation_part)
    absolute.process_data((evo_truth, evo_estimate))
    expected = {}
    for name, relation in (
        ("trans", metrics.PoseRelation.translation_part),
        ("rot", metrics.PoseRelation.rotation_angle_deg),
    ):
        relative = metrics.RPE(relation, delta=1, delta_unit=metrics.Unit.frames)
        relative.process_data((evo_truth, evo_estimate))
        expected[name] = relative.get_statistic(metrics.StatisticsType.rmse)
    ours = ate(estimate, truth)
    assert ours.rmse == pytest.approx(absolute.get_statistic(metrics.StatisticsType.rmse), rel=1e-9)
    assert np.median(ours.error) == pytest.approx(
        absolute.get_statistic(metrics.StatisticsType.median), rel=1e-9
    )
    steps = rpe(estimate, truth, ours.scale)
    true_steps_m = np.linalg.norm(np.diff(truth.positions, axis=0), axis=1)
    percent = 100.0 * expected["trans"] / np.sqrt(np.mean(true_steps_m**2))
    assert steps.trans_percent == pytest.approx(percent, rel=1e-9)
    assert steps.rot_deg == pytest.approx(expected["rot"], rel=1e-6)


def test_every_true_time_is_used_once_and_far_times_are_left_out():
    estimate_idx, truth_idx = match_times(np.array([0.0, 0.04, 0.11, 0.5]), np.array([0.0, 0.1, 0.2]))
    assert estimate_idx.tolist() == [0, 2]
    assert truth_idx.tolist() == [0, 1]
    assert match_times(np.zeros(0), np.array([0.0]))[0].size == 0


def test_a_sparse_truth_is_not_taken_for_that_of_frames_around_one_without_a_pose():
    times_s = np.arange(100) * 0.1
    x_m = np.cumsum(1.0 + 0.5 * np.sin(np.arange(100)))
    at_tenth = Trajectory(times_s[::10], line(x_m[::10]).T_world_cam)
    posed = np.delete(np.arange(100), [30, 31, 50])
    estimate = Trajectory(times_s[posed], line(x_m[posed]).T_world_cam)
    error = ate(estimate, at_tenth)
    assert error.rmse < 1e-9
    assert len(error.t_s) == 8


@pytest.mark.parametrize(
    "estimate",
    [
        line([]),
        line([0.0]),
        line([0.0, 1.0]),
        line([4.0, 4.0, 4.0, 4.0]),
    ],
    ids=["empty", "one", "two", "standing"],
)
def test_an_estimate_that_says_nothing_has_no_error_figure(estimate):
    truth = line(np.arange(8.0))
    assert ate(estimate, truth) is None
    summary = trajectory_summary(estimate, truth, num_frames=8)
    assert summary["ate_rmse_m"] is None
    assert summary["rpe_rot_deg"] is None
    assert summary["completeness"] == len(estimate) / 8


def test_a_truth_that_stands_still_gives_no_percentage():
    assert ate(line(np.arange(5.0)), line(np.zeros(5))) is None


def test_a_path_of_which_only_a_rest_was_found_has_no_error_figure():
    truth = line([2.0, 2.0, 2.0, 2.0, 3.0, 4.0])  # any estimate shrinks to fit that
    estimate = Trajectory(truth.t_s[:4], line([0.0, 0.3, -0.2, 0.1]).T_world_cam)
    assert ate(estimate, truth) is None
    assert trajectory_summary(estimate, truth, num_frames=6)["ate_percent"] is None


def test_an_unmatched_clock_gives_no_error_figure():
    truth = line(np.arange(5.0))
    shifted = Trajectory(truth.t_s + 1000.0, truth.T_world_cam)
    assert ate(shifted, truth) is None


def test_completeness_counts_frames_and_refuses_nonsense():
    assert completeness(3, 4) == 0.75
    assert completeness(0, 0) == 0.0
    with pytest.raises(ValueError, match="num_posed must be in"):
        completeness(5, 4)


def test_the_figures_of_a_run_are_in_metres_of_the_truth():
    # A map of half the size that zigzags by h map units; what no similarity removes is as in the test above.
    h, truth = 0.05, line([0.0, 1.0, 2.0, 3.0])
    summary = trajectory_summary(line([0.0, 0.5, 1.0, 1.5], [h, -h, -h, h]), truth, num_frames=5)
    scale = 2.5 / (1.25 + 4 * h * h)
    x = np.array([-1.5, -0.5, 0.5, 1.5])
    rmse_m = np.sqrt(np.mean((scale * x / 2 - x) ** 2 + (scale * h) ** 2))
    step_m = np.sqrt((3 * (scale / 2 - 1) ** 2 + 2 * (2 * scale * h) ** 2) / 3)
    assert summary == {
        "ate_rmse_m": pytest.approx(rmse_m),
        "ate_percent": pytest.approx(100 * rmse_m / 3.0),
        "path_length_m": 3.0,
        "completeness": 0.8,
        "rpe_trans_percent": pytest.approx(100 * step_m),
        "rpe_rot_deg": 0.0,
        "num_posed": 4,
        "num_matched": 4,
    }


def test_a_truth_whose_unit_nobody_knows_gives_errors_in_percent_alone():
    zigzag, truth = line([0.0, 0.5, 1.0, 1.5], [0.05, -0.05, -0.05, 0.05]), line([0.0, 1.0, 2.0, 3.0])
    known = trajectory_summary(zigzag, truth, num_frames=5)
    found = trajectory_summary(zigzag, replace(truth, in_metres=False), num_frames=5)
    assert found == {**known, "ate_rmse_m": None, "path_length_m": None}
    assert [ate(zigzag, t).unit for t in (truth, replace(truth, in_metres=False))] == [
        "m",
        "units of the truth",
    ]


def test_without_truth_only_counts_remain():
    summary = trajectory_summary(wandering(5, 3), None, num_frames=10)
    assert summary["completeness"] == 0.5
    assert summary["ate_rmse_m"] is None
    assert summary["path_length_m"] is None
