"""Blocks with detail get more values than flat ones, and the receiver is told how many."""

import numpy as np
import pytest

from semcast.common.nets.detail import allocation_for, demand_of, detail_of
from semcast.common.phy.allocation import FIXED_LEVEL, LEVELS, Allocation, levels_for


def half_busy(rows=6, columns=10):
    """Noise on the left, one grey on the right."""
    image = np.full((16 * rows, 16 * columns, 3), 90, np.uint8)
    width = 16 * (columns // 2)
    noise = np.random.default_rng(0).integers(0, 256, (16 * rows, width, 1), dtype=np.uint8)
    image[:, :width] = noise
    return image


def random_levels(shape, seed=0):
    return np.random.default_rng(seed).integers(0, len(LEVELS), shape).astype(np.uint8)


def test_detail_by_hand():
    image = np.zeros((16, 32, 3), np.uint8)
    image[8, 8] = 100  # Laplacian -400 there and 100 at its four neighbours
    detail = detail_of(image)
    assert detail.shape == (1, 2)
    assert detail[0, 0] == pytest.approx((400**2 + 4 * 100**2) / 256 / 16)
    assert detail[0, 1] == 0.0


def test_demand_by_hand():
    detail = np.array([[0.0, 56.0]], np.float32)
    np.testing.assert_allclose(demand_of(detail, exponent=0.5, floor=8.0), [[1.5, 3.0]])


def test_levels_are_nearest_to_the_demand_and_use_the_budget_up():
    # Twice, as often, and half of what is usual: with the demands as they are, 188 + 94 + 48.
    demand = np.log2([188.0, 94.0, 48.0])
    assert [LEVELS[k] for k in levels_for(demand, 188 + 94 + 48)] == [188, 94, 48]
    assert [LEVELS[k] for k in levels_for(demand + 5.0, 188 + 94 + 48)] == [188, 94, 48]
    assert [LEVELS[k] for k in levels_for(demand, 188 + 94 + 47)] != [188, 94, 48]


def test_of_blocks_that_ask_for_the_same_the_first_get_more():
    # Both ends of the link have to divide alike, whatever their processor sorts by.
    levels = levels_for(np.zeros(200), 100 * LEVELS[1] + 100 * LEVELS[0])
    assert levels.tolist() == [1] * 100 + [0] * 100


def test_levels_without_budget_or_with_all_of_it():
    demand = np.random.default_rng(0).normal(0, 2, (3, 4))
    assert not levels_for(demand, 0).any()
    assert (levels_for(demand, 12 * LEVELS[-1]) == len(LEVELS) - 1).all()


def test_more_budget_takes_from_no_block():
    demand = np.random.default_rng(0).normal(0, 2, 200)
    before = levels_for(demand, 200 * 12)
    for budget in range(200 * 12, 200 * 282, 2500):
        after = levels_for(demand, budget)
        assert (after >= before).all()
        assert np.array(LEVELS)[after].sum() <= budget
        before = after


def test_busy_blocks_get_more_and_the_frame_is_filled_but_for_the_code():
    allocation = allocation_for(half_busy())
    left, right = allocation.values[:, :5], allocation.values[:, 5:]
    assert left.min() > right[:, 1:].max()
    used = allocation.num_values + allocation.num_values_of_code
    assert 94 * 60 - LEVELS[-1] < used <= 94 * 60
    assert len(allocation.code) == -(-allocation.num_values_of_code // 16)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (5, 1), (30, 40)])
def test_an_image_of_any_size_fits(shape):
    image = np.random.default_rng(1).integers(0, 256, (16 * shape[0], 16 * shape[1], 3), dtype=np.uint8)
    allocation = allocation_for(image)
    assert allocation.levels.shape == shape
    assert allocation.num_values + allocation.num_values_of_code <= 94 * shape[0] * shape[1]


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (8, 1), (7, 11)])
def test_the_code_tells_the_levels(shape):
    for seed in range(20):
        levels = np.minimum(random_levels(shape, seed), FIXED_LEVEL - 1)
        again = Allocation.from_code(Allocation(levels).code, shape)
        np.testing.assert_array_equal(again.levels, levels)


def test_the_code_of_an_even_picture_is_one_bit_for_each_block():
    allocation = Allocation.fixed((24, 32))
    assert allocation.num_values_of_code == 2 * 24 * 32
    assert len(allocation.code) == 24 * 32 // 8


@pytest.mark.parametrize(
    "code",
    [
        Allocation(np.zeros((3, 4), np.uint8)).code[:-1],
        Allocation(np.zeros((3, 4), np.uint8)).code + b"\0",
        Allocation(np.full((3, 4), len(LEVELS) - 1, np.uint8)).code,
        Allocation.fixed((3, 4)).code,  # fits, but leaves no channel use for itself
        b"\0\x01",  # twelve blocks of one bit each and four bits that mean nothing
        b"\xff",
        b"",
    ],
)
def test_codes_of_other_frames_are_refused(code):
    with pytest.raises(ValueError, match="allocation must be the code of 3x4 blocks"):
        Allocation.from_code(code, (3, 4))


def test_a_frame_may_be_filled_to_the_last_value():
    def taken(levels):
        allocation = Allocation(np.array([levels], np.uint8))
        return allocation.num_values + allocation.num_values_of_code

    grids = np.stack(np.meshgrid(*[np.arange(len(LEVELS))] * 4), axis=-1).reshape(-1, 4)
    full = [levels for levels in grids if taken(levels) == 94 * 4]
    over = [levels for levels in grids if taken(levels) == 94 * 4 + 2]
    assert full
    assert over
    for levels in full:
        code = Allocation(levels[None].astype(np.uint8)).code
        np.testing.assert_array_equal(Allocation.from_code(code, (1, 4)).levels[0], levels)
    for levels in over:
        with pytest.raises(ValueError, match="take at most 376 values"):
            Allocation.from_code(Allocation(levels[None].astype(np.uint8)).code, (1, 4))


def test_levels_that_were_read_can_not_be_changed():
    code = Allocation(np.zeros((3, 4), np.uint8)).code
    with pytest.raises(ValueError, match="read-only"):
        Allocation.from_code(code, (3, 4)).levels[0, 0] = 5


def test_a_row_is_as_good_as_the_mean_share_of_its_values_that_arrives():
    # Slots of 2 x 94 values: the first row has 330, 188 of them in the first slot; the second row 24.
    allocation = Allocation(np.array([[5, 2], [0, 0]], np.uint8))
    assert allocation.values.tolist() == [[282, 48], [12, 12]]
    snr_db = allocation.row_snr_db(np.array([0.0, 10.0 * np.log10(3.0)], np.float32))
    share = (188 * 0.5 + 142 * 0.75) / 330
    np.testing.assert_allclose(snr_db, 10.0 * np.log10([share / (1.0 - share), 3.0]), rtol=1e-5)


def test_a_row_most_of_which_is_lost_counts_as_lost():
    allocation = Allocation(np.array([[3, 3], [2, 2], [2, 2]], np.uint8))
    rows = allocation.row_snr_db(np.array([-20.0, 10.0, 10.0], np.float32))
    assert rows[0] == pytest.approx(-20.0, abs=0.01)
    np.testing.assert_allclose(rows[1:], 10.0, atol=0.01)


def test_a_smooth_picture_is_divided_like_a_sharp_one():
    """With a tenth of the contrast, detail is far below the floor for sharp pictures."""
    faint = (128 + (half_busy().astype(float) - 128) / 40).astype(np.uint8)
    values = allocation_for(faint).values
    assert values[:, :5].min() > values[:, 6:].max()
    assert values[:, :5].mean() > 1.5 * values[:, 6:].mean()
