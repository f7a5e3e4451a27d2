import torch

from semcast.training.allocations import AllocationSettings
from semcast.training.channel import LinkDrawSettings
from semcast.training.data import Ahead, Crops, CropSettings
from semcast.training.draws import Draws, seed_of_step
from tests.training.test_data import photo


def draws(seed=0, rank=0, is_variable=True):
    crops = Crops([photo(seed=k) for k in range(3)], CropSettings(size_px=32), 4, seed, rank)
    return Draws(crops, LinkDrawSettings(), AllocationSettings() if is_variable else None, seed, rank)


def tensors(draw):
    return [draw.pixels, *vars(draw.links).values(), *vars(draw.sent).values()]


def test_a_step_is_made_of_the_same_whoever_draws_it():
    by_thread, by_processes = Ahead(draws(), 1), Ahead(draws(), 2)
    for step in (5, 6, 7):
        here, there, plain = by_thread.get(step), by_processes.get(step), draws()[step]
        for one, other, third in zip(tensors(here), tensors(there), tensors(plain), strict=True):
            assert torch.equal(one, other)
            assert torch.equal(one, third)
    by_thread.close()
    by_processes.close()


def test_steps_seeds_and_ranks_differ_in_crops_links_and_allocations():
    base = tensors(draws()[3])
    for other in (draws()[4], draws(seed=1)[3], draws(rank=1)[3]):
        for name, one, two in zip(
            ("pixels", "snr_db", "expected_snr_db"), base, tensors(other), strict=False
        ):
            assert not torch.equal(one, two), name
        assert not torch.equal(base[-1], tensors(other)[-1])


def test_a_fixed_rate_has_no_allocation_and_shapes_are_those_of_the_crops():
    assert draws(is_variable=False)[0].sent is None
    draw = draws()[0]
    assert draw.pixels.shape == (4, 3, 32, 32)
    assert draw.links.gain.shape == (4, 1, 2, 1)
    assert draw.sent.values.shape == (4, 1, 2, 2)


def test_no_two_processes_share_a_seed_however_many_they_are():
    most = 2**32 - 1
    seeds = [
        seed_of_step(seed, rank, step)
        for seed in (0, 1, most)
        for rank in (0, 1, 63, 64, 65, 127, 128, 2047)
        for step in (0, 1, 2, 999_999)
    ]
    assert len(set(seeds)) == len(seeds)
    assert max(seeds) < 2**63
    assert seed_of_step(3, 5, 7) == (3 * 1_000_003 + 7) * 64 + 5, "as runs of old had them"
