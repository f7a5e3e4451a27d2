"""Muon: momentum whose matrix is replaced by the nearest orthogonal one (Jordan et al. 2024)."""

from collections.abc import Callable, Iterable

import torch
from torch import Tensor


def orthogonalise(matrix: Tensor, steps: int = 5) -> Tensor:
    """Bring all singular values of a matrix close to 1 by a quintic Newton-Schulz iteration.

    They end between about 0.7 and 1.2, which is all the optimiser needs. Runs in bfloat16.
    """
    a, b, c = 3.4445, -4.7750, 2.0315
    x = matrix.bfloat16()
    tall = x.shape[0] > x.shape[1]
    if tall:
        x = x.T
    x = x / (x.norm() + 1e-7)
    for _ in range(steps):
        gram = x @ x.T
        x = a * x + (b * gram + c * (gram @ gram)) @ x
    nearest: Tensor = (x.T if tall else x).to(matrix.dtype)
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
            for weight in group["params"]:
                if weight.grad is None:
                    continue
                state = self.state[weight]
                if "momentum" not in state:
                    state["momentum"] = torch.zeros_like(weight)
                buffer = state["momentum"]
                buffer.lerp_(weight.grad, 1.0 - group["momentum"])
                update = weight.grad.lerp(buffer, group["momentum"]).flatten(1)
                update = orthogonalise(update).view_as(weight)
                # Keeps the rms of the update independent of the shape.
                size = max(1.0, weight.shape[0] / (weight.numel() // weight.shape[0])) ** 0.5
                weight.mul_(1.0 - group["lr"] * group["weight_decay"])
                weight.add_(update, alpha=-group["lr"] * size)
        return loss
