import platform

import pytest
import torch

from semcast.common.nets import int8
from semcast.common.nets.int8 import Int8Conv, has_int8

needs_int8 = pytest.mark.skipif(
    not has_int8(), reason="no fast convolutions of eight bits on this processor, or not in this torch"
)


@pytest.fixture
def asked_anew():
    has_int8.cache_clear()
    yield
    has_int8.cache_clear()


def rounded_by_hand(x, weight):
    """Input and weights as eight and seven bits hold them, float64."""
    least = min(float(x.min()), 0.0)
    step = max(float(x.max()) - least, 1e-6) / 255
    zero = round(-least / step)
    values = (torch.round(x.double() / step) + zero).clamp(0, 255) - zero
    steps = weight.double().abs().amax((1, 2, 3), keepdim=True) / 63
    return step * values, steps * torch.round(weight.double() / steps)


@needs_int8
@pytest.mark.parametrize(("kernel", "stride", "padding"), [(3, 1, 1), (3, 2, 1), (1, 1, 0)])
@pytest.mark.parametrize("offset", [-0.7, 0.0, 4.0])
def test_it_is_the_convolution_of_rounded_values(kernel, stride, padding, offset):
    generator = torch.Generator().manual_seed(3)
    # Channels of weights of very different size, which one scale for all would lose.
    sizes = torch.logspace(-2, 1, 24)[:, None, None, None]
    weight = sizes * torch.randn(24, 48, kernel, kernel, generator=generator)
    bias = torch.randn(24, generator=generator)
    x = torch.randn(1, 48, 20, 28, generator=generator) + offset
    x = x.contiguous(memory_format=torch.channels_last)
    y = Int8Conv(weight, bias, (stride, stride), (padding, padding))(x)
    exact, coarse = rounded_by_hand(x, weight)
    expected = torch.conv2d(exact, coarse, bias.double(), stride, padding)
    error = (y.double() - expected).abs() / sizes.flatten()[:, None, None]
    # A value in the middle between two steps may go either way.
    assert error.max() < 0.25
    assert (error < 1e-4).double().mean() > 0.9
    assert y.is_contiguous(memory_format=torch.channels_last)


@needs_int8
def test_nothing_gives_the_bias_and_a_channel_without_weights_too():
    weight = torch.ones(2, 3, 3, 3)
    weight[1] = 0.0
    conv = Int8Conv(weight, torch.tensor([2.0, -3.0]), (1, 1), (1, 1))
    for x in (torch.zeros(1, 3, 4, 5), torch.ones(1, 3, 4, 5)):
        y = conv(x.contiguous(memory_format=torch.channels_last))
        assert torch.equal(y[0, 1], torch.full((4, 5), -3.0))
        assert y[0, 0, 1, 1].item() == pytest.approx(2.0 + 27.0 * x.max().item(), rel=1e-5)


@needs_int8
def test_the_largest_products_do_not_overflow():
    """All weights and values at their limits: sums of two products fill sixteen bits."""
    conv = Int8Conv(torch.ones(8, 256, 3, 3), None, (1, 1), (1, 1))
    y = conv(torch.ones(1, 256, 6, 6).contiguous(memory_format=torch.channels_last))
    assert y[0, 0, 2, 2].item() == pytest.approx(256 * 9, rel=1e-5)


class Missing:
    def __init__(self, *_):
        raise AttributeError("no such operator")


class Wrong(Int8Conv):
    def __call__(self, x):
        return -super().__call__(x)


@needs_int8
@pytest.mark.parametrize("broken", [Missing, Wrong])
def test_a_torch_without_it_or_with_another_is_not_trusted(monkeypatch, asked_anew, broken):
    monkeypatch.setattr(int8, "Int8Conv", broken)
    assert not has_int8()


@pytest.mark.parametrize(("machine", "avx2"), [("aarch64", True), ("x86_64", False)])
def test_other_processors_are_left_alone(monkeypatch, asked_anew, machine, avx2):
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(torch.cpu, "_is_avx2_supported", lambda: avx2)
    monkeypatch.setattr(int8, "Int8Conv", lambda *_: pytest.fail("not to be tried"))
    assert not has_int8()
