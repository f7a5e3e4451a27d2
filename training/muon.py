"""Muon: momentum whose matrix is replaced by the nearest orthogonal one (Jordan et al. 2024)."""

from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor

from semcast.common.nets.precision import has_fast_bfloat16

#: Of the iteration.
_NUM_STEPS = 5


def orthogonalise(matrices: Tensor) -> Tensor:
    """Bring all singular values of each matrix close to 1 by a quintic Newton-Schulz iteration.

    They end between about 0.7 and 1.2, which is all the optimiser needs. Runs in bfloat16, but
    on a CPU that would emulate it.

    Args:
        matrices: ``(N, rows, columns)``; a whole stack costs a GPU hardly more than one.
    """
    a, b, c = 3.4445, -4.7750, 2.0315
    is_emulated = matrices.device.type == "cpu" and not has_fast_bfloat16()
    x = matrices if is_emulated else matrices.bfloat16()
    is_tall = x.shape[1] > x.shape[2]
    if is_tall:
        x = x.mT
    x = x / (x.norm(dim=(1, 2), keepdim=True) + 1e-7)
    for _ in range(_NUM_STEPS):
        gram = x @ x.mT
        poly = torch.baddbmm(gram, gram, gram, beta=b, alpha=c)
        x = torch.baddbmm(x, poly, x, beta=a)
    nearest: Tensor = (x.mT if is_tall else x).to(matrices.dtype)
    return nearest


class Muon(torch.optim.Optimizer):
    """Muon for weights that act as matrices; kernels are reshaped to ``(out, in * k * k)``.

    Args:
        params: Weights of two or more dimensions.
        lr: Length of an update against the size of the matrix; 0.02 suits most.
        momentum: Nesterov momentum.
        weight_decay: Decoupled decay, times the learning rate. An update has singular values of 1, so a
            kernel's can't outgrow ``1 / weight_decay``. Without it they grow without end where the gradient
            is mostly noise.
    """

    def __init__(
        self, params: Iterable[Tensor], lr: float, momentum: float = 0.95, weight_decay: float = 0.0
    ) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum, "weight_decay": weight_decay})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """Update all weights that have a gradient."""
        loss = closure() if closure is not None else None
        for group in self.param_groups:
            weights = [weight for weight in group["params"] if weight.grad is not None]
            if not weights:
                continue
            updates = self._blend(weights, group["momentum"])
            torch._foreach_mul_(weights, 1.0 - group["lr"] * group["weight_decay"])
            same_shape: dict[tuple[int, int], list[int]] = {}
            for idx, weight in enumerate(weights):
                rows = weight.shape[0]
                same_shape.setdefault((rows, weight.numel() // rows), []).append(idx)
            for (rows, columns), members in same_shape.items():
                nearest = orthogonalise(torch.stack([updates[idx].flatten(1) for idx in members]))
                # The factor keeps the rms of the update independent of the shape.
                size = max(1.0, rows / columns) ** 0.5
                alike = [weights[idx] for idx in members]
                steps = [one.view_as(weight) for one, weight in zip(nearest, alike, strict=True)]
                torch._foreach_add_(alike, steps, alpha=-group["lr"] * size)
        return loss

    def _blend(self, weights: list[Tensor], momentum: float) -> Sequence[Tensor]:
        """Take the gradients into the momenta and return their Nesterov means."""
        gradients = [weight.grad for weight in weights if weight.grad is not None]
        for weight in weights:
            if "momentum" not in self.state[weight]:
                self.state[weight]["momentum"] = torch.zeros(weight.shape, device=weight.device)
        buffers = [self.state[weight]["momentum"] for weight in weights]
        torch._foreach_lerp_(buffers, gradients, 1.0 - momentum)
        return torch._foreach_lerp(gradients, buffers, momentum)
