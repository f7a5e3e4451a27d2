"""A larger network starts as the smaller one it grew from, and can learn with everything it has."""

import dataclasses

import pytest
import torch

from semcast.common.errors import ConfigError
from semcast.common.nets.registry import architecture
from semcast.common.nets.transceiver import Sizes, build_3dcsc
from semcast.training.centring import centre_hidden, folded, hidden_layers, unfolded
from semcast.training.growing import grow

SMALL = Sizes((8, 12, 16), (1, 1, 1), (1, 1, 1), 8)
LARGE = Sizes((12, 16, 24), (1, 2, 2), (2, 1, 2), 12)


def trained(sizes, seed=0):
    """A network none of whose weights are left at zero, as after training."""
    torch.manual_seed(seed)
    model = build_3dcsc(sizes).eval()
    with torch.no_grad():
        for weight in model.parameters():
            weight.add_(0.05 * torch.randn_like(weight))
    return model


def outputs(model):
    torch.manual_seed(3)
    x = torch.rand(2, 3, 64, 64)
    snr_db, is_qam = torch.tensor([4.0, 11.0]), torch.tensor([0.0, 1.0])
    latent = model.latent(x, snr_db, is_qam)
    plane = snr_db.view(2, 1, 1, 1).expand(2, 1, 4, 4)
    x_hat, features = model.receive(0.7 * model.transmit(latent, is_qam), plane, is_qam)
    return latent, x_hat, *model.judge(features, x_hat)


def test_a_grown_network_computes_what_the_small_one_does():
    small = trained(SMALL)
    torch.manual_seed(1)
    large = build_3dcsc(LARGE).eval()
    grow(small, large)
    with torch.no_grad():
        for ours, theirs in zip(outputs(large), outputs(small), strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_what_reads_the_new_units_has_a_gradient():
    small = trained(SMALL)
    large = build_3dcsc(LARGE)
    grow(small, large)
    sum(part.square().mean() for part in outputs(large)).backward()
    for name in ("encoder.head.weight", "decoder.head.weight", "decoder.up4.conv.weight"):
        new = dict(large.named_parameters())[name].grad[:, -4:]
        assert new.abs().sum() > 0, name


def test_a_network_of_the_same_size_is_copied():
    small, other = trained(SMALL), build_3dcsc(SMALL)
    grow(small, other)
    for name, weight in other.state_dict().items():
        torch.testing.assert_close(weight, small.state_dict()[name], rtol=0, atol=0)


@pytest.mark.parametrize(
    "change", [{"widths": (8, 12, 12)}, {"encoder_units": (1, 1, 0)}, {"confidence_channels": 4}]
)
def test_a_network_that_does_not_fit_is_refused(change):
    with pytest.raises(ConfigError, match="grow_from must hold a network that fits"):
        grow(trained(SMALL), build_3dcsc(dataclasses.replace(SMALL, **change)))


@pytest.mark.parametrize("name", ["cnn", "vit", "mae"])
def test_a_rival_goes_on_from_its_own_weights_alone(name):
    entry = architecture(name)
    first, again = entry.build(entry.sizes), entry.build(entry.sizes)
    grow(first, again)
    for key, weight in again.state_dict().items():
        torch.testing.assert_close(weight, first.state_dict()[key], rtol=0, atol=0)
    with pytest.raises(ConfigError, match="grow_from must hold a network of just this architecture"):
        grow(first, build_3dcsc(LARGE))


def test_unfolding_undoes_folding():
    model = trained(SMALL)

    def run(net):
        with torch.no_grad():
            outputs(net)

    centred = unfolded(model, run)
    layer, raised = hidden_layers(model)[0], hidden_layers(centred)[0]
    assert not torch.allclose(layer.bias, raised.bias, atol=1e-3)
    centre_hidden(centred)
    again = folded(centred, run)
    for name, weight in again.state_dict().items():
        torch.testing.assert_close(weight, model.state_dict()[name], rtol=1e-3, atol=1e-4)
