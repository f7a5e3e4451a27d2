import pytest
import torch

from semcast.common.nets.modulation import (
    CARRIER_AMPLITUDE,
    CLIP,
    analog_symbols,
    carrier_pattern,
    demodulate,
    nearest_level,
    soft_levels,
    undo_analog,
)
from semcast.common.phy.qam import pam_levels


def test_levels_are_those_of_the_constellation():
    y = torch.linspace(-2, 2, 401)
    levels = nearest_level(y).unique()
    torch.testing.assert_close(levels, torch.from_numpy(pam_levels()))


def test_every_value_goes_to_its_nearest_level():
    y = torch.rand(1000, generator=torch.Generator().manual_seed(0)) * 4 - 2
    levels = torch.from_numpy(pam_levels())
    nearest = levels[(y[:, None] - levels).abs().argmin(dim=1)]
    torch.testing.assert_close(nearest_level(y), nearest)


def test_gradient_is_the_identity_inside_and_only_pulls_inward_outside():
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


@pytest.mark.parametrize("snr_db", [-20.0, 0.0, 8.0, 14.0, 30.0])
def test_soft_levels_are_the_posterior_mean(snr_db):
    generator = torch.Generator().manual_seed(1)
    snr = torch.tensor(10 ** (snr_db / 10), dtype=torch.float64)
    noise_var = 0.5 / snr
    levels = torch.from_numpy(pam_levels()).double()
    received = levels[torch.randint(4, (1, 6, 20, 20), generator=generator)]
    received = received + noise_var.sqrt() * torch.randn(received.shape, generator=generator)
    weight = torch.softmax(-(received[..., None] - levels).square() / (2 * noise_var), dim=-1)
    expected = (weight * levels).sum(dim=-1).float()
    shrink = (snr / (1 + snr)).float().expand(1, 1, 20, 20)
    found = soft_levels((received * snr / (1 + snr)).float(), shrink)
    torch.testing.assert_close(found, expected, atol=2e-3, rtol=0)


def test_soft_levels_have_less_error_than_the_equaliser_alone():
    generator = torch.Generator().manual_seed(2)
    sent = torch.from_numpy(pam_levels())[torch.randint(4, (1, 94, 30, 30), generator=generator)]
    errors = {}
    for snr_db in (2.0, 8.0, 14.0):
        snr = 10 ** (snr_db / 10)
        noisy = sent + (0.5 / snr) ** 0.5 * torch.randn(sent.shape, generator=generator)
        shrink = torch.full((1, 1, 30, 30), snr / (1 + snr))
        linear = (noisy * shrink - sent).square().mean()
        errors[snr_db] = (soft_levels(noisy * shrink, shrink) - sent).square().mean() / linear
    assert errors[2.0] < 1.0
    assert errors[8.0] < 0.9
    assert errors[14.0] < 0.35


def test_nothing_arrived_means_nothing_is_known():
    assert soft_levels(torch.zeros(1, 2, 3, 3), torch.zeros(1, 1, 3, 3)).abs().max() == 0.0


def test_a_batch_of_both_modulations_is_that_of_each():
    generator = torch.Generator().manual_seed(3)
    y = 0.5 * torch.randn(2, 94, 4, 4, generator=generator)
    shrink = torch.full((2, 1, 4, 4), 0.8)
    both, scale = demodulate(y, shrink, torch.tensor([1.0, 0.0]))
    qam, one = demodulate(y[:1], shrink[:1], torch.ones(1))
    analog, factor = demodulate(y[1:], shrink[1:], torch.zeros(1))
    torch.testing.assert_close(both, torch.cat((qam, analog)))
    torch.testing.assert_close(scale, torch.cat((one, factor)))
