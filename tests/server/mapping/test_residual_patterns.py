"""What keyframes have said in several windows, and how sure an estimate from it is."""

import functools
from types import SimpleNamespace

import numpy as np
import pytest
from shaken_views import CAMERA, SIZE_WH, STEP_S, pose_at

from semcast.common.geometry import invert_transform, transform_points
from semcast.server.mapping.bundle_problem import BundleProblem, ViewMotion
from semcast.server.mapping.readout import body_velocity, fit_readout
from semcast.server.mapping.readout_watch import ReadoutWatch
from semcast.server.mapping.residual_patterns import NUM_PATTERNS, PatternEvidence, pattern_products_of

NUM_VIEWS = 28
#: Of ten groups, by which nine differences tell a standard deviation.
STUDENT_95 = 2.262


def result_of(keyframe_ids, pattern_products):
    """Of 40 points in three views each, of which one observation is not used."""
    residual_px = np.zeros((120, 2))
    residual_px[7, 1] = np.nan
    problem = SimpleNamespace(
        keyframe_ids=np.array(keyframe_ids), view=np.repeat(np.arange(3), 40), point=np.tile(np.arange(40), 3)
    )
    return SimpleNamespace(problem=problem, residual_px=residual_px, pattern_products=pattern_products)


def test_what_a_keyframe_says_in_two_windows_counts_as_of_one_witness():
    evidence = PatternEvidence()
    assert (len(evidence), evidence.views, evidence.sigma_factor) == (0, [], 1.0)
    for keyframe_ids in ([3, 1, 2], [2, 3, 4]):
        evidence.note(result_of(keyframe_ids, np.stack([np.full((9, 9), float(k)) for k in keyframe_ids])))
    evidence.note(result_of([4, 5, 6], None))
    assert len(evidence) == 4
    assert [view[0, 0] for view in evidence.views] == [1.0, 4.0, 6.0, 4.0]
    assert evidence.sigma_factor == pytest.approx((1.0 - (6 * 3 + 3 * 40) / (2 * 119)) ** -0.5)


def test_as_many_unknowns_as_observations_leave_nothing_to_be_sure_of():
    # Sixteen landmarks in two of sixteen views each: 64 coordinates, and 6 * 16 + 3 * 16 unknowns.
    view = np.arange(32) // 2
    problem = SimpleNamespace(keyframe_ids=np.arange(16), view=view, point=(view + np.arange(32) % 2) % 16)
    rows = np.random.default_rng(0).normal(0.0, 1.0, (16, NUM_PATTERNS, 60))
    pattern_products = rows @ np.swapaxes(rows, 1, 2)
    watch = ReadoutWatch(CAMERA, is_wanted=True)
    watch.take(
        SimpleNamespace(problem=problem, residual_px=np.zeros((32, 2)), pattern_products=pattern_products)
    )
    assert fit_readout(watch._evidence.views, None) is not None, "else this tests nothing"
    assert watch._evidence.sigma_factor == np.inf
    assert watch.take_found() is None


@functools.cache
def shaken_path():
    """Poses and velocities of all views."""
    ms = 1e-3
    times_s = STEP_S * np.arange(NUM_VIEWS)
    poses = np.stack([pose_at(t) for t in times_s])
    velocity = [
        body_velocity(pose_at(t), np.array([pose_at(t - ms), pose_at(t + ms)]), np.array([-ms, ms]))
        for t in times_s
    ]
    return poses, np.stack(velocity)


def windows(seed, size, interval, num_points):
    """What a global shutter's noise alone leaves in windows that overlap; linear, so nothing is adjusted."""
    rng = np.random.default_rng(seed)
    poses, velocity = shaken_path()
    low, high = (-2.0, -1.5, 3.0), (3.5, 1.5, 6.0)
    xyz = rng.uniform(low, high, (num_points, 3))
    seen = np.stack([CAMERA.project(transform_points(invert_transform(T), xyz)) for T in poses])
    noise_px = rng.normal(0.0, 0.3, seen.shape)
    view, point = np.divmod(np.arange(size * num_points), num_points)
    for first in range(0, NUM_VIEWS - size + 1, interval):
        ids = np.arange(first, first + size)
        residual_px = noise_px[ids].reshape(-1, 2)
        problem = BundleProblem(
            camera=CAMERA,
            keyframe_ids=ids,
            T_world_cam=poses[ids],
            fixed=np.arange(size) == 0,
            keep_baseline=True,
            landmark_ids=np.arange(num_points),
            xyz=xyz,
            view=view,
            point=point,
            xy=seen[ids].reshape(-1, 2) + residual_px,
            sigma_px=np.full(len(view), 0.3),
            confidence=np.ones(len(view)),
        )
        pattern_products = pattern_products_of(
            problem, ViewMotion(SIZE_WH, velocity[ids]), poses[ids], xyz, residual_px
        )
        yield SimpleNamespace(problem=problem, pattern_products=pattern_products, residual_px=residual_px)


@pytest.mark.parametrize(
    ("size", "interval", "num_points"),
    [
        pytest.param(12, 4, 40, id="keyframes in three windows"),  # as three witnesses: .80
        # By residuals as they are: .92.
        pytest.param(5, 2, 30, id="four tenths of the variance in unknowns", marks=pytest.mark.slow),
    ],
)
def test_a_readout_is_as_sure_as_the_watch_says(size, interval, num_points):
    is_covered = []
    for seed in range(100):
        watch = ReadoutWatch(CAMERA, is_wanted=True)
        for result in windows(seed, size, interval, num_points):
            # What comes out is judged at the end; to judge it on the way too takes half as long again.
            watch.take(result) if seed < 20 else watch._evidence.note(result)
        assert watch.take_found() is None, "noise is no shutter"
        fit = fit_readout(watch._evidence.views, "rows")
        is_covered.append(fit.readout.ms <= STUDENT_95 * fit.sigma_ms * watch._evidence.sigma_factor)
    assert np.mean(is_covered) == pytest.approx(0.95, abs=0.055 if size == 12 else 0.025)
