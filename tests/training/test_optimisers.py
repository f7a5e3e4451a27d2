"""How fast weights are trained."""

import pytest

from semcast.training.optimisers import rate_factor
from semcast.training.settings import TrainSettings


def test_the_rate_warms_up_stays_and_falls_to_zero():
    settings = TrainSettings(warmup_steps=10, decay_share=0.25)
    assert rate_factor(0.0, 0, settings) == pytest.approx(0.1)
    assert rate_factor(0.5, 500, settings) == 1.0
    assert rate_factor(0.875, 500, settings) == pytest.approx(0.5)
    assert rate_factor(1.0, 500, settings) == 0.0
