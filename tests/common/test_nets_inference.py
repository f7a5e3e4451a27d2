import copy

import pytest
import torch

from semcast.common.nets.inference import ArrangedNet, PlainNet, inference_net
from semcast.common.nets.int8 import has_int8
from semcast.common.nets.modulation import modulate
from semcast.common.nets.registry import build

torch.manual_seed(0)


def perturbed(name):
    """A network none of whose layers is at its start: each layer's order of channels matters then."""
    model = build(name).eval().requires_grad_(False)
    generator = torch.Generator().manual_seed(1)
    for parameter in model.parameters():
        parameter.add_(0.03 * torch.randn(parameter.shape, generator=generator))
    return model


def example(is_qam):
    generator = torch.Generator().manual_seed(2)
    pixels = torch.randint(0, 256, (48, 80, 3), generator=generator, dtype=torch.uint8)
    snr_db = torch.tensor([4.0])
    plane = torch.linspace(-10, 12, 15).view(1, 1, 3, 5)
    y_rx = 0.7 * torch.randn(1, 94, 3, 5, generator=generator)
    return pixels, snr_db, plane, y_rx, torch.tensor([float(is_qam)])


@pytest.mark.parametrize("is_qam", [False, True])
@pytest.mark.parametrize("name", ["3dcsc", "3dcsc-lite"])
def test_arranged_network_equals_its_modules(name, is_qam):
    model = perturbed(name)
    net = inference_net(copy.deepcopy(model), torch.float32)
    assert isinstance(net, ArrangedNet)
    pixels, snr_db, plane, y_rx, flag = example(is_qam)
    with torch.inference_mode():
        x = pixels.permute(2, 0, 1)[None].float() / 255.0
        torch.testing.assert_close(
            net.latent(pixels, snr_db, flag), model.latent(x, snr_db, flag), rtol=1e-4, atol=1e-4
        )
        x_hat, features = model.receive(y_rx, plane, flag)
        logit, displacement_px = model.judge(features, x_hat)
        image, confidence, moved_px = net.decode(y_rx, plane, flag)
    expected = x_hat[0].clamp(0, 1).mul(255).round().permute(1, 2, 0)
    assert expected.std() > 10  # neither black nor white everywhere
    assert (image.float() - expected).abs().max() <= 1
    torch.testing.assert_close(confidence, torch.sigmoid(logit[0, 0]), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(moved_px, displacement_px[0, 0], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("is_qam", [False, True])
def test_arranged_network_of_variable_rate_equals_its_modules(is_qam):
    model = perturbed("3dcsc-vr")
    net = inference_net(copy.deepcopy(model), torch.float32)
    assert isinstance(net, ArrangedNet)
    pixels, snr_db, plane, y_rx, flag = example(is_qam)
    values = torch.tensor([[[[12, 24, 48, 94, 188], [94, 12, 12, 282, 24], [94, 94, 48, 24, 12]]]])
    with torch.inference_mode():
        x = pixels.permute(2, 0, 1)[None].float() / 255.0
        ours, expected = net.latent(pixels, snr_db, flag, values), model.latent(x, snr_db, flag, values)
        torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-4)
        assert (ours - net.latent(pixels, snr_db, flag, values.flip(3))).abs().max() > 0.01  # it is told
        x_hat, features = model.receive(y_rx, plane, flag, values)
        logit, displacement_px = model.judge(features, x_hat)
        image, confidence, moved_px = net.decode(y_rx, plane, flag, values)
    expected = x_hat[0].clamp(0, 1).mul(255).round().permute(1, 2, 0)
    assert expected.std() > 10
    assert (image.float() - expected).abs().max() <= 1
    torch.testing.assert_close(confidence, torch.sigmoid(logit[0, 0]), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(moved_px, displacement_px[0, 0], rtol=1e-3, atol=1e-4)


def test_bfloat16_stays_close():
    model = perturbed("3dcsc-lite")
    exact, quick = (inference_net(copy.deepcopy(model), d) for d in (torch.float32, torch.bfloat16))
    pixels, snr_db, plane, y_rx, flag = example(is_qam=True)
    with torch.inference_mode():
        latents = [n.latent(pixels, snr_db, flag) for n in (exact, quick)]
        same = modulate(latents[0], flag) == modulate(latents[1], flag)
        images = [n.decode(y_rx, plane, flag)[0].float() for n in (exact, quick)]
    assert same.float().mean() > 0.95
    assert (images[0] - images[1]).abs().mean() < 2


@pytest.mark.skipif(not has_int8(), reason="no fast convolutions of eight bits here")
@pytest.mark.parametrize("name", ["3dcsc-lite", "3dcsc-vr"])
def test_int8_stays_close(name):
    model = perturbed(name)
    exact, quick = (inference_net(copy.deepcopy(model), d) for d in (torch.float32, torch.int8))
    pixels, snr_db, plane, y_rx, flag = example(is_qam=True)
    values = torch.full((1, 1, 3, 5), 94) if model.is_variable else None
    with torch.inference_mode():
        latents = [n.latent(pixels, snr_db, flag, values) for n in (exact, quick)]
        images, confidence, moved_px = zip(
            *(n.decode(y_rx, plane, flag, values) for n in (exact, quick)), strict=True
        )
    for mine, expected in ((latents[1], latents[0]), (moved_px[1], moved_px[0])):
        assert 0 < (mine - expected).std() < 0.1 * expected.std()  # other arithmetic, the same figures
    # Most of what these networks draw is saturated, black to white.
    assert (images[1].float() - images[0].float()).abs().mean() < 5
    assert (confidence[1] - confidence[0]).abs().mean() < 0.02


@pytest.mark.parametrize("name", ["cnn", "vit"])
def test_rivals_run_through_their_own_modules(name):
    model = perturbed(name)
    net = inference_net(copy.deepcopy(model), torch.bfloat16)
    assert isinstance(net, PlainNet)
    pixels, snr_db, plane, y_rx, flag = example(is_qam=True)
    with torch.inference_mode():
        latent = net.latent(pixels, snr_db, flag)
        image, confidence, moved_px = net.decode(y_rx, plane, flag)
    assert latent.shape == (1, 94, 3, 5)
    assert image.shape == (48, 80, 3)
    assert confidence.shape == moved_px.shape == (48, 80)
    assert moved_px.min() >= 0
