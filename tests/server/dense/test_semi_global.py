"""Costs along lines are those of the cheapest ways, and edges let depth jump."""

import numpy as np

from semcast.server.dense.plane_sweep import UNKNOWN_COST
from semcast.server.dense.semi_global import JUMP_COST, NUM_DIRECTIONS, STEP_COST, aggregate


def cheapest(line, jump):
    """Costs of the cheapest ways to each depth of the last pixel of ``(N, D)``, by trying all steps."""
    way = line[0].astype(float)
    for cost in line[1:]:
        steps = np.abs(np.subtract.outer(np.arange(len(way)), np.arange(len(way))))
        price = np.where(steps == 0, 0, np.where(steps == 1, min(STEP_COST, jump), jump))
        way = cost + (way[None] + price).min(axis=1) - way.min()
    return way


def test_every_pixel_has_the_sum_of_the_cheapest_ways_to_it() -> None:
    cost = np.random.default_rng(0).integers(0, UNKNOWN_COST + 1, (6, 7, 9), dtype=np.uint8)
    total = aggregate(cost, np.full((7, 9), 100, np.float32))
    volume = cost.transpose(1, 2, 0)
    for y, x in ((0, 0), (3, 4), (6, 8), (2, 0)):
        lines = (volume[: y + 1, x], volume[y:, x][::-1], volume[y, : x + 1], volume[y, x:][::-1])
        np.testing.assert_allclose(total[y, x], sum(cheapest(line, JUMP_COST) for line in lines))


def test_the_dearest_ways_fit_in_their_bytes() -> None:
    cost = np.full((5, 20, 20), UNKNOWN_COST, np.uint8)
    cost[0] = 0
    total = aggregate(cost, np.zeros((20, 20), np.float32))
    # From the third pixel of a line on a jump is cheaper than having stayed at a dear depth.
    assert (total[2:-2, 2:-2, 4] == NUM_DIRECTIONS * (UNKNOWN_COST + JUMP_COST)).all()


def faint_band(grey):
    """Depth 2 to the left of column 16, depth 7 from column 26 on, nothing to go by in between."""
    cost = np.full((10, 20, 40), UNKNOWN_COST, np.uint8)
    cost[2, :, :16] = 0
    cost[7, :, 26:] = 0
    return aggregate(cost, grey).argmin(axis=-1)


def test_what_is_faint_takes_the_depth_of_its_side_of_an_edge() -> None:
    for edge in (18, 24):
        grey = np.full((20, 40), 60, np.float32)
        grey[:, edge:] = 200
        depth = faint_band(grey)
        assert (depth[:, :edge] == 2).all()
        assert (depth[:, edge:] == 7).all()


def test_a_lone_mismatch_is_outvoted() -> None:
    cost = np.full((8, 15, 15), 60, np.uint8)
    cost[3] = 10
    cost[3, 7, 7], cost[6, 7, 7] = 60, 0
    assert (aggregate(cost, np.full((15, 15), 90, np.float32)).argmin(axis=-1) == 3).all()
