"""The loss terms: reconstruction, descriptor consistency, confidence."""

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from semcast.common.codec import LABEL_SHARPNESS
from semcast.common.nets.decoder import DecoderFeatures
from semcast.common.nets.modulation import shrink_of
from semcast.common.nets.transceiver import Transceiver
from semcast.training.allocations import AllocationDraw
from semcast.training.channel import LinkDraw, through_link
from semcast.training.descriptors import descriptor_loss
from semcast.training.displacement import grey, lucas_kanade_step


@dataclass(frozen=True, kw_only=True)
class LossSettings:
    """Weights and shapes of the loss terms; a weight of 0 switches a term off.

    Attributes:
        mse: Weight of the reconstruction error (lambda 1 of the paper).
        descriptor: Weight of the descriptor consistency (lambda 2).
        confidence: Weight of both confidence heads (lambda 3); their gradient never reaches the image path.
        mse_knee: An image's squared error counts as ``knee * log(1 + mse / knee)``: PSNR is a mean of
            logarithms, and without the knee a few hard crops would own the gradient. 0 is the plain mean.
        confidence_sharpness: alpha of the label ``1 - tanh(alpha * |x_hat - x|)``.
        confidence_loss: ``bce``, or ``l1`` as in the paper.
    """

    mse: float = field(default=1.0, metadata={"help": "weight of the reconstruction error"})
    descriptor: float = field(
        default=0.0, metadata={"help": "weight of the descriptor consistency; 0 is off"}
    )
    confidence: float = field(default=0.01, metadata={"help": "weight of both confidence heads; 0 is off"})
    mse_knee: float = field(
        default=1e-3, metadata={"help": "squared error of an image from which its weight falls; 0: none"}
    )
    confidence_sharpness: float = field(
        default=LABEL_SHARPNESS, metadata={"help": "alpha of the label 1 - tanh(alpha |error|)"}
    )
    confidence_loss: Literal["bce", "l1"] = field(
        default="bce", metadata={"help": "bce, or l1 as in the paper"}
    )

    def __post_init__(self) -> None:
        for name in ("mse", "descriptor", "confidence", "mse_knee"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be >= 0, got {getattr(self, name)}")
        if not (self.mse or self.descriptor or self.confidence):
            raise ValueError("one of mse, descriptor and confidence must be > 0, got 0 for each")
        if not 0.0 < self.confidence_sharpness < math.inf:
            raise ValueError(f"confidence_sharpness must be > 0, got {self.confidence_sharpness}")


def reconstruction_loss(x_hat: Tensor, x: Tensor, knee: float) -> tuple[Tensor, Tensor]:
    """Return the loss and the plain squared error of each image, ``(B,)``."""
    mse = (x_hat - x).square().mean(dim=(1, 2, 3))
    loss = (knee * torch.log1p(mse / knee)).mean() if knee > 0.0 else mse.mean()
    return loss, mse.detach()


def confidence_label(x_hat: Tensor, x: Tensor, sharpness: float) -> Tensor:
    """Return the paper's pseudo-label (Eq. 11), ``(B, 1, H, W)``, from the mean error over colour."""
    error = (x_hat.detach().clamp(0.0, 1.0) - x).abs().mean(dim=1, keepdim=True)
    return 1.0 - torch.tanh(sharpness * error)


def confidence_loss(logit: Tensor, label: Tensor, kind: Literal["bce", "l1"]) -> Tensor:
    """Compare predicted confidence with its label."""
    if kind == "l1":
        return (torch.sigmoid(logit) - label).abs().mean()
    return binary_cross_entropy_with_logits(logit, label)


def displacement_loss(predicted_px: Tensor, label_px: Tensor, strength: Tensor) -> Tensor:
    """Return the Laplace negative log-likelihood of displacements, weighted to strong corners.

    The expected length ``d`` is the scale of the law: ``log d + label / d`` is least where ``d`` is the mean
    label.
    """
    scale = predicted_px + 0.02
    weight = (strength / strength.mean(dim=(1, 2, 3), keepdim=True).clamp_min(1e-9)).clamp(max=8.0) + 0.05
    return (weight * (torch.log(scale) + label_px / scale)).sum() / weight.sum()


def through_whole_link(
    model: Transceiver, x: Tensor, draw: LinkDraw, noise: Tensor, sent: AllocationDraw | None
) -> tuple[Tensor, Tensor, DecoderFeatures]:
    """Encode a batch, send it and decode it.

    Args:
        model: The transceiver.
        x: ``(B, 3, H, W)`` images in [0, 1].
        draw: The links of the batch.
        noise: Standard normal values of the latent's shape.
        sent: What each block sends, where the rate is variable. Values are then analog, over links over which
            they arrive as well as rounded ones would.

    Returns:
        Symbols, the decoded images and the decoder's features.
    """
    if sent is None:
        latent = model.latent(x, draw.expected_snr_db, draw.is_qam)
        symbols = model.transmit(latent, draw.is_qam)
        y_rx, snr_db = through_link(symbols, draw, noise)
        return symbols, *model.receive(y_rx, snr_db, draw.is_qam)
    draw = draw.as_analog().per_value(sent.in_next_slot())
    latent = model.latent(x, draw.expected_snr_db, draw.is_qam, sent.values)
    symbols = model.send_blocks(latent, sent.values)
    y_rx, snr_db = through_link(symbols, draw, noise)
    return symbols, *model.receive_blocks(y_rx, shrink_of(snr_db), sent.values)


def transceiver_loss(
    model: Transceiver,
    x: Tensor,
    draw: LinkDraw,
    noise: Tensor,
    settings: LossSettings,
    with_heads: bool,
    sent: AllocationDraw | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Run one batch through the whole link and sum the loss terms.

    Args:
        model: The transceiver.
        x: ``(B, 3, H, W)`` images in [0, 1].
        draw: The links of the batch.
        noise: Standard normal values of the latent's shape.
        settings: Weights of the terms.
        with_heads: Compute the confidence heads in this step.
        sent: See ``through_whole_link``.

    Returns:
        The loss and detached scalars for the log.
    """
    symbols, x_hat, features = through_whole_link(model, x, draw, noise, sent)
    x_hat = x_hat.float()
    reconstruction, mse = reconstruction_loss(x_hat, x, settings.mse_knee)
    loss = settings.mse * reconstruction
    num_values = symbols[0].numel() if sent is None else sent.values.sum(dim=(1, 2, 3))
    power = 2.0 * symbols.square().sum(dim=(1, 2, 3)) / num_values
    logs = {
        "mse": mse.mean(),
        "power": (power * draw.is_qam).sum().detach() / draw.is_qam.sum().clamp_min(1.0),
    }
    if settings.descriptor > 0.0:
        descriptor = descriptor_loss(grey(x), grey(x_hat))
        loss = loss + settings.descriptor * descriptor
        logs["descriptor"] = descriptor.detach()
    if with_heads and settings.confidence > 0.0:
        frozen = type(features)(
            features.received.detach(), features.at16.detach(), features.at8.detach(), features.at4.detach()
        )
        logit, displacement = model.judge(frozen, x_hat.detach())
        label = confidence_label(x_hat, x, settings.confidence_sharpness)
        pixel = confidence_loss(logit, label, settings.confidence_loss)
        with torch.no_grad():
            moved, strength = lucas_kanade_step(grey(x_hat.detach().clamp(0.0, 1.0)), grey(x))
        keypoint = displacement_loss(displacement, moved, strength)
        loss = loss + settings.confidence * (pixel + 0.5 * keypoint)
        logs["pixel"], logs["keypoint"] = pixel.detach(), keypoint.detach()
    return loss, logs
