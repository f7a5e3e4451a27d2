import pytest
import torch

from semcast.common.nets.modulation import (
    CARRIER_AMPLITUDE,
    CLIP,
    analog_symbols,
    carrier_pattern,
    nearest_level,
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
