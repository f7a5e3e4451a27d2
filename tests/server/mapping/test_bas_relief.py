"""A scene nearer and flatter looks the same under weak perspective."""

import numpy as np
import pytest

from semcast.common.geometry import rotation_angle_deg
from semcast.server.mapping.ambiguity import adjusted, decide
from semcast.server.mapping.bas_relief import nearer


@pytest.mark.parametrize("factor", [2.0, 0.5])
def test_under_weak_perspective_the_images_stay_the_same(arc, projected, factor):
    far = arc(focal_px=6000.0, depth=60.0, num_views=3, turn_deg=1.0)
    same = nearer(far, factor)
    shift_px = np.linalg.norm(projected(same) - projected(far), axis=1)
    moved_px = np.linalg.norm(projected(far)[-120:] - projected(far)[:120], axis=1)
    assert shift_px.mean() < 0.1 * moved_px.mean()
    assert np.median(same.xyz[:, 2]) == pytest.approx(np.median(far.xyz[:, 2]) / factor, rel=0.01)
    assert np.ptp(same.xyz[:, 2]) == pytest.approx(np.ptp(far.xyz[:, 2]) / factor**2, rel=0.01)
    np.testing.assert_array_equal(same.T_world_cam[:, :3, 3], far.T_world_cam[:, :3, 3])


def test_nearer_and_further_again_is_as_it_was(arc):
    problem = arc(focal_px=600.0, depth=4.0)
    again = nearer(nearer(problem, 3.0), 1.0 / 3.0)
    np.testing.assert_allclose(again.T_world_cam, problem.T_world_cam, atol=2e-3)
    np.testing.assert_allclose(again.xyz, problem.xyz, atol=2e-3)


@pytest.mark.parametrize("seed", range(3))
def test_the_true_distance_is_found_where_an_adjustment_stops_on_the_way(arc, relative, seed):
    truth = arc(focal_px=700.0, depth=7.0, noise_px=0.4, num_views=3, turn_deg=7.0, seed=seed)

    def turn_error_deg(structure):
        R_true = relative(truth.T_world_cam)[:3, :3]
        return rotation_angle_deg(R_true.T @ relative(structure.T_world_cam)[:3, :3])

    too_far = nearer(truth, 0.25)
    assert turn_error_deg(adjusted(too_far)) > 2.0
    _, structures = decide(too_far)
    assert turn_error_deg(structures[0]) < turn_error_deg(adjusted(truth)) + 0.5
