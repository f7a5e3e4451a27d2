import numpy as np
import pytest
import torch

from semcast.common.phy.allocation import LEVELS
from semcast.training.allocations import AllocationDraw, AllocationSettings, draw_allocation


def crops():
    """One flat crop and one full of detail."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randint(0, 256, (1, 3, 64, 64), generator=generator, dtype=torch.uint8)
    return torch.cat((torch.full_like(noise, 120), noise))


def draw(seed=0, **changes):
    generator = torch.Generator().manual_seed(seed)
    return draw_allocation(crops(), AllocationSettings(**changes), generator).values


def test_the_blocks_of_a_batch_share_one_budget():
    values = draw(block_sd=0.0, budget_sd=0.0, budget=94.0)
    assert values.shape == (2, 1, 4, 4)
    assert set(values.flatten().tolist()) <= set(LEVELS)
    assert 94 * 32 - LEVELS[-1] < int(values.sum()) <= 94 * 32
    assert values[0].max() < values[1].min()


def test_without_an_exponent_all_blocks_are_alike():
    values = draw(exponent_min=0.0, exponent_max=0.0, block_sd=0.0, budget_sd=0.0, budget=94.0)
    assert (values == 94).all()


def test_budgets_and_blocks_scatter_by_the_powers_of_two_that_are_set():
    alike = {"exponent_min": 0.0, "exponent_max": 0.0, "budget": 50.0}
    budgets = [float(draw(seed, **alike, block_sd=0.0, budget_sd=0.3).float().mean()) for seed in range(300)]
    assert float(np.log2(budgets).mean()) == pytest.approx(np.log2(50.0), abs=4 * 0.3 / np.sqrt(300))
    assert float(np.log2(budgets).std()) == pytest.approx(0.3, rel=0.2)
    blocks = torch.cat([draw(seed, **alike, block_sd=0.4, budget_sd=0.0).flatten() for seed in range(20)])
    assert float(blocks.double().log2().std()) == pytest.approx(0.4, rel=0.2)


def test_what_is_behind_the_cut_of_a_row_is_in_the_next_slot():
    values = torch.tensor([[[[12, 24, 12]]]])
    behind = AllocationDraw(values, torch.tensor([[[[20]]]])).in_next_slot()
    assert behind.shape == (1, 282, 1, 3)
    assert not behind[0, :12, 0, 0].any()
    assert behind[0, :24, 0, 1].tolist() == [False] * 8 + [True] * 16
    assert behind[0, :12, 0, 2].all()


def test_cuts_are_anywhere_in_a_row_or_behind_it():
    generator = torch.Generator().manual_seed(0)
    draws = [draw_allocation(crops(), AllocationSettings(), generator) for _ in range(60)]
    shares = torch.cat([(d.num_before / d.values.sum(dim=3, keepdim=True)).flatten() for d in draws])
    assert shares.min() < 0.05
    assert float((shares >= 1.0).float().mean()) == pytest.approx(0.35, abs=0.08)


def test_draws_are_repeatable_and_differ_from_seed_to_seed():
    assert torch.equal(draw(3), draw(3))
    assert len({int(draw(seed).sum()) for seed in range(8)}) > 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"exponent_min": 0.9},
            "must be in \\[0, 2\\] and ordered, got 0.9, 0.75",
        ),
        ({"floor": 0.0}, "floor must be in \\(0, 65025\\), got 0.0"),
        ({"block_sd": -1.0}, "block_sd must be in \\[0, 4\\], got -1.0"),
        ({"budget": 5.0}, "budget must be in \\[12, 188\\], got 5.0"),
    ],
)
def test_settings_are_checked(change, message):
    with pytest.raises(ValueError, match=message):
        AllocationSettings(**change)


def test_groups_of_crops_have_budgets_of_their_own():
    many = crops()[1:].repeat(64, 1, 1, 1)
    settings = AllocationSettings(block_sd=0.0, exponent_min=0.5, exponent_max=0.5, budget_sd=1.0)
    values = draw_allocation(many, settings, torch.Generator().manual_seed(0)).values
    means = values.float().mean(dim=(1, 2, 3)).view(4, 16)
    assert len({round(float(mean)) for mean in means.mean(dim=1)}) > 2
