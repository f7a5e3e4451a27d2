"""Dense SIFT-like descriptors in torch, for the paper's descriptor consistency (Eq. 9)."""

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, normalize, unfold

from semcast.training.displacement import gradients

NUM_ORIENTATIONS = 8
#: Side of a cell, and the distance between descriptors.
_CELL_PX = 4


def dense_descriptors(image: Tensor) -> tuple[Tensor, Tensor]:
    """Describe every cell position by 4x4 cells of 8 gradient orientations each.

    Args:
        image: ``(B, 1, H, W)`` grey image in [0, 1].

    Returns:
        Unit descriptors ``(B, 128, N)`` and the gradient energy under each, ``(B, N)``.
    """
    ix, iy = gradients(image)
    magnitude = (ix.square() + iy.square() + 1e-8).sqrt()
    angles = torch.arange(NUM_ORIENTATIONS, device=image.device) * (2.0 * math.pi / NUM_ORIENTATIONS)
    # |g| cos^4((theta - angle) / 2) is a smooth binning that needs no arctangent.
    along = ix * angles.cos().view(1, -1, 1, 1) + iy * angles.sin().view(1, -1, 1, 1)
    bins = (magnitude + along).square() / (4.0 * magnitude)
    cells = avg_pool2d(bins, _CELL_PX)
    energy = cells.sum(dim=1, keepdim=True)
    described = unfold(cells, 4)
    return normalize(described, dim=1, eps=1e-3), unfold(energy, 4).mean(dim=1)


def descriptor_loss(x: Tensor, x_hat: Tensor) -> Tensor:
    """Return the mean squared descriptor distance over two scales, weighted by gradient energy.

    The images are aligned pixel by pixel, so each descriptor's match is the one at the same place.

    Args:
        x: ``(B, 1, H, W)`` grey original.
        x_hat: Its decoded version; the gradient flows here.
    """
    total = x.new_zeros(())
    for scale in (1, 2):
        if scale > 1:
            x = interpolate(x, scale_factor=0.5, mode="area")
            x_hat = interpolate(x_hat, scale_factor=0.5, mode="area")
        reference, energy = dense_descriptors(x)
        described, _ = dense_descriptors(x_hat)
        weight = energy / energy.mean().clamp_min(1e-6)
        total = total + 0.5 * ((described - reference).square().sum(dim=1) * weight).mean()
    return total
