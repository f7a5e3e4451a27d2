"""The masked-autoencoder baseline: few large patches, trained to fill in hidden ones, then over the link.

A patch here has 48 x 48 pixels, three by three of the blocks that slots cover. The paper's are more and
smaller: 50 x 50 patches in an image of 800 x 800, 16 x 16 pixels each. That is ``patch_blocks = 1``, and
the shipped weights are not of it. A patch's pixels pass a narrow layer shared by its blocks on their way in
and out: a full linear map of 6912 values to a token would not fit into the size of weights that ship. Images
of any size are padded to whole patches; symbols of the padding are never sent.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from semcast.common.nets.blocks import condition_vector, normalise_snr_db
from semcast.common.nets.confidence import ConfidenceBranch
from semcast.common.nets.decoder import RECEIVED_CHANNELS, DecoderFeatures
from semcast.common.nets.transceiver import Transceiver
from semcast.common.nets.vit import Trunk
from semcast.common.phy.slots import BLOCK_PX, BLOCK_VALUES, LATENT_CHANNELS


@dataclass(frozen=True)
class MaeSizes:
    """Sizes of the masked-autoencoder transceiver.

    Attributes:
        patch_blocks: Side of a patch in blocks of 16 pixels.
        dim: Width of a token, a multiple of 4 and of ``heads``.
        heads: Attention heads.
        encoder_depth: Transformer blocks at the transmitter.
        decoder_depth: Transformer blocks at the receiver.
        window: Patches a side over which attention reaches, no more than a crop of training has.
        block_channels: Values a block of pixels is brought down to before it joins its patch, and back.
        confidence_channels: Width of the confidence branch.
    """

    patch_blocks: int = 3
    dim: int = 352
    heads: int = 8
    encoder_depth: int = 2
    decoder_depth: int = 2
    window: int = 3
    block_channels: int = 96
    confidence_channels: int = 32


def pad_to_patches(grid: Tensor, patch_blocks: int, mode: str = "constant") -> Tensor:
    """Pad ``(B, C, h, w)`` blocks at the bottom and the right to whole patches."""
    rows, columns = grid.shape[2:]
    below, right = -rows % patch_blocks, -columns % patch_blocks
    return pad(grid, (0, right, 0, below), mode=mode) if below or right else grid


class MaeEncoder(nn.Module):
    """Pixels to blocks to patches to tokens, and tokens to the latent of their blocks."""

    def __init__(self, sizes: MaeSizes) -> None:
        super().__init__()
        self.patch_blocks = sizes.patch_blocks
        side = sizes.patch_blocks
        self.fold = nn.PixelUnshuffle(BLOCK_PX)
        self.stem = nn.Conv2d(BLOCK_VALUES, sizes.block_channels, 1)
        self.gather = nn.Conv2d(sizes.block_channels, sizes.dim, side, stride=side)
        self.trunk = Trunk(sizes.dim, sizes.heads, sizes.encoder_depth, sizes.window)
        self.head = nn.ConvTranspose2d(sizes.dim, LATENT_CHANNELS, side, stride=side)

    def embed(self, x: Tensor) -> Tensor:
        """Map ``(B, 3, H, W)`` in [0, 1] to tokens ``(B, dim, h', w')`` before the trunk."""
        blocks = pad_to_patches(self.stem(self.fold(x - 0.5)), self.patch_blocks, "replicate")
        tokens: Tensor = self.gather(blocks)
        return tokens

    def forward(self, x: Tensor, snr_db: Tensor) -> Tensor:
        """Map ``(B, 3, H, W)`` in [0, 1] to the latent ``(B, 94, H/16, W/16)`` before modulation."""
        f = self.trunk(self.embed(x), condition_vector(snr_db))
        latent: Tensor = self.head(f).float()
        return latent[:, :, : x.shape[2] // BLOCK_PX, : x.shape[3] // BLOCK_PX]


class MaeDecoder(nn.Module):
    """Latent to tokens to pixels."""

    def __init__(self, sizes: MaeSizes) -> None:
        super().__init__()
        self.patch_blocks = sizes.patch_blocks
        side = sizes.patch_blocks
        self.stem = nn.Conv2d(RECEIVED_CHANNELS, sizes.dim, side, stride=side)
        self.trunk = Trunk(sizes.dim, sizes.heads, sizes.decoder_depth, sizes.window)
        self.spread = nn.ConvTranspose2d(sizes.dim, sizes.block_channels, side, stride=side)
        self.head = nn.Conv2d(sizes.block_channels, BLOCK_VALUES, 1)
        self.unfold = nn.PixelShuffle(BLOCK_PX)
        self.fold8, self.fold4 = nn.PixelUnshuffle(8), nn.PixelUnshuffle(4)
        #: Stands for a hidden patch in pre-training.
        self.mask_token = nn.Parameter(torch.zeros(sizes.dim))

    def pixels(self, f: Tensor) -> tuple[Tensor, Tensor]:
        """Map tokens ``(B, dim, h', w')`` behind the trunk to pixels around 0, and to features of blocks."""
        blocks = self.spread(f)
        return self.unfold(self.head(blocks)).float(), blocks

    def forward(
        self, y: Tensor, snr_db: Tensor, shrink: Tensor, scale: Tensor
    ) -> tuple[Tensor, DecoderFeatures]:
        """Map the received latent to ``(B, 3, 16 h, 16 w)``; finer features are the pixels themselves."""
        rows, columns = y.shape[2:]
        received = torch.cat((y, normalise_snr_db(snr_db), shrink), dim=1)
        tokens = self.stem(pad_to_patches(received, self.patch_blocks))
        pixels, blocks = self.pixels(self.trunk(tokens, condition_vector(snr_db.mean(dim=(1, 2, 3)))))
        pixels = pixels[:, :, : rows * BLOCK_PX, : columns * BLOCK_PX]
        features = DecoderFeatures(
            received, blocks[:, :, :rows, :columns], self.fold8(pixels), self.fold4(pixels)
        )
        return pixels + 0.5, features


def build_mae(sizes: MaeSizes) -> Transceiver:
    """Build an untrained masked-autoencoder transceiver."""
    branch = ConfidenceBranch((48, 192, sizes.block_channels), sizes.confidence_channels)
    return Transceiver(MaeEncoder(sizes), MaeDecoder(sizes), branch)
