from dataclasses import replace

import numpy as np
import pytest
from two_view_matches import CAMERA, make_far_matches, make_matches

from semcast.common.geometry import (
    angle_between_deg,
    make_transform,
    rotation_angle_deg,
)
from semcast.server.geometry import two_view
from semcast.server.geometry.two_view import estimate_two_view, follows

FAST = {"min_iterations": 100, "max_iterations": 1000}


def errors_deg(found, T):
    return (
        rotation_angle_deg(found.T_cam1_cam0[:3, :3] @ T[:3, :3].T),
        angle_between_deg(found.T_cam1_cam0[:3, 3], T[:3, 3]),
    )


@pytest.mark.parametrize("mode", ["robust", "off", "paper", "shuffled"])
@pytest.mark.parametrize("seed", range(2))
def test_the_pose_is_found_in_every_mode(mode, seed):
    T, xy0, xy1, is_outlier = make_matches(seed)
    confidence = np.where(is_outlier, 0.3, 0.9)
    found = estimate_two_view(CAMERA, xy0, xy1, confidence, mode=mode, seed=seed, **FAST)
    assert found is not None
    rotation, direction = errors_deg(found, T)
    loose = 4.0 if mode == "paper" else 1.0
    assert rotation < 0.6 * loose
    assert direction < 3.0 * loose
    assert np.linalg.norm(found.T_cam1_cam0[:3, 3]) == pytest.approx(1.0)
    if mode != "paper":
        assert found.inliers[~is_outlier].mean() > 0.85
        assert found.inliers[is_outlier].mean() < 0.15


def test_misleading_confidence_does_not_harm():
    worse = []
    for seed in range(8):
        T, xy0, xy1, is_outlier = make_matches(seed, outlier_share=0.5)
        lie = np.where(is_outlier, 0.95, 0.1)
        robust = estimate_two_view(CAMERA, xy0, xy1, lie, seed=seed, **FAST)
        plain = estimate_two_view(CAMERA, xy0, xy1, None, seed=seed, **FAST)
        assert robust is not None
        assert plain is not None
        worse.append(errors_deg(robust, T)[1] - errors_deg(plain, T)[1])
    assert np.mean(worse) < 0.2


def test_right_confidence_helps_where_matches_are_few_and_unequal():
    gain = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        T, xy0, xy1, _ = make_matches(seed, num=60, outlier_share=0.0, noise_px=0.0, t=(0.5, 0.1, 0.2))
        sigma = np.where(rng.random(60) < 0.5, 0.15, 2.5)
        xy1 = xy1 + rng.normal(0, 1, xy1.shape) * sigma[:, None]
        confidence = 1 / (1 + sigma)
        robust = estimate_two_view(CAMERA, xy0, xy1, confidence, seed=seed, **FAST)
        plain = estimate_two_view(CAMERA, xy0, xy1, None, seed=seed, **FAST)
        assert robust is not None
        assert plain is not None
        gain.append((errors_deg(robust, T)[1], errors_deg(plain, T)[1]))
    ours, theirs = np.mean(gain, axis=0)
    assert ours < 0.8 * theirs


def test_turning_on_the_spot_is_recognised():
    _, xy0, xy1, _ = make_matches(0, t=(0.0, 0.0, 0.0), outlier_share=0.1)
    found = estimate_two_view(CAMERA, xy0, xy1, choose_model=True, **FAST)
    assert found is not None
    assert found.is_rotation


def test_standing_still_is_a_rotation_by_nothing():
    _, xy0, _, _ = make_matches(0)
    noise = np.random.default_rng(0).normal(0, 0.2, xy0.shape)
    found = estimate_two_view(CAMERA, xy0, xy0 + noise, choose_model=True, **FAST)
    assert found is not None
    assert found.is_rotation


@pytest.mark.parametrize("seed", range(3))
def test_a_plane_gives_a_pose_with_its_points_in_front(seed):
    T, xy0, xy1, _ = make_matches(seed, t=(0.8, 0.1, 0.1), plane=True, outlier_share=0.1)
    found = estimate_two_view(CAMERA, xy0, xy1, choose_model=True, seed=seed, **FAST)
    assert found is not None
    assert not found.is_rotation
    assert found.inliers.mean() > 0.7
    rotation, direction = errors_deg(found, T)
    assert rotation < 3
    assert direction < 15


def test_turns_the_camera_never_made_are_rarer_where_turning_costs(monkeypatch):
    error_deg = {}
    for cost in (0.0, two_view._TURN_COST):
        monkeypatch.setattr(two_view, "_TURN_COST", cost)
        matches = [make_far_matches(seed, 0.5, 0.7) for seed in range(24)]
        found = [estimate_two_view(CAMERA, xy0, xy1, seed=seed) for seed, (_, xy0, xy1) in enumerate(matches)]
        error_deg[cost > 0] = np.mean(
            [errors_deg(f, T)[1] for f, (T, *_) in zip(found, matches, strict=True)]
        )
    assert error_deg[True] < 0.85 * error_deg[False]


def test_matches_without_like_neighbours_are_left_out_unless_too_few_remain():
    assert two_view._kept(np.array([0.9] * 8 + [0.2, 0.0])).tolist() == list(range(8))
    # Seven agree: the better half is kept, which is ten here, and eight of ten matches.
    assert two_view._kept(np.array([0.0] * 10 + [0.1] * 3 + [0.9] * 7)).tolist() == list(range(10, 20))
    assert two_view._kept(np.array([0.9] * 7 + [0.0, 0.2, 0.0])).tolist() == [0, 1, 2, 3, 4, 5, 6, 8]
    assert np.allclose(two_view._weights(np.array([0.0, 0.1, 0.25, 0.4, 1.0])), [0.05, 0.05, 0.5, 1, 1])


def test_a_pose_explains_what_is_on_its_half_line_or_too_far_away_to_tell():
    # Camera 1 sits 1 to the left: a point moves to the right by 500 px over its depth, a far one hardly.
    T = make_transform(np.eye(3), (1.0, 0.0, 0.0))
    xy0 = np.full((5, 2), (300.0, 200.0))
    way = np.array([[50.0, 0], [50, 4], [-1, 0], [-3, 0], [50, 2]])
    assert follows(CAMERA, T, xy0, xy0 + way, 1.0).tolist() == [True, False, True, False, True]


def test_degenerate_matches_give_none_or_a_finite_pose():
    assert estimate_two_view(CAMERA, np.zeros((4, 2)), np.zeros((4, 2))) is None
    assert estimate_two_view(CAMERA, np.full((20, 2), np.nan), np.zeros((20, 2))) is None
    same = np.full((30, 2), 100.0)
    line = np.stack([np.linspace(10, 600, 30), np.full(30, 50.0)], axis=1)
    for xy in (same, line):
        for mode in ("robust", "paper"):
            found = estimate_two_view(
                CAMERA, xy, xy + 1.0, np.linspace(0.1, 1, 30), mode=mode, choose_model=True, **FAST
            )
            assert found is None or np.isfinite(found.T_cam1_cam0).all()


def test_a_single_match_that_is_not_finite_is_enough_for_none():
    _, xy0, xy1, _ = make_matches(0)
    for k in range(2):
        given = [xy0.copy(), xy1.copy()]
        given[k][7, 1] = np.nan
        assert estimate_two_view(CAMERA, *given, **FAST) is None


@pytest.mark.parametrize(("mode", "spread"), [("off", 0.5), ("robust", 0.0), ("robust", 1e-7)])
def test_confidence_that_is_off_or_all_alike_is_none(mode, spread):
    _, xy0, xy1, is_outlier = make_matches(1)
    confidence = 0.4 + spread * ~is_outlier
    a = estimate_two_view(CAMERA, xy0, xy1, confidence, mode=mode, **FAST)
    b = estimate_two_view(CAMERA, xy0, xy1, **FAST)
    assert np.array_equal(a.T_cam1_cam0, b.T_cam1_cam0)


def test_edges_that_matches_slid_along_take_errors_off_but_not_in_the_paper():
    errors = {"known": [], "unknown": []}
    for seed in range(8):
        T, xy0, xy1, is_outlier = make_matches(seed, num=120, noise_px=0.1, t=(1.0, 0.3, 0.2))
        rng = np.random.default_rng(100 + seed)
        along = np.stack([np.sin(angle := rng.uniform(0, np.pi, 120)), np.cos(angle)], axis=1)
        xy1 += rng.normal(0, 1.5, (120, 1)) * along
        edges = 0.5 * np.log(10.0) * along, 0.5 * np.log(10.0) * along
        found = [estimate_two_view(CAMERA, xy0, xy1, edges=e, seed=seed, **FAST) for e in (edges, None)]
        for name, pose in zip(errors, found, strict=True):
            errors[name].append(errors_deg(pose, T)[1])
    assert np.mean(errors["known"]) < 0.7 * np.mean(errors["unknown"])
    told = {"confidence": np.where(is_outlier, 0.3, 0.9), "mode": "paper"}
    a, b = (estimate_two_view(CAMERA, xy0, xy1, edges=e, **told) for e in (edges, None))
    assert np.array_equal(a.T_cam1_cam0, b.T_cam1_cam0)


def test_the_same_seed_gives_the_same_result():
    _, xy0, xy1, is_outlier = make_matches(3)
    a, b = (estimate_two_view(CAMERA, xy0, xy1, 1.0 - 0.5 * is_outlier, seed=7, **FAST) for _ in range(2))
    assert np.array_equal(a.T_cam1_cam0, b.T_cam1_cam0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"keypoints1_xy": np.zeros((9, 2))}, r"keypoints1_xy must have shape \(10 2\), got \(9, 2\)"),
        ({"keypoints0_xy": np.zeros((10, 3))}, "keypoints0_xy must have shape"),
        ({"confidence": np.ones(5)}, r"confidence must have shape \(10\), got \(5,\)"),
        ({"edges": (np.zeros((10, 2)), np.zeros((9, 2)))}, r"edges must have shape \(10 2\), got \(9, 2\)"),
        ({"mode": "robst"}, "mode must be one of robust, .*, got 'robst'"),
        ({"threshold_px": float("nan")}, "threshold_px must be positive, got nan"),
        ({"camera": replace(CAMERA, distortion=(0.1, 0.0, 0.0, 0.0))}, "camera must be without distortion"),
    ],
)
def test_arguments_that_make_no_sense_are_named(changes, message):
    given = {"camera": CAMERA, "keypoints0_xy": np.zeros((10, 2)), "keypoints1_xy": np.zeros((10, 2))}
    with pytest.raises(ValueError, match=message):
        estimate_two_view(**{**given, **changes})
