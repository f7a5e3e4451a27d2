import pytest
import torch

from semcast.common.nets.blocks import ChannelAttention, ResidualUnit, Upsample
from semcast.common.nets.registry import build
from semcast.common.nets.transceiver import Sizes, build_3dcsc
from semcast.common.nets.vit import Trunk, positions, window_starts

TINY = Sizes((8, 8, 8), (1, 1, 1), (1, 1, 1), 8)


@pytest.fixture
def model():
    torch.manual_seed(0)
    return build_3dcsc(TINY).eval()


def link_planes(snr_db, rows, columns):
    return torch.full((1, 1, rows, columns), float(snr_db))


def test_a_latent_has_94_channels_at_a_sixteenth(model):
    latent = model.latent(torch.rand(2, 3, 32, 48), torch.full((2,), 10.0), torch.ones(2))
    assert latent.shape == (2, 94, 2, 3)


@pytest.mark.parametrize("flag", [0.0, 1.0])
def test_what_goes_in_comes_out_at_the_same_size(model, flag):
    is_qam = torch.full((1,), flag)
    symbols = model.transmit(model.latent(torch.rand(1, 3, 32, 48), torch.full((1,), 10.0), is_qam), is_qam)
    x_hat, features = model.receive(symbols, link_planes(10, 2, 3), is_qam)
    logit, displacement = model.judge(features, x_hat)
    assert x_hat.shape == (1, 3, 32, 48)
    assert logit.shape == displacement.shape == (1, 1, 32, 48)
    assert (displacement >= 0).all()


def test_one_batch_may_mix_both_modulations(model):
    x = torch.rand(2, 3, 32, 32)
    snr_db, is_qam = torch.full((2,), 10.0), torch.tensor([1.0, 0.0])
    mixed = model.transmit(model.latent(x, snr_db, is_qam), is_qam)
    alone = [
        model.transmit(model.latent(x[k : k + 1], snr_db[:1], is_qam[k : k + 1]), is_qam[k : k + 1])
        for k in (0, 1)
    ]
    torch.testing.assert_close(mixed, torch.cat(alone), atol=1e-5, rtol=1e-4)


def test_a_lost_slot_gives_a_finite_image(model):
    symbols = torch.zeros(1, 94, 2, 2)
    for flag in (0.0, 1.0):
        x_hat, _ = model.receive(symbols, link_planes(-20, 2, 2), torch.full((1,), flag))
        assert torch.isfinite(x_hat).all()


def test_every_weight_of_the_image_path_gets_a_gradient_once_it_has_left_its_start():
    torch.manual_seed(0)
    model = build_3dcsc(TINY)
    with torch.no_grad():
        for weight in model.parameters():
            weight.add_(0.02 * torch.randn_like(weight))
    is_qam, snr_db = torch.tensor([1.0, 0.0]), torch.full((2,), 8.0)
    symbols = model.transmit(model.latent(torch.rand(2, 3, 32, 32), snr_db, is_qam), is_qam)
    x_hat, _ = model.receive(symbols, link_planes(8, 2, 2).expand(2, 1, 2, 2), is_qam)
    x_hat.square().mean().backward()
    for name, weight in (*model.encoder.named_parameters(), *model.decoder.named_parameters()):
        assert weight.grad is not None, name
        assert weight.grad.abs().sum() > 0, name


def test_attention_and_residual_units_start_as_the_identity():
    x = torch.randn(2, 8, 4, 4, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(ChannelAttention(8)(x, torch.randn(2, 1)), x)
    torch.testing.assert_close(ResidualUnit(8)(x), x)


def test_blocks_pass_a_gradient_check():
    torch.manual_seed(0)
    x = torch.randn(1, 4, 4, 4, dtype=torch.double, requires_grad=True)
    condition = torch.randn(1, 1, dtype=torch.double)
    attention = ChannelAttention(4).double()
    torch.nn.init.normal_(attention.excite.weight)
    assert torch.autograd.gradcheck(lambda v: attention(v, condition), (x,))
    assert torch.autograd.gradcheck(Upsample(4, 2).double(), (x,))


@pytest.mark.parametrize(("name", "limit"), [("3dcsc", 45_000.0), ("3dcsc-lite", 15_000.0)])
def test_the_encoder_keeps_its_budget_of_multiplications_per_pixel(name, limit):
    encoder = build(name).encoder
    count = 0

    def add(layer, _, output):
        nonlocal count
        kernel = layer.weight.shape
        count += output.shape[-1] * output.shape[-2] * kernel.numel()

    for layer in encoder.modules():
        if isinstance(layer, torch.nn.Conv2d):
            layer.register_forward_hook(add)
    with torch.inference_mode():
        encoder(torch.rand(1, 3, 64, 64), torch.full((1,), 10.0))
    assert count / 64**2 <= limit


@pytest.mark.parametrize("name", ["cnn", "vit", "mae"])
def test_rivals_fit_the_same_shell(name):
    torch.manual_seed(0)
    model = build(name).eval()
    is_qam = torch.tensor([1.0, 0.0])
    with torch.inference_mode():
        latent = model.latent(torch.rand(2, 3, 32, 48), torch.full((2,), 10.0), is_qam)
        symbols = model.transmit(latent, is_qam)
        x_hat, features = model.receive(symbols, link_planes(10, 2, 3).expand(2, 1, 2, 3), is_qam)
        logit, displacement = model.judge(features, x_hat)
    assert latent.shape == (2, 94, 2, 3)
    assert x_hat.shape == (2, 3, 32, 48)
    assert logit.shape == displacement.shape == (2, 1, 32, 48)


def test_positions_tell_every_patch_apart():
    grid = positions(6, 9, 64, torch.zeros(()))[0]
    distance = torch.cdist(grid, grid) + 10 * torch.eye(54)
    assert distance.min() > 0.1


@pytest.mark.parametrize(
    ("length", "size", "starts"), [(7, 7, [0]), (10, 10, [0]), (11, 6, [0, 5]), (32, 8, [0, 8, 16, 24])]
)
def test_equal_windows_cover_a_side(length, size, starts):
    assert window_starts(length, largest=10) == (size, starts)
    assert {k for start in starts for k in range(start, start + size)} == set(range(length))


def test_attention_stays_in_its_window():
    torch.manual_seed(0)
    trunk = Trunk(dim=16, heads=2, depth=1, window=4)
    for weight in trunk.parameters():
        torch.nn.init.normal_(weight, std=0.3)
    tokens, condition = torch.randn(2, 16, 4, 8), torch.randn(2, 1)
    left = trunk(tokens[..., :4], condition)
    torch.testing.assert_close(trunk(tokens, condition)[..., :4], left)
    torch.testing.assert_close(trunk(tokens, condition)[..., 4:], trunk(tokens[..., 4:], condition))
    assert not torch.allclose(trunk(tokens.roll(1, dims=2), condition)[..., :4], left)
