"""Hidden units are centred while training, and the shipped network gives the same without it."""

import torch

from semcast.common.nets.blocks import Stage
from semcast.training.centring import centre_hidden, folded, hidden_layers, unfolded


def stage():
    torch.manual_seed(0)
    made = Stage(6, 2)
    for layer in hidden_layers(made):
        torch.nn.init.normal_(layer.bias, std=0.1)
        layer.weight.data.sub_(0.2)  # on rectified inputs: off everywhere
    for unit in made.units:
        torch.nn.init.normal_(unit.conv2.weight, std=0.1)
    return made


def images(count=64, seed=1):
    return torch.randn(count, 6, 12, 12, generator=torch.Generator().manual_seed(seed)).relu()


CONDITION = torch.zeros(64, 1)


def hidden_of(model, x):
    seen = []
    handles = [
        layer.register_forward_hook(lambda layer, inputs, out: seen.append(out))
        for layer in hidden_layers(model)
    ]
    with torch.no_grad():
        model(x, CONDITION[: len(x)])
    for handle in handles:
        handle.remove()
    return seen


def test_units_that_would_be_off_are_on_half_of_the_time():
    model = stage()
    assert all((out > 0).float().mean() < 0.1 for out in hidden_of(model.train(), images()))
    centre_hidden(model)
    for layer, out in zip(hidden_layers(model), hidden_of(model, images()), strict=True):
        torch.testing.assert_close(out.mean(dim=(0, 2, 3)), layer.bias.detach(), rtol=0, atol=1e-5)
        assert 0.3 < (out > 0).float().mean() < 0.7
    assert all((out > 0).float().mean() < 0.1 for out in hidden_of(model.eval(), images()))


def test_the_folded_network_gives_what_training_gave():
    model = stage()
    centre_hidden(model)
    batch = images(seed=2)
    plain = folded(model, lambda net: net(batch, CONDITION))
    assert not plain.training
    assert all(not layer._forward_hooks for layer in hidden_layers(plain))
    with torch.no_grad():
        torch.testing.assert_close(
            plain(batch, CONDITION), model.train()(batch, CONDITION), rtol=0, atol=1e-5
        )
        assert not torch.allclose(plain(batch, CONDITION), model.eval()(batch, CONDITION), atol=1e-2)
    assert model.units[0].conv1._forward_hooks, "the model in training keeps its own"


def test_gradients_pass_through_the_mean():
    model = stage().train()
    centre_hidden(model)
    model(images(), CONDITION).square().mean().backward()
    gradient = hidden_layers(model)[0].weight.grad
    assert gradient.abs().sum() > 0


def test_an_unfolded_network_is_centred_to_what_it_gave_and_folds_to_what_it_was():
    def run(model):
        model(images(), CONDITION)

    shipped = stage().eval()
    before = hidden_of(shipped, images())
    opened = unfolded(shipped, run)
    for layer, out in zip(hidden_layers(opened), before, strict=True):
        torch.testing.assert_close(layer.bias.detach(), out.mean(dim=(0, 2, 3)), rtol=0, atol=1e-5)
    centre_hidden(opened)
    for now, then in zip(hidden_of(opened.train(), images()), before, strict=True):
        torch.testing.assert_close(now, then, rtol=0, atol=1e-4)
    for again, layer in zip(hidden_layers(folded(opened, run)), hidden_layers(shipped), strict=True):
        torch.testing.assert_close(again.bias, layer.bias, rtol=0, atol=1e-5)
