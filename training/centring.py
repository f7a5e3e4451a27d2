"""Keeps hidden units of residual blocks alive: they are centred while training, at no cost afterwards.

Behind a trunk of rectified features every hidden unit has an easy way to do less harm early on, which is to
be negative everywhere; it is then off for good. (Three quarters of all hidden units of a network ended so,
and whole blocks with them.) While training, each unit's mean over the batch is taken off (mean-only batch
normalisation, Salimans and Kingma 2016). The mean over training images is folded into the bias afterwards:
the network that is shipped has no trace of it.
"""

import copy
from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor, nn

from semcast.common.nets.blocks import ResidualUnit

M = TypeVar("M", bound=nn.Module)


def hidden_layers(model: nn.Module) -> list[nn.Conv2d]:
    """Return the first convolution of every residual block."""
    return [m.conv1 for m in model.modules() if isinstance(m, ResidualUnit)]


def _without_bias(layer: nn.Module, out: Tensor) -> Tensor:
    """Mean over the batch of what a layer adds to its bias, ``(C,)``."""
    bias = layer.bias
    assert isinstance(bias, Tensor)
    return out.float().mean(dim=(0, 2, 3)) - bias.float()


def _centre(layer: nn.Module, inputs: object, out: Tensor) -> Tensor | None:
    if not layer.training:
        return None
    return out - _without_bias(layer, out).to(out.dtype)[None, :, None, None]


def centre_hidden(model: nn.Module) -> None:
    """Centre the hidden units of every residual block from now on, in training mode; biases stay in force."""
    for layer in hidden_layers(model):
        layer.register_forward_hook(_centre)


def _means(model: nn.Module, run: Callable[[], object]) -> dict[nn.Conv2d, Tensor]:
    """Mean over all batches of what each hidden layer adds to its bias."""
    means: dict[nn.Conv2d, list[Tensor]] = {layer: [] for layer in hidden_layers(model)}

    def note(layer: nn.Module, inputs: object, out: Tensor) -> None:
        assert isinstance(layer, nn.Conv2d)
        means[layer].append(_without_bias(layer, out))

    # Before the centring hook, which a model in training has.
    handles = [layer.register_forward_hook(note, prepend=True) for layer in means]
    run()
    for handle in handles:
        handle.remove()
    return {layer: torch.stack(seen).mean(dim=0) for layer, seen in means.items()}


@torch.no_grad()
def unfolded(model: M, run: Callable[[M], object]) -> M:
    """Return a copy of a network without centring whose biases are those of a centred one; undoes ``folded``.

    Args:
        model: As it is shipped.
        run: Runs many training images through the model it is given.
    """
    plain = copy.deepcopy(model).eval()
    for layer, mean in _means(plain, lambda: run(plain)).items():
        assert layer.bias is not None
        layer.bias += mean
    return plain


@torch.no_grad()
def folded(model: M, run: Callable[[M], object]) -> M:
    """Return a copy in evaluation mode that needs no centring: its biases hold the means.

    Args:
        model: Trained with ``centre_hidden``.
        run: Runs many training images through the model it is given.
    """
    plain = copy.deepcopy(model).train()
    for layer, mean in _means(plain, lambda: run(plain)).items():
        layer._forward_hooks.clear()
        assert layer.bias is not None
        layer.bias -= mean
    return plain.eval()
