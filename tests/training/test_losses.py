import math

import pytest
import torch

from semcast.common.nets.transceiver import Sizes, build_3dcsc, build_variable_3dcsc
from semcast.training.allocations import AllocationDraw
from semcast.training.channel import LinkDrawSettings, draw_links
from semcast.training.descriptors import dense_descriptors, descriptor_loss
from semcast.training.losses import (
    LossSettings,
    confidence_label,
    confidence_loss,
    displacement_loss,
    reconstruction_loss,
    transceiver_loss,
)

TINY = Sizes((8, 8, 8), (1, 1, 1), (1, 1, 1), 8)


def texture(seed=0):
    return torch.rand(1, 1, 32, 32, generator=torch.Generator().manual_seed(seed))


def test_without_a_knee_the_reconstruction_loss_is_the_mean_squared_error():
    x = torch.zeros(2, 3, 4, 4)
    x_hat = x.clone()
    x_hat[1] = 0.2
    loss, each = reconstruction_loss(x_hat, x, 0.0)
    assert loss.item() == pytest.approx(0.02)
    torch.testing.assert_close(each, torch.tensor([0.0, 0.04]))


def test_the_knee_bends_large_errors_only():
    x = torch.zeros(1, 3, 4, 4)
    small, _ = reconstruction_loss(x + 1e-3, x, 1e-3)
    assert small.item() == pytest.approx(1e-6, rel=0.01)
    large, _ = reconstruction_loss(x + 0.1, x, 1e-3)
    assert large.item() == pytest.approx(1e-3 * math.log(11.0), rel=1e-4)


def test_the_confidence_label_is_the_papers():
    x = torch.tensor([0.5, 0.5, 1.0, 0.0]).view(1, 1, 1, 4).repeat(1, 3, 1, 1)
    x_hat = x + torch.tensor([0.0, 0.0, 0.4, -0.2])  # beyond black and white is black and white
    x_hat[0, 0, 0, 1] += 0.03
    label = confidence_label(x_hat, x, 30.0)
    torch.testing.assert_close(label.flatten(), torch.tensor([1.0, 1.0 - math.tanh(0.3), 1.0, 1.0]))


def test_both_confidence_losses_are_least_at_the_label():
    label = torch.full((1, 1, 4, 4), 0.7)
    right = torch.logit(label)
    for kind in ("bce", "l1"):
        at_label = confidence_loss(right, label, kind)
        assert at_label < confidence_loss(right + 0.5, label, kind)
        assert at_label < confidence_loss(right - 0.5, label, kind)


def test_the_displacement_likelihood_is_least_at_the_mean():
    labels = torch.tensor([0.5, 1.5]).view(1, 1, 1, 2)
    strength = torch.ones_like(labels)
    losses = [
        displacement_loss(torch.full_like(labels, d), labels, strength).item() for d in (0.6, 0.98, 1.6)
    ]
    assert losses[1] == min(losses)


def test_displacements_count_by_their_corners_strength():
    # Strengths 9 and 1 are 1.8 and 0.2 times their mean, and 0.05 is added; the scale has 0.02 px more.
    labels, strength = (torch.tensor(v).view(1, 1, 1, 2) for v in ([0.5, 2.0], [9.0, 1.0]))
    each = [math.log(1.0) + 0.5, math.log(1.0) + 2.0]
    expected = (1.85 * each[0] + 0.25 * each[1]) / 2.1
    found = displacement_loss(torch.full_like(labels, 0.98), labels, strength)
    assert found.item() == pytest.approx(expected, rel=1e-5)
    # A single strong corner among many counts for no more than eight.
    one = torch.zeros(1, 1, 1, 100)
    one[..., 0] = 1.0
    labels = torch.where(one > 0, 2.0, 0.0)
    found = displacement_loss(torch.full_like(one, 0.98), labels, one)
    assert found.item() == pytest.approx(8.05 * 2.0 / (8.05 + 99 * 0.05), rel=1e-5)


def test_confidence_losses_by_hand():
    logit, label = torch.zeros(1, 1, 1, 2), torch.tensor([0.7, 0.1]).view(1, 1, 1, 2)
    assert confidence_loss(logit, label, "bce").item() == pytest.approx(math.log(2.0))
    assert confidence_loss(logit, label, "l1").item() == pytest.approx(0.3)


def test_equal_images_have_equal_descriptors_and_contrast_does_not_matter():
    x = texture()
    assert descriptor_loss(x, x).item() == pytest.approx(0.0, abs=1e-10)
    described, energy = dense_descriptors(x)
    assert described.shape[1] == 128
    assert energy.shape == (1, described.shape[2])
    norms = described.norm(dim=1)
    assert norms.min().item() == pytest.approx(1.0, abs=1e-3)
    assert descriptor_loss(x, 0.8 * x + 0.1).item() < 0.02 < descriptor_loss(x, texture(1)).item()


def test_the_descriptor_loss_has_a_finite_gradient_even_on_flat_images():
    flat = torch.full((1, 1, 32, 32), 0.5, requires_grad=True)
    descriptor_loss(texture(), flat).backward()
    assert torch.isfinite(flat.grad).all()


def run_loss(settings, with_heads=True):
    torch.manual_seed(0)
    model = build_3dcsc(TINY)
    with torch.no_grad():
        for weight in model.parameters():
            weight.add_(0.02 * torch.randn_like(weight))
    generator = torch.Generator().manual_seed(0)
    draw = draw_links(LinkDrawSettings(), 2, 2, generator)
    x = torch.rand(2, 3, 32, 32, generator=generator)
    noise = torch.randn(2, 94, 2, 2, generator=generator)
    loss, logs = transceiver_loss(model, x, draw, noise, settings, with_heads)
    loss.backward()
    return model, {**logs, "loss": loss.detach()}


def test_the_log_has_the_power_of_what_is_sent():
    generator = torch.Generator().manual_seed(0)
    model = build_variable_3dcsc(TINY)
    values = torch.tensor([[[[12, 94], [48, 24]]], [[[188, 94], [12, 282]]]])
    sent = AllocationDraw(values, values.sum(dim=3, keepdim=True))
    draw = draw_links(LinkDrawSettings(share_16qam=1.0), 2, 2, generator)
    x = torch.rand(2, 3, 32, 32, generator=generator)
    noise = torch.randn(2, 282, 2, 2, generator=generator)
    _, logs = transceiver_loss(model, x, draw, noise, LossSettings(), False, sent)
    assert logs["power"].item() == pytest.approx(1.0, abs=1e-3)


def test_heads_never_change_the_image_path():
    with_heads, _ = run_loss(LossSettings(confidence=1.0))
    without, _ = run_loss(LossSettings(confidence=0.0))
    for (name, one), (_, two) in zip(
        with_heads.decoder.named_parameters(), without.decoder.named_parameters(), strict=True
    ):
        torch.testing.assert_close(one.grad, two.grad, msg=name)
    assert all(p.grad is not None for p in with_heads.confidence.parameters())
    assert all(p.grad is None for p in without.confidence.parameters())


def test_each_term_can_be_switched_on():
    _, plain = run_loss(LossSettings())
    _, described = run_loss(LossSettings(descriptor=0.1))
    _, bare = run_loss(LossSettings(), with_heads=False)
    assert "descriptor" not in plain
    assert described["descriptor"] > 0
    assert {"pixel", "keypoint"} <= set(plain)
    assert not {"pixel", "keypoint"} & set(bare)


def test_the_loss_is_the_weighted_sum_of_its_terms():
    _, logs = run_loss(LossSettings(mse=3.0, descriptor=0.1, confidence=0.2, mse_knee=0.0))
    heads = logs["pixel"] + 0.5 * logs["keypoint"]
    expected = 3.0 * logs["mse"] + 0.1 * logs["descriptor"] + 0.2 * heads
    assert logs["loss"].item() == pytest.approx(expected.item(), rel=1e-5)
    _, bare = run_loss(LossSettings(mse=3.0, mse_knee=0.0), with_heads=False)
    assert bare["loss"].item() == pytest.approx(3.0 * bare["mse"].item(), rel=1e-5)


def test_bad_weights_are_refused():
    with pytest.raises(ValueError, match="descriptor must be >= 0, got -1"):
        LossSettings(descriptor=-1.0)
    with pytest.raises(ValueError, match="mse must be >= 0, got nan"):
        LossSettings(mse=math.nan)
    with pytest.raises(ValueError, match="one of mse, descriptor and confidence must be > 0"):
        LossSettings(mse=0.0, descriptor=0.0, confidence=0.0)
    with pytest.raises(ValueError, match="confidence_sharpness must be > 0, got 0"):
        LossSettings(confidence_sharpness=0.0)
