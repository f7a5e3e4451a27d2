"""Depth is right where the images tell it, and not known where they don't."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from semcast.server.dense.depth_map import MAX_DEPTHS, DepthProblem, estimate_depth

XS = (-0.3, 0.0, 0.3)


def problem(row, nearest=1.5, farthest=8.0, k=1):
    return DepthProblem(
        row.views[k], [[row.neighbour(k - 1, k)], [row.neighbour(k + 1, k)]], nearest, farthest
    )


def relative_error(found, truth):
    return np.abs(1 / found - truth) / truth


def test_a_slanted_wall_is_found_to_a_two_hundredth(stand, slant) -> None:
    row = stand([slant], XS)
    found = estimate_depth(problem(row))
    assert found.frame_id == 1
    error = relative_error(found.inverse_depth, row.depths[1])
    assert np.isfinite(error).mean() > 0.9
    # A step is a tenth of the depth here.
    assert np.nanmedian(error) < 0.005
    assert np.nanmean(error > 0.05) < 0.02


def test_what_stands_before_a_wall_has_its_own_depth(stand, wall, plate) -> None:
    row = stand([wall, plate], XS)
    found = estimate_depth(problem(row)).inverse_depth
    truth = row.depths[1]
    for depth in (2.0, 4.0):
        error = relative_error(found, truth)[truth == depth]
        assert np.isfinite(error).mean() > 0.85
        # Windows across the outline have the depth of the plate.
        assert np.nanmean(error < 0.02) > 0.93


def test_a_thing_does_not_grow_over_what_is_fainter_behind_it(stand, faint_wall, plate) -> None:
    """Large windows around its outline are alike at its depth; it has an outline of 224 pixels."""
    row = stand([faint_wall, plate], XS, noise_sd=1.0)
    asked = replace(problem(row), reference=replace(row.views[1], noise=5.0))
    found, truth = estimate_depth(asked).inverse_depth, row.depths[1]
    grown = (np.abs(found - 0.5) < 0.05) & (truth == 4.0)
    assert grown.sum() < 1.7 * 224
    assert np.isfinite(found[truth == 2.0]).mean() > 0.97
    assert np.isfinite(found[truth == 4.0]).mean() > 0.95


def test_a_wall_without_texture_has_no_depth(stand, plain_wall) -> None:
    found = estimate_depth(problem(stand([plain_wall], XS, noise_sd=0.7)))
    assert np.isfinite(found.inverse_depth).mean() < 0.03


def test_specks_of_chance_are_left_out(stand, plain_wall) -> None:
    found = estimate_depth(problem(stand([plain_wall], XS, noise_sd=1.5)))
    known = np.isfinite(found.inverse_depth).astype(np.uint8)
    num, _, facts, _ = cv2.connectedComponentsWithStats(known, connectivity=4)
    assert num > 1, "there is more noise than can be told from a wall"
    assert facts[1:, cv2.CC_STAT_AREA].min() >= 40


@pytest.mark.parametrize(("nearest", "farthest"), [(2.0, 3.97), (4.03, 8.0)])
def test_what_is_beyond_the_depths_tried_is_not_known(stand, wall, nearest, farthest) -> None:
    found = estimate_depth(problem(stand([wall], XS), nearest, farthest))
    assert np.isfinite(found.inverse_depth).mean() < 0.1


def test_depths_are_as_many_as_the_image_moves_by_pixels(stand, wall) -> None:
    def steps(xs):
        found = estimate_depth(problem(stand([wall], xs), nearest=2.0, farthest=8.0))
        return round((1 / 2.0 - 1 / 8.0) / found.step) + 1

    # 140 px focal length: 0.8 units move the image by 0.8 * 140 * (1/2 - 1/8) = 42 px.
    assert steps((-0.8, 0.0, 0.1)) == pytest.approx(42, abs=1)
    assert steps((-1.6, 0.0, 0.1)) == MAX_DEPTHS


def test_a_problem_without_neighbours_or_with_depths_out_of_order_is_refused(stand, wall) -> None:
    row = stand([wall], XS)
    for groups in ([], [[row.neighbour(0, 1)], []]):
        with pytest.raises(ValueError, match="groups must hold neighbours"):
            DepthProblem(row.views[1], groups, 1.0, 2.0)
    for nearest, farthest in ((0.0, 2.0), (2.0, 1.0), (1.0, np.inf)):
        with pytest.raises(ValueError, match="0 < nearest < farthest"):
            DepthProblem(row.views[1], [[row.neighbour(0, 1)]], nearest, farthest)
