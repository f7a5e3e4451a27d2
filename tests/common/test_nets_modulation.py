import math

import pytest
import torch

from semcast.common.nets.modulation import (
    analog_symbols,
    carrier_pattern,
    demodulate,
    effective_snr_db,
    mean_before_rounding,
    modulate,
    nearest_level,
    shrink_of,
    spread,
    undo_analog,
    unspread,
)
from semcast.common.nets.modulation_numpy import CARRIER_AMPLITUDE
from semcast.common.nets.rounding import CLIP, LOADING, mixing, rounded_snr_db
from semcast.common.phy.qam import SHAPED_SPACING, pam_levels


def test_levels_are_those_of_the_constellation():
    y = torch.linspace(-2, 2, 401)
    levels = nearest_level(y).unique()
    torch.testing.assert_close(levels, torch.from_numpy(SHAPED_SPACING * pam_levels()))


def test_every_value_goes_to_its_nearest_level():
    y = torch.rand(1000, generator=torch.Generator().manual_seed(0)) * 4 - 2
    levels = torch.from_numpy(SHAPED_SPACING * pam_levels())
    nearest = levels[(y[:, None] - levels).abs().argmin(dim=1)]
    torch.testing.assert_close(nearest_level(y), nearest)


def test_gradient_is_the_identity_inside_and_only_pulls_inward_outside():
    # Two steps out: as far beyond the outer level as values inside are off at most.
    assert pytest.approx(4 / math.sqrt(10) * SHAPED_SPACING) == CLIP
    y = torch.tensor([0.1, -0.5, 2 * CLIP, 2 * CLIP], requires_grad=True)
    nearest_level(y).backward(torch.tensor([1.0, -2.0, 3.0, -3.0]))
    torch.testing.assert_close(y.grad, torch.tensor([1.0, -2.0, 3.0, 0.0]))


def test_analog_frames_have_unit_power_each():
    y = torch.randn(2, 94, 4, 4, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.3, 2.0]).view(
        2, 1, 1, 1
    )
    power = 2 * analog_symbols(y).square().mean(dim=(1, 2, 3))
    torch.testing.assert_close(power, torch.ones(2))


@pytest.mark.parametrize("rms", [0.3, 0.7, 1.5])
def test_the_receiver_learns_the_divisor_from_the_air(rms):
    generator = torch.Generator().manual_seed(0)
    y = rms * torch.randn(1, 94, 8, 8, generator=generator)
    noise_var = 0.1
    y_rx = analog_symbols(y) + (noise_var / 2) ** 0.5 * torch.randn(y.shape, generator=generator)
    shrink = torch.full((1, 1, 8, 8), 1 / (1 + noise_var))
    _, scale = undo_analog(y_rx * shrink, shrink)
    true_scale = (2 * (rms**2 + CARRIER_AMPLITUDE**2)) ** 0.5
    assert scale.item() == pytest.approx(true_scale, rel=0.15)


def test_without_noise_the_latent_returns_but_for_its_share_of_the_pattern():
    y = torch.randn(1, 94, 4, 6, generator=torch.Generator().manual_seed(3))
    pattern = carrier_pattern(y)
    y = y - (y * pattern).mean() * pattern
    shrink = torch.ones(1, 1, 4, 6)
    back, _ = undo_analog(analog_symbols(y), shrink)
    torch.testing.assert_close(back, y, atol=1e-4, rtol=1e-3)


def test_a_frame_of_which_nothing_arrived_stays_finite():
    zeros = torch.zeros(1, 94, 2, 2)
    back, scale = undo_analog(zeros, torch.full((1, 1, 2, 2), 0.0099))
    assert torch.isfinite(back).all()
    assert torch.isfinite(scale).all()


def gaussian(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_the_carrier_is_fixed_for_all_time():
    # Weights were trained with it, and both ends, of whatever version, must agree.
    pattern = carrier_pattern(torch.zeros(1, 94, 2, 3))
    assert pattern[0, :8, 0, 0].tolist() == [1, -1, -1, 1, 1, -1, -1, 1]
    assert pattern[0, 0].tolist() == [[1, -1, 1], [-1, 1, -1]]
    signs = pattern[0, :, 0, 0]
    torch.testing.assert_close(pattern[0], signs[:, None, None] * pattern[0, 0])


def test_the_mixing_is_fixed_for_all_time():
    def murmur3(x):
        for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
            x = (x ^ x >> shift) * factor & 0xFFFFFFFF
        return x ^ x >> 16

    of, places = mixing(94, 3), range(1, 94 * 3 + 1)
    first = [murmur3(place) for place in places]
    assert of.order.tolist() == sorted(range(94 * 3), key=first.__getitem__)
    signs = [
        1 - 2 * (murmur3(hashed + place & 0xFFFFFFFF) & 1)
        for hashed, place in zip(first, places, strict=True)
    ]
    assert of.signs.ravel().tolist() == signs
    # Fourth frequency of a cosine transform of 94, at its third place.
    assert of.channels[4, 2] == pytest.approx(math.sqrt(2 / 94) * math.cos(math.pi * 2.5 * 4 / 94), abs=1e-6)
    assert of.columns[0, 1] == pytest.approx(math.sqrt(1 / 3), abs=1e-6)


def test_mixing_keeps_all_and_gives_every_symbol_the_power_of_its_slot():
    loud_blocks = torch.zeros(1, 94, 3, 20)
    loud_blocks[:, :, 0, :4] = 3.0 * gaussian(1, 94, 1, 4)[:, :, 0]
    loud_blocks[:, 5:9, 2] = gaussian(1, 4, 1, 20, seed=1)[:, :, 0]
    mixed = spread(loud_blocks)
    torch.testing.assert_close(unspread(mixed), loud_blocks, atol=1e-5, rtol=0)
    power, mixed_power = loud_blocks.square().mean(dim=(0, 1, 3)), mixed.square().mean(dim=(0, 1, 3))
    torch.testing.assert_close(mixed_power, power)
    assert mixed[:, :, 1].abs().max() == 0.0, "a slot without values stays so: nothing crosses slots"
    by_block = mixed[0, :, 0].square().mean(dim=0)
    assert by_block.max() < 2.0 * by_block.min(), "twenty blocks share what four had"


@pytest.mark.parametrize("snr_db", [-20.0, 0.0, 8.0, 14.0, 30.0])
def test_the_mean_before_rounding_is_that_of_its_posterior(snr_db):
    snr = 10 ** (snr_db / 10)
    noise_var = 0.5 / snr
    before = LOADING * gaussian(400_000, seed=1).double()
    received = nearest_level(before) + noise_var**0.5 * gaussian(400_000, seed=2).double()
    shrink = torch.full((1, 1, 1, 1), snr / (1 + snr))
    found = mean_before_rounding((received * snr / (1 + snr)).view(1, 1, 1, -1), shrink).flatten()
    # Where a value is the posterior mean, it is right on average wherever it lies.
    for low in torch.quantile(found[:100_000], torch.linspace(0.05, 0.85, 5).double()):
        near = (found - low).abs() < 0.1
        assert (before - found)[near].mean().abs() < 5.0 * before[near].std() / near.sum() ** 0.5 + 1e-3


@pytest.mark.parametrize("snr_db", [-10.0, 2.0, 10.0, 40.0])
def test_the_snr_after_rounding_is_what_a_simulated_link_leaves(snr_db):
    snr = 10 ** (snr_db / 10)
    values = 0.5**0.5 * gaussian(1, 94, 40, 40)
    sent = nearest_level(2.0**0.5 * LOADING * spread(values))
    y_rx = (sent + (0.5 / snr) ** 0.5 * gaussian(*sent.shape, seed=1)) * snr / (1 + snr)
    shrink = torch.full((1, 1, 40, 40), snr / (1 + snr))
    back = unspread(mean_before_rounding(y_rx, shrink)) / (2.0**0.5 * LOADING)
    known = (back * values).mean() / values.square().mean()
    expected_db = effective_snr_db(torch.tensor([snr_db]), torch.ones(1)).item()
    assert 10 * math.log10(known / (1 - known)) == pytest.approx(expected_db, abs=0.1)
    assert expected_db == pytest.approx(float(rounded_snr_db(snr_db)), abs=1e-5)
    assert 2.0 * sent.square().mean() == pytest.approx(1.0, abs=0.02), "all the power that is allowed"


def test_the_snr_after_rounding_is_that_of_the_link_for_analog_values():
    snr_db = torch.tensor([[3.0, 8.0], [3.0, 8.0]])
    both = effective_snr_db(snr_db, torch.tensor([1.0, 0.0]))
    torch.testing.assert_close(both[1], snr_db[1])
    assert (both[0] < snr_db[0]).all()
    assert float(effective_snr_db(torch.tensor([60.0]), torch.ones(1))) == pytest.approx(8.75, abs=0.05)


def test_nothing_arrived_means_nothing_is_known():
    zeros = torch.zeros(1, 2, 3, 3)
    assert mean_before_rounding(zeros, torch.zeros(1, 1, 3, 3)).abs().max() == 0.0
    assert mean_before_rounding(zeros, torch.ones(1, 1, 3, 3)).abs().max() == 0.0


def test_what_is_modulated_comes_back_up_to_rounding():
    latent = 0.7 * gaussian(1, 94, 6, 8)
    plane = torch.full((1, 1, 6, 8), 40.0)
    for flag, error in ((0.0, 1e-3), (1.0, 0.18)):
        is_qam = torch.full((1,), flag)
        back, snr_db, _ = demodulate(modulate(latent, is_qam), plane, is_qam)
        shrink = shrink_of(snr_db)
        difference = (back / shrink - latent).square().mean() / latent.square().mean()
        assert difference < error
        assert float(snr_db.mean()) == pytest.approx(40.0 if flag == 0.0 else 8.75, abs=0.05)


def test_a_batch_of_both_modulations_is_that_of_each():
    y = 0.5 * gaussian(2, 94, 4, 4, seed=3)
    snr_db = torch.full((2, 1, 4, 4), 6.0)
    both = demodulate(y, snr_db, torch.tensor([1.0, 0.0]))
    qam = demodulate(y[:1], snr_db[:1], torch.ones(1))
    analog = demodulate(y[1:], snr_db[1:], torch.zeros(1))
    for found, first, second in zip(both, qam, analog, strict=True):
        torch.testing.assert_close(found, torch.cat((first, second)))
    flags = torch.tensor([1.0, 0.0])
    sent = modulate(y, flags)
    torch.testing.assert_close(sent[:1], modulate(y[:1], flags[:1]))
    torch.testing.assert_close(sent[1:], modulate(y[1:], flags[1:]))
