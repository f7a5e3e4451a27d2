"""Dense algebra against GTSAM's factor graph."""

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X
from small_windows import make_problem

from semcast.server.geometry.edges import rounded
from semcast.server.mapping import bundle, dense_bundle
from semcast.server.mapping import window_covariance as covariance_of_window
from semcast.server.mapping.bundle import optimise, quantised_sigma
from semcast.server.mapping.bundle_problem import BundleProblem


def both_ways(problem):
    """By dense algebra and by GTSAM, which rounds standard deviations and shapes."""
    sigmas, step = quantised_sigma(problem.sigma_px)
    problem = replace(problem, sigma_px=sigmas[step], edge=rounded(problem.edge))
    return optimise(problem), optimise(replace(problem, solver="gtsam"))


def with_outliers(problem):
    xy = problem.xy.copy()
    xy[::9] += (30.0, -20.0)
    return {"xy": xy}


@pytest.mark.parametrize(
    "changes",
    [
        lambda problem: {},
        lambda problem: {"iterations": 1},
        with_outliers,
        lambda problem: {**with_outliers(problem), "huber_px": 1.0},
        lambda problem: {"edge": np.random.default_rng(3).normal(0, 0.6, problem.xy.shape)},
        lambda problem: {"fixed": np.arange(6) == 0, "keep_baseline": True},
        lambda problem: {"fixed": np.arange(6) == 3, "keep_baseline": True},
        lambda problem: {"view": problem.view[::-1], "point": problem.point[::-1], "xy": problem.xy[::-1]},
        lambda problem: (
            {name: np.repeat(vars(problem)[name], 2, axis=0) for name in ("view", "point", "xy", "edge")}
            | {name: np.repeat(vars(problem)[name], 2) for name in ("sigma_px", "confidence")}
        ),
    ],
    ids=[
        "window",
        "a step",
        "outliers",
        "Eq. 22",
        "edges",
        "baseline",
        "baseline from the middle",
        "any order",
        "seen twice",
    ],
)
def test_dense_algebra_ends_where_gtsam_does(changes, monkeypatch):
    # The information alone, as GTSAM's marginals.
    monkeypatch.setattr(covariance_of_window, "_MIN_GROUPS", 99)
    problem, _, _ = make_problem(num_points=40, shake=0.05)
    dense, sparse = both_ways(BundleProblem(**{**vars(problem), **changes(problem)}))
    assert dense.ok
    assert sparse.ok
    assert np.abs(sparse.T_world_cam - problem.T_world_cam).max() > 0.01
    np.testing.assert_allclose(dense.T_world_cam, sparse.T_world_cam, atol=2e-6)
    np.testing.assert_allclose(dense.xyz, sparse.xyz, atol=2e-5)
    ended = replace(sparse.problem, T_world_cam=sparse.T_world_cam, xyz=sparse.xyz)
    marginals = gtsam.Marginals(*bundle._build(ended, np.ones(len(ended.xy), bool)))
    for k in np.flatnonzero(~ended.fixed).tolist():
        expected = marginals.marginalCovariance(X(k))
        scale = np.sqrt(np.diag(expected))
        difference = (dense.covariances[k, :6, :6] - expected) / np.outer(scale, scale)
        assert np.abs(difference).max() < 1e-3


def test_a_step_that_would_make_it_worse_is_shortened_as_gtsam_does(monkeypatch):
    problem, _, _ = make_problem(num_views=4, num_points=4, shake=0.4, seed=5)
    tried = []
    step = dense_bundle.Normal.step
    monkeypatch.setattr(
        dense_bundle.Normal, "step", lambda self, damping: tried.append(damping) or step(self, damping)
    )
    dense, sparse = both_ways(problem)
    assert any(later > before for before, later in pairwise(tried)), "nothing was shortened"
    np.testing.assert_allclose(dense.T_world_cam, sparse.T_world_cam, atol=1e-5)
