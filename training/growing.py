"""Starting a network from a smaller one of its kind: it computes the same at first, with room for more.

The weights of the smaller network become a corner of the larger one's. What is new reads everything (fresh
random weights) and is read by nothing old at first: those weights are zero, and learn from the first step on
(function-preserving growth, Chen, Goodfellow and Shlens 2016).
"""

import torch
from torch import Tensor

from semcast.common.errors import ConfigError
from semcast.common.nets.blocks import NUM_CONDITIONS
from semcast.common.nets.encoder import Encoder
from semcast.common.nets.transceiver import Transceiver

#: Values of the decoded image as the confidence branch reads it, 4x4 pixels of three colours.
_FOLDED = 48


def _parts(name: str, inputs: int, own: int) -> list[int]:
    """Lengths of the parts a layer's input is put together from; growth lengthens each.

    Args:
        name: Of the weight.
        inputs: How many values it reads.
        own: Width of the confidence branch.
    """
    if name.endswith("attention.squeeze.weight"):
        return [inputs - NUM_CONDITIONS, NUM_CONDITIONS]
    if name in ("confidence.fuse16.weight", "confidence.fuse8.weight"):
        return [own, inputs - own]
    if name == "confidence.fuse4.weight":
        return [own, inputs - own - _FOLDED, _FOLDED]
    return [inputs]


def _places(old: list[int], new: list[int]) -> Tensor:
    """Index of every old input among the new ones."""
    starts = [sum(new[:k]) for k in range(len(new))]
    return torch.cat([start + torch.arange(length) for start, length in zip(starts, old, strict=True)])


def _shapes(state: dict[str, Tensor]) -> dict[str, torch.Size]:
    return {name: weight.shape for name, weight in state.items()}


def _kind(model: Transceiver) -> str:
    return f"{type(model.encoder).__name__} of {sum(p.numel() for p in model.parameters())} weights"


@torch.no_grad()
def grow(small: Transceiver, large: Transceiver) -> None:
    """Make a freshly built network compute what a smaller one computes, in place.

    Args:
        small: Trained.
        large: Of the same sizes, whatever the architecture; or both are of the 3dcsc kind, and this one has
            at least as many channels and units everywhere.

    Raises:
        ConfigError: A weight of the smaller network has no place in the larger one.
    """
    theirs, ours = small.state_dict(), large.state_dict()
    if _shapes(theirs) == _shapes(ours):
        large.load_state_dict(theirs)
        return
    if not (isinstance(small.encoder, Encoder) and isinstance(large.encoder, Encoder)):
        # How inputs are put together is known of the 3dcsc kind only.
        raise ConfigError(
            "grow_from must hold a network of just this architecture and size, or a smaller 3dcsc one for a "
            f"larger one, got {_kind(small)} for {_kind(large)}"
        )
    was, own = (len(state["confidence.start.bias"]) for state in (theirs, ours))
    for name, old in theirs.items():
        new = ours.get(name)
        fits = new is not None and new.ndim == old.ndim
        if new is None or not fits or any(a > b for a, b in zip(old.shape, new.shape, strict=True)):
            to = "nothing" if new is None else tuple(new.shape)
            raise ConfigError(f"grow_from must hold a network that fits: {name} {tuple(old.shape)} into {to}")
        if old.shape == new.shape:
            new.copy_(old)
        elif old.ndim == 1:
            new[: len(old)] = old
        else:
            rows = len(old)
            new[:rows] = 0.0
            places = _places(_parts(name, old.shape[1], was), _parts(name, new.shape[1], own))
            new[:rows].index_copy_(1, places, old)
