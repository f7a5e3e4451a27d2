"""A map must begin with the true structure, or wait."""

import numpy as np
import pytest

from semcast.server.mapping.ambiguity import decide
from semcast.server.mapping.planar import twin
from semcast.server.mapping.reversal import mirrored


@pytest.mark.parametrize("seed", range(4))
def test_the_true_structure_is_found_from_either_start(seed, arc, direction_error_deg):
    truth = arc(focal_px=600.0, depth=4.0, noise_px=0.7, seed=seed)
    for start in (truth, mirrored(truth)):
        side = decide(start)
        assert side is not None
        assert direction_error_deg(side.T_world_cam, truth.T_world_cam) < 5.0
        assert np.corrcoef(side.xyz[:, 2], truth.xyz[:, 2])[0, 1] > 0.9


def test_without_perspective_nothing_is_decided_before_the_last_chance(arc):
    far = arc(focal_px=40_000.0, depth=200.0, noise_px=1.0, turn_deg=3.0)
    assert decide(far) is None
    assert decide(far, at_last=True) is not None


@pytest.mark.parametrize("seed", range(3))
def test_a_flat_scene_is_seen_right_from_either_start(seed, wall, direction_error_deg):
    truth = wall(bend=0.5, noise_px=0.4, seed=seed)
    other = twin(truth)
    assert direction_error_deg(other.T_world_cam, truth.T_world_cam) > 25.0
    for start in (truth, other):
        side = decide(start)
        assert side is not None
        assert direction_error_deg(side.T_world_cam, truth.T_world_cam) < 5.0


def test_a_flat_scene_waits_while_both_structures_fit(wall):
    short = wall(way=(0.06, 0.02, 0.04), turn_deg=(0.3, -0.6, 0.0), noise_px=0.6)
    assert decide(short) is None
    assert decide(short, at_last=True) is not None
