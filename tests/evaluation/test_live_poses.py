import numpy as np
import pytest

from semcast.common.geometry import exp_so3
from semcast.common.trajectory import Trajectory
from semcast.evaluation.live_poses import LivePose, live_figures, stated_ratios

NUM = 400
TIMES_NS = {k: 50_000_000 * k for k in range(NUM)}
#: Standard deviations per axis, radians and units of the truth.
SIGMA_RAD, SIGMA = 0.002, 0.03


def straight_path():
    """A camera that goes straight ahead and nods."""
    T = np.tile(np.eye(4), (NUM, 1, 1))
    T[:, 2, 3] = 0.1 * np.arange(NUM)
    T[:, :3, :3] = [exp_so3([0.1 * np.sin(k / 9), 0.2 * np.sin(k / 7), 0.0]) for k in range(NUM)]
    return Trajectory(np.array([TIMES_NS[k] * 1e-9 for k in range(NUM)]), T)


def published(truth, *, stated=1.0, unit=1.0):
    """Poses with errors of known size, in another world of another unit, that state so many times of it."""
    rng = np.random.default_rng(3)
    R_map = exp_so3([0.4, -1.0, 2.0])
    poses = {}
    for k, T_true in enumerate(truth.T_world_cam):
        T = np.eye(4)
        T[:3, :3] = R_map @ T_true[:3, :3] @ exp_so3(SIGMA_RAD * rng.standard_normal(3))
        T[:3, 3] = unit * R_map @ (T_true[:3, 3] + SIGMA * rng.standard_normal(3)) + 5.0
        sigma = stated * np.repeat((SIGMA_RAD, unit * SIGMA), 3)
        poses[k] = LivePose(T, np.diag(sigma**2))
    return poses


@pytest.mark.parametrize(("stated", "unit"), [(1.0, 1.0), (0.5, 1.0), (1.0, 7.0), (4.0, 0.1)])
def test_errors_are_told_in_stated_standard_deviations_whatever_the_unit(stated, unit):
    truth = straight_path()
    ratios = stated_ratios(published(truth, stated=stated, unit=unit), TIMES_NS, truth)
    assert ratios["stated_ratio_trans"] == pytest.approx(1.0 / stated, rel=0.06)
    assert ratios["stated_ratio_rot"] == pytest.approx(1.0 / stated, rel=0.06)


def test_a_pose_that_claims_to_be_known_exactly_does_not_outweigh_all_others():
    truth = straight_path()
    poses = published(truth)
    poses[50] = LivePose(poses[50].T_world_cam, np.zeros((6, 6)))
    assert stated_ratios(poses, TIMES_NS, truth)["stated_ratio_trans"] == pytest.approx(1.0, rel=0.06)


def test_poses_without_a_covariance_are_left_out():
    truth = straight_path()
    poses = published(truth)
    far = poses[9].T_world_cam.copy()
    far[:3, 3] += 100.0
    with_one_more = {**poses, 9: LivePose(far, None)}
    del poses[9]
    expected = stated_ratios(poses, TIMES_NS, truth)
    assert stated_ratios(with_one_more, TIMES_NS, truth) == expected


def test_of_poses_of_a_camera_at_rest_no_error_is_told():
    truth = straight_path()
    truth.T_world_cam[:100, :3, 3] = truth.T_world_cam[100, :3, 3]
    poses = {k: pose for k, pose in published(truth).items() if k < 100}
    figures = live_figures(poses, TIMES_NS, truth, NUM)
    assert figures["ate_at_once_percent"] is figures["stated_ratio_trans"] is None


def test_without_truth_or_covariances_nothing_is_said():
    truth = straight_path()
    poses = {k: LivePose(pose.T_world_cam, None) for k, pose in published(truth).items()}
    nothing = {"stated_ratio_trans": None, "stated_ratio_rot": None}
    assert stated_ratios(poses, TIMES_NS, truth) == nothing
    assert stated_ratios(published(truth), TIMES_NS, None) == nothing


def test_an_error_of_published_poses_is_that_after_one_similarity():
    truth = straight_path()
    poses = {}
    for k in range(0, NUM, 2):
        T = truth.T_world_cam[k].copy()
        T[:3, 3] = 3.0 * T[:3, 3] + 1.0
        poses[k] = LivePose(T, None)
    figures = live_figures(poses, TIMES_NS, truth, NUM)
    assert figures["ate_at_once_percent"] == pytest.approx(0.0, abs=1e-9)
    assert figures["completeness_at_once"] == pytest.approx(0.5)
    assert live_figures(poses, TIMES_NS, None, NUM)["ate_at_once_percent"] is None
