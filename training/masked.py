"""Masked pre-training (He et al. 2022): hide most patches of an image, learn to fill them in; no link yet."""

import torch
from torch import Tensor

from semcast.common.errors import ConfigError
from semcast.common.nets.mae import MaeDecoder
from semcast.common.nets.transceiver import Transceiver
from semcast.common.nets.vit import VitEncoder
from semcast.common.phy.slots import BLOCK_PX


def masked_image_loss(
    model: Transceiver, x: Tensor, mask_share: float, generator: torch.Generator
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the mean squared error over the hidden patches, and it again for the log.

    The encoder sees the visible patches alone; the decoder gets their tokens and one learned token for every
    hidden one.

    Args:
        model: A masked-autoencoder transceiver.
        x: ``(B, 3, H, W)`` images in [0, 1].
        mask_share: Share of patches to hide, in (0, 1).
        generator: Draws them, on the CPU.

    Raises:
        ConfigError: The transceiver is of another architecture.
    """
    encoder, decoder = model.encoder, model.decoder
    if not isinstance(encoder, VitEncoder) or not isinstance(decoder, MaeDecoder):
        raise ConfigError("pretrain_share must be 0 for an architecture other than mae")
    f = encoder.embed(x)
    batch, dim, rows, columns = f.shape
    count = rows * columns
    num_kept = min(count - 1, max(1, round((1.0 - mask_share) * count)))
    order = torch.rand(batch, count, generator=generator).argsort(dim=1).to(x.device)
    kept = order[:, :num_kept, None].expand(-1, -1, dim)
    tokens, where = encoder.trunk.place(f)
    visible = encoder.trunk.refine(tokens.gather(1, kept), where.expand(batch, -1, -1).gather(1, kept))
    full = decoder.mask_token.to(visible.dtype).expand(batch, count, dim).scatter(1, kept, visible)
    grid = full.transpose(1, 2).reshape(batch, dim, rows, columns)
    tokens = decoder.trunk.refine(*decoder.trunk.place(grid))
    pixels = decoder.pixels(tokens.transpose(1, 2).reshape(batch, dim, rows, columns))
    is_hidden = torch.ones(batch, count, device=x.device).scatter(1, order[:, :num_kept], 0.0)
    weight = is_hidden.view(batch, 1, rows, columns)
    weight = weight.repeat_interleave(BLOCK_PX, dim=2).repeat_interleave(BLOCK_PX, dim=3)
    error = (pixels + 0.5 - x).square()
    loss = (error * weight).sum() / (3.0 * weight.sum()).clamp_min(1.0)
    return loss, {"mse": loss.detach(), "masked": loss.detach()}
