"""How far an answer may be trusted that comes from what adjustments leave over."""

import numpy as np
import pytest

from semcast.evaluation.moving_images import CameraEvidence, ImagesSettings
from semcast.server.mapping.residual_patterns import NUM_GROUPS, spread


@pytest.mark.parametrize("sigma_factor", [1.0, 1.25])
def test_bounds_of_95_percent_cover_the_truth_so_often(sigma_factor):
    says = np.random.default_rng(5).normal(0.0, 3.0, (20_000, NUM_GROUPS))  # the truth is 0
    without_one = (says.sum(axis=1, keepdims=True) - says) / (NUM_GROUPS - 1)
    evidence = CameraEvidence([], 0.2, 60, sigma_factor)
    reach = np.array([evidence.reach_95(spread(estimates) / sigma_factor) for estimates in without_one])
    assert (np.abs(says.mean(axis=1)) <= reach).mean() == pytest.approx(0.95, abs=0.0045)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"source": ""}, "source must name a folder"),
        ({"rate_hz": float("nan")}, r"rate_hz must be in \[0.01, 1000\], got nan"),
        ({"rate_hz": -1.0}, r"rate_hz must be in \[0.01, 1000\], got -1"),
    ],
)
def test_what_no_source_can_have_is_refused_by_the_settings(values, message):
    with pytest.raises(ValueError, match=message):
        ImagesSettings(**{"source": "0", **values})
