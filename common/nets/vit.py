"""The transformer baseline: 16x16 patches, transformer encoder and decoder, linear maps at both ends."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention

from semcast.common.nets.blocks import NUM_CONDITIONS, condition_vector, normalise_snr_db
from semcast.common.nets.confidence import ConfidenceBranch
from semcast.common.nets.decoder import RECEIVED_CHANNELS, DecoderFeatures
from semcast.common.nets.transceiver import Transceiver
from semcast.common.phy.slots import BLOCK_PX, BLOCK_VALUES, LATENT_CHANNELS


@dataclass(frozen=True)
class VitSizes:
    """Sizes of the transformer transceiver.

    Attributes:
        dim: Width of a token, a multiple of 4 and of ``heads``.
        heads: Attention heads.
        encoder_depth: Transformer blocks at the transmitter.
        decoder_depth: Transformer blocks at the receiver.
        window: Tokens a side over which attention reaches, no more than a crop of training has.
        confidence_channels: Width of the confidence branch.
    """

    dim: int = 256
    heads: int = 8
    encoder_depth: int = 4
    decoder_depth: int = 4
    window: int = 10
    confidence_channels: int = 32


def positions(rows: int, columns: int, dim: int, like: Tensor) -> Tensor:
    """Return sine and cosine positions ``(1, rows * columns, dim)`` that work at any image size."""
    quarter = dim // 4
    frequency = torch.exp(-math.log(1000.0) * torch.arange(quarter, device=like.device) / quarter)
    row = torch.arange(rows, device=like.device)[:, None] * frequency
    column = torch.arange(columns, device=like.device)[:, None] * frequency
    row = torch.cat((row.sin(), row.cos()), dim=1)[:, None].expand(rows, columns, -1)
    column = torch.cat((column.sin(), column.cos()), dim=1)[None].expand(rows, columns, -1)
    return torch.cat((row, column), dim=2).reshape(1, rows * columns, dim).to(like.dtype)


class TransformerBlock(nn.Module):
    """Pre-norm attention and a two-layer network; the second layers start at zero.

    Attention is told positions anew in every block (as in DETR, Carion et al. 2020), so that tokens carry
    nothing but the image: a linear transform passes untrained blocks as it is.
    """

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm1, self.norm2 = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.qkv = nn.Linear(dim, 3 * dim)
        self.out = nn.Linear(dim, dim)
        self.grow = nn.Linear(dim, 4 * dim)
        self.shrink = nn.Linear(4 * dim, dim)
        for last in (self.out, self.shrink):
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def forward(self, x: Tensor, where: Tensor) -> Tensor:
        """Refine tokens ``(B, N, dim)`` at positions ``(1 or B, N, dim)``."""
        batch, count, dim = x.shape
        parts = self.qkv(self.norm1(x) + where).view(batch, count, 3, self.heads, dim // self.heads)
        q, k, v = parts.permute(2, 0, 3, 1, 4)
        mixed = scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(batch, count, dim)
        x = x + self.out(mixed)
        refined: Tensor = x + self.shrink(nn.functional.gelu(self.grow(self.norm2(x))))
        return refined


def window_starts(length: int, largest: int) -> tuple[int, list[int]]:
    """Cover a side by as few equal windows as it takes; the last may overlap the one before.

    Args:
        length: Of the side.
        largest: Size a window may have.

    Returns:
        The size of the windows and where each starts.
    """
    count = -(-length // largest)
    size = -(-length // count)
    return size, [min(k * size, length - size) for k in range(count)]


class Trunk(nn.Module):
    """Positions, link state and a stack of blocks over a grid of tokens, window by window.

    A frame has many more tokens than a crop of training. Attention over all of them is not what was trained:
    it cost the vit a decibel on photos twice as large as a crop. Over windows of the size of a crop it is.
    """

    def __init__(self, dim: int, heads: int, depth: int, window: int) -> None:
        super().__init__()
        self.window = window
        self.condition = nn.Linear(NUM_CONDITIONS, dim)
        nn.init.zeros_(self.condition.weight)
        nn.init.zeros_(self.condition.bias)
        self.blocks = nn.ModuleList(TransformerBlock(dim, heads) for _ in range(depth))

    def forward(self, f: Tensor, condition: Tensor) -> Tensor:
        """Refine ``(B, dim, h, w)`` under a ``(B, 1)`` link state."""
        height, tops = window_starts(f.shape[2], self.window)
        width, lefts = window_starts(f.shape[3], self.window)
        places = [(slice(top, top + height), slice(left, left + width)) for top in tops for left in lefts]
        if len(places) == 1:
            return self._attend(f, condition)
        windows = torch.cat([f[:, :, rows, columns] for rows, columns in places])
        refined = self._attend(windows, condition.repeat(len(places), 1))
        grid = torch.empty_like(f)
        for (rows, columns), window in zip(places, refined.chunk(len(places)), strict=True):
            grid[:, :, rows, columns] = window
        return grid

    def _attend(self, f: Tensor, condition: Tensor) -> Tensor:
        batch, dim, rows, columns = f.shape
        tokens, where = self.place(f)
        tokens = self.refine(tokens + self.condition(condition)[:, None].to(f.dtype), where)
        grid: Tensor = tokens.transpose(1, 2).reshape(batch, dim, rows, columns)
        return grid

    def place(self, f: Tensor) -> tuple[Tensor, Tensor]:
        """Turn ``(B, dim, h, w)`` into tokens ``(B, h * w, dim)`` and positions ``(1, h * w, dim)``."""
        _, dim, rows, columns = f.shape
        tokens = f.flatten(2).transpose(1, 2)
        return tokens, positions(rows, columns, dim, tokens)

    def refine(self, tokens: Tensor, where: Tensor) -> Tensor:
        """Pass tokens ``(B, N, dim)`` at positions ``(1 or B, N, dim)`` through all blocks."""
        for block in self.blocks:
            tokens = block(tokens, where)
        return tokens


class VitEncoder(nn.Module):
    """Patches to tokens to latent."""

    def __init__(self, sizes: VitSizes) -> None:
        super().__init__()
        self.fold = nn.PixelUnshuffle(BLOCK_PX)
        self.stem = nn.Conv2d(BLOCK_VALUES, sizes.dim, 1)
        self.trunk = Trunk(sizes.dim, sizes.heads, sizes.encoder_depth, sizes.window)
        self.head = nn.Conv2d(sizes.dim, LATENT_CHANNELS, 1)

    def embed(self, x: Tensor) -> Tensor:
        """Map ``(B, 3, H, W)`` in [0, 1] to tokens ``(B, dim, H/16, W/16)`` before the trunk."""
        tokens: Tensor = self.stem(self.fold(x - 0.5))
        return tokens

    def forward(self, x: Tensor, snr_db: Tensor) -> Tensor:
        """Map ``(B, 3, H, W)`` in [0, 1] to the latent ``(B, 94, H/16, W/16)`` before modulation."""
        f = self.trunk(self.embed(x), condition_vector(snr_db))
        latent: Tensor = self.head(f).float()
        return latent


class VitDecoder(nn.Module):
    """Latent to tokens to patches."""

    def __init__(self, sizes: VitSizes) -> None:
        super().__init__()
        self.stem = nn.Conv2d(RECEIVED_CHANNELS, sizes.dim, 1)
        self.trunk = Trunk(sizes.dim, sizes.heads, sizes.decoder_depth, sizes.window)
        self.head = nn.Conv2d(sizes.dim, BLOCK_VALUES, 1)
        self.unfold = nn.PixelShuffle(BLOCK_PX)
        self.fold8, self.fold4 = nn.PixelUnshuffle(8), nn.PixelUnshuffle(4)

    def pixels(self, tokens: Tensor) -> Tensor:
        """Map tokens ``(B, dim, h, w)`` behind the trunk to an image ``(B, 3, 16 h, 16 w)`` around 0."""
        image: Tensor = self.unfold(self.head(tokens)).float()
        return image

    def forward(
        self, y: Tensor, snr_db: Tensor, shrink: Tensor, scale: Tensor
    ) -> tuple[Tensor, DecoderFeatures]:
        """Map the received latent to ``(B, 3, 16 h, 16 w)``; finer features are the patches themselves."""
        received = torch.cat((y, normalise_snr_db(snr_db), shrink), dim=1)
        f = self.trunk(self.stem(received), condition_vector(snr_db.mean(dim=(1, 2, 3))))
        pixels = self.pixels(f)
        return pixels + 0.5, DecoderFeatures(received, f, self.fold8(pixels), self.fold4(pixels))


def build_vit(sizes: VitSizes) -> Transceiver:
    """Build an untrained transformer transceiver."""
    branch = ConfidenceBranch((48, 192, sizes.dim), sizes.confidence_channels)
    return Transceiver(VitEncoder(sizes), VitDecoder(sizes), branch)
