"""Quality on whole images that were not trained on."""

import numpy as np
import torch
from numpy.typing import NDArray

from semcast.common.image import psnr_of_mse
from semcast.common.nets.detail import allocation_for
from semcast.common.nets.transceiver import Transceiver
from semcast.common.phy.slots import BLOCK_PX
from semcast.training.channel import LinkDraw, through_link

SNRS_DB = (2.0, 6.0, 10.0)


def validate(
    model: Transceiver,
    images: list[NDArray[np.uint8]],
    device: torch.device,
    bf16: bool,
) -> dict[str, float]:
    """Return the mean PSNR of images over AWGN with 16-QAM at each of ``SNRS_DB``, and the mean power.

    Args:
        model: The transceiver.
        images: ``(H, W, 3)`` uint8, cut to whole blocks.
        device: Where the model is.
        bf16: Use bfloat16 autocast.
    """
    generator = torch.Generator().manual_seed(1234)
    psnr_db: dict[str, list[float]] = {f"psnr_{s:g}db": [] for s in SNRS_DB}
    powers = []
    with torch.inference_mode(), torch.autocast(device.type, torch.bfloat16, enabled=bf16):
        for image in images:
            height, width = (side // BLOCK_PX * BLOCK_PX for side in image.shape[:2])
            pixels = image[:height, :width].copy()
            x = torch.from_numpy(pixels).permute(2, 0, 1)[None].to(device) / 255.0
            values = None
            if model.is_variable:
                values = torch.from_numpy(allocation_for(pixels).values)[None, None].to(device)
            for snr_db in SNRS_DB:
                slots = (1, 1, height // BLOCK_PX, 1)
                level = torch.full((1,), snr_db)
                flag = torch.full((1,), 1.0)
                draw = LinkDraw(level, level, flag, torch.ones(slots), torch.zeros(slots)).to(device)
                latent = model.latent(x, draw.expected_snr_db, draw.is_qam, values)
                symbols = model.transmit(latent, draw.is_qam, values)
                noise = torch.randn(symbols.shape, generator=generator).to(device)
                y_rx, plane = through_link(symbols, draw, noise)
                x_hat, _ = model.receive(y_rx, plane, draw.is_qam, values)
                rounded = (x_hat.float().clamp(0, 1) * 255).round() / 255
                mse = float((rounded - x).square().mean())
                psnr_db[f"psnr_{snr_db:g}db"].append(psnr_of_mse(mse))
                powers.append(2.0 * float(symbols.square().mean()))
    return {k: float(np.mean(v)) for k, v in psnr_db.items()} | {"power": float(np.mean(powers))}
