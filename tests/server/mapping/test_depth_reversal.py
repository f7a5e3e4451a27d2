"""The mirror image of a structure in depth."""

import numpy as np

from semcast.server.mapping.depth_reversal import mirrored


def test_from_far_away_the_mirror_image_looks_the_same(arc, projected):
    far = arc(focal_px=160_000.0, depth=800.0)
    near = arc(focal_px=800.0, depth=4.0)
    shift_far = np.abs(projected(mirrored(far)) - far.xy).max()
    shift_near = np.abs(projected(mirrored(near)) - near.xy).max()
    assert shift_far < 1.5
    assert shift_near > 20 * shift_far


def test_the_mirror_image_turns_the_other_way_and_mirrors_depth(arc, relative):
    problem = arc(focal_px=800.0, depth=4.0)
    other = mirrored(problem)
    turn = relative(problem.T_world_cam)[:3, :3]
    np.testing.assert_allclose(relative(other.T_world_cam)[:3, :3], turn.T, atol=0.02)
    depth, mirrored_depth = problem.xyz[:, 2], other.xyz[:, 2]
    assert np.corrcoef(depth, mirrored_depth)[0, 1] < -0.95
    np.testing.assert_allclose(mirrored(other).xyz, problem.xyz, atol=0.2)
