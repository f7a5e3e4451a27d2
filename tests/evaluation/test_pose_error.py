import numpy as np
import pytest

from semcast.common.geometry import exp_so3, make_transform
from semcast.evaluation.pose_error import relative_pose_error, summarise_pose_errors

TRUE = make_transform(exp_so3([0.0, np.radians(10), 0.0]), [0.0, 0.0, 2.0])


def test_errors_by_hand():
    estimate = make_transform(exp_so3([0.0, np.radians(13), 0.0]), [0.0, 1.0, 1.0])
    error = relative_pose_error(estimate, TRUE)
    assert error.rot_deg == pytest.approx(3.0)
    assert error.tdir_deg == pytest.approx(45.0)


def test_scale_is_free_and_sign_is_not():
    short, flipped = TRUE.copy(), TRUE.copy()
    short[:3, 3] *= 0.01
    flipped[:3, 3] *= -1
    assert relative_pose_error(short, TRUE).tdir_deg == pytest.approx(0.0, abs=1e-9)
    assert relative_pose_error(flipped, TRUE).tdir_deg == pytest.approx(180.0)


def test_a_pair_without_estimate_is_no_good_one():
    error = relative_pose_error(None, TRUE)
    assert (error.rot_deg, error.tdir_deg) == (90.0, 90.0)
    assert error.failed


def test_summary_by_hand():
    errors = {"rot_deg": [1.0, 3.0, 0.0], "tdir_deg": [2.0, 1.0, 4.0], "failed": [False, False, True]}
    summary = summarise_pose_errors(errors)
    assert summary["rot_deg_mean"] == pytest.approx(4 / 3)
    assert summary["tdir_deg_median"] == 2.0
    assert (summary["num_pairs"], summary["num_failed"]) == (3, 1)
    # worst errors 2, 3, inf: recall 0 -> 1/3 at 2 -> 2/3 at 3 -> flat to 5
    area = 2 * (0 + 1 / 3) / 2 + 1 * (1 / 3 + 2 / 3) / 2 + 2 * (2 / 3)
    assert summary["auc5"] == pytest.approx(100 * area / 5)


def test_summary_of_nothing_is_undefined():
    summary = summarise_pose_errors({"rot_deg": [], "tdir_deg": [], "failed": []})
    assert summary["rot_deg_mean"] is None
    assert summary["auc10"] is None
