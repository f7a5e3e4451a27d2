"""How much of their edges the errors of a pair of images have."""

import numpy as np
import pytest
from two_view_matches import CAMERA, make_matches

from semcast.server.geometry.epipolar import shape_of
from semcast.server.geometry.two_view_refinement import shapes_of_errors


@pytest.mark.parametrize(
    ("slide_px", "least", "most"), [(0.1, None, None), (0.35, 0.25, 0.75), (1.0, 0.75, 1.0)]
)
def test_errors_have_as_much_of_their_edges_as_the_distances_bear_out(slide_px, least, most):
    # Across an edge errors are .1 px; edges say that along it they are ten times as large.
    rng = np.random.default_rng(0)
    T, xy0, xy1, _ = make_matches(0, num=300, noise_px=0.0, outlier_share=0.0)
    angle = rng.uniform(0, np.pi, 300)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    xy1 = xy1 + rng.normal(0, slide_px, (300, 1)) * along + rng.normal(0, 0.1, (300, 1)) * across
    xy0 = xy0 + rng.normal(0, slide_px, (300, 1)) * along + rng.normal(0, 0.1, (300, 1)) * across
    edge = 0.5 * np.log(10.0) * along
    shapes = shapes_of_errors(CAMERA, T, xy0, xy1, (edge, edge), 2.0)
    if least is None or most is None:
        assert shapes is None
        return
    assert shapes is not None
    expected = [share for share in (0.25, 0.5, 0.75, 1.0) if np.allclose(shapes[0], shape_of(share * edge))]
    assert len(expected) == 1
    assert least <= expected[0] <= most
    assert np.array_equal(shapes[1], shapes[0])


def test_shapes_of_too_few_matches_near_a_pose_are_none():
    T, xy0, xy1, _ = make_matches(0, num=20, noise_px=0.0, outlier_share=0.0)
    edge = np.tile([0.5, 0.5], (20, 1))
    assert shapes_of_errors(CAMERA, T, xy0[:7], xy1[:7], (edge[:7], edge[:7]), 1.0) is None
