"""Which weight is trained by which optimiser, and how fast at which point of the run."""

import torch

from semcast.common.nets.transceiver import Transceiver
from semcast.training.muon import Muon
from semcast.training.settings import TrainSettings

#: Layers that read pixels, or a single plane.
_EDGES = ("encoder.stem.weight", "decoder.estimate.weight", "encoder.share.weight")


def rate_factor(progress: float, step: int, settings: TrainSettings) -> float:
    """Return the share of the learning rate: linear warm-up, constant, linear fall to 0.

    Args:
        progress: Share of the run that is done, in [0, 1].
        step: Steps done.
        settings: Of the run.
    """
    warm = min(1.0, (step + 1) / settings.warmup_steps) if settings.warmup_steps else 1.0
    fall = min(1.0, (1.0 - progress) / settings.decay_share) if settings.decay_share > 0.0 else 1.0
    return warm * max(0.0, fall)


def build_optimisers(model: Transceiver, settings: TrainSettings) -> list[torch.optim.Optimizer]:
    """Give kernels and a transformer's matrices to Muon (or AdamW), the rest to AdamW.

    First and last layers of the image path are AdamW's: their rows are pixels, not features. Weights that
    need no gradient are left out.
    """
    kernels, linear, rest = [], [], []
    for name, weight in model.named_parameters():
        if not weight.requires_grad:
            continue
        is_heart = ".linear." in name
        is_matrix = weight.ndim == 4 or (weight.ndim == 2 and ".blocks." in name)
        is_edge = "head." in name or name.endswith(_EDGES)
        if is_heart:
            linear.append(weight)
        elif is_matrix and not is_edge and settings.optimiser == "muon":
            kernels.append(weight)
        else:
            rest.append(weight)
    adamw = torch.optim.AdamW(
        [
            {"params": rest, "lr": settings.lr, "weight_decay": 0.0},
            {"params": linear, "lr": settings.lr_linear, "weight_decay": 0.0},
        ],
        betas=(0.9, 0.99),
    )
    optimisers: list[torch.optim.Optimizer] = [adamw]
    if kernels:
        optimisers.append(Muon(kernels, lr=settings.lr_muon, weight_decay=settings.weight_decay))
    for optimiser in optimisers:
        for group in optimiser.param_groups:
            group["full_lr"] = group["lr"]
    return optimisers


def set_rate(optimisers: list[torch.optim.Optimizer], factor: float) -> None:
    """Set every group to a share of its full learning rate."""
    for optimiser in optimisers:
        for group in optimiser.param_groups:
            group["lr"] = group["full_lr"] * factor
