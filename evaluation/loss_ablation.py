"""What each of the paper's three loss terms does: the same short training with terms switched off.

Run by ``make bench-loss DATA=<folder>``; about twenty minutes of one core. Every variant starts from the same
linear transceiver and sees the same crops, links and noise.
"""

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semcast.common.image import psnr_of_mse
from semcast.common.nets.checkpoint import load_transceiver
from semcast.common.nets.transceiver import Transceiver
from semcast.common.phy.slots import BLOCK_PX, LATENT_CHANNELS
from semcast.common.source_commit import source_commit
from semcast.evaluation.calibration import reliability
from semcast.evaluation.report import RESULTS, check_outputs, machine_kind, write_result
from semcast.evaluation.statistics import spearman
from semcast.training.channel import LinkDrawSettings, draw_links, through_link
from semcast.training.data import read_images
from semcast.training.descriptors import descriptor_loss
from semcast.training.displacement import grey, lucas_kanade_step
from semcast.training.loop import train
from semcast.training.losses import LossSettings, confidence_label
from semcast.training.settings import TrainSettings

#: Weight at which the descriptor term's gradient is about half of that of the reconstruction.
_DESCRIPTOR = 0.005
VARIANTS = {
    "reconstruction": LossSettings(descriptor=0.0, confidence=0.0),
    "+ confidence": LossSettings(descriptor=0.0),
    "+ descriptors": LossSettings(descriptor=_DESCRIPTOR, confidence=0.0),
    "all three": LossSettings(descriptor=_DESCRIPTOR),
}
_SNR_DB = 6.0
_VALID_IMAGES = 16
#: Every seventh pixel of a confidence map is graded, and the strongest twentieth of all pixels are corners.
_PIXEL_STEP, _CORNER_SHARE = 7, 0.05


@torch.no_grad()
def grade(model: Transceiver, images: list[NDArray[np.uint8]], sharpness: float) -> dict[str, float]:
    """Send images over links of 6 dB whose slots fade and sometimes are lost, and grade what arrives.

    Args:
        model: In evaluation mode.
        images: ``(H, W, 3)`` uint8, cut to whole blocks.
        sharpness: Of the pixel confidence's label.

    Returns:
        Means over the images: ``psnr_db``; ``descriptor``, the distance of dense descriptors; ``corner_px``,
        the displacement of corners; ``ece`` of the pixel confidence, and ``spearman_corners`` between
        expected and true displacement.
    """
    generator = torch.Generator().manual_seed(7)
    channel = LinkDrawSettings(snr_min_db=_SNR_DB, snr_max_db=_SNR_DB, share_16qam=1.0, share_faded=1.0)
    rows: dict[str, list[float]] = {}
    for image in images:
        height, width = (side // BLOCK_PX * BLOCK_PX for side in image.shape[:2])
        x = torch.from_numpy(image[:height, :width].copy()).permute(2, 0, 1)[None] / 255.0
        slots, columns = height // BLOCK_PX, width // BLOCK_PX
        draw = draw_links(channel, 1, slots, generator)
        symbols = model.transmit(model.latent(x, draw.expected_snr_db, draw.is_qam), draw.is_qam)
        noise = torch.randn((1, LATENT_CHANNELS, slots, columns), generator=generator)
        y_rx, snr_db = through_link(symbols, draw, noise)
        x_hat, features = model.receive(y_rx, snr_db, draw.is_qam)
        logit, expected_px = model.judge(features, x_hat)
        x_hat = x_hat.clamp(0.0, 1.0)
        moved_px, strength = lucas_kanade_step(grey(x_hat), grey(x))
        corners = strength >= torch.quantile(strength.flatten()[::3], 1.0 - _CORNER_SHARE)
        label = confidence_label(x_hat, x, sharpness)
        step = (slice(None), slice(None), slice(1, None, _PIXEL_STEP), slice(1, None, _PIXEL_STEP))
        values = {
            "psnr_db": psnr_of_mse(float((x_hat - x).square().mean())),
            "descriptor": float(descriptor_loss(grey(x), grey(x_hat))),
            "corner_px": float(moved_px[corners].mean()),
            "ece": reliability(_flat(torch.sigmoid(logit[step])), _flat(label[step])).ece,
            "spearman_corners": spearman(_flat(expected_px[corners]), _flat(moved_px[corners])),
        }
        for name, value in values.items():
            rows.setdefault(name, []).append(float("nan") if value is None else float(value))
    return {name: float(np.nanmean(found)) for name, found in rows.items()}


def _flat(values: Tensor) -> NDArray[np.float32]:
    return values.float().flatten().numpy()


def run(settings: TrainSettings, images: list[NDArray[np.uint8]]) -> list[dict[str, Any]]:
    """Train and grade every variant.

    Args:
        settings: Of each training but its loss and its folder.
        images: To grade on.
    """
    results = []
    for name, loss in VARIANTS.items():
        with tempfile.TemporaryDirectory(prefix="semcast-") as folder:
            done = train(replace(settings, loss=loss, out=Path(folder)))
            model, _ = load_transceiver(done.weights)
        figures = grade(model.eval(), images, loss.confidence_sharpness)
        if loss.confidence == 0.0:
            # Heads that were never trained have nothing to be graded.
            figures["ece"] = figures["spearman_corners"] = float("nan")
        results.append({"loss": name, **figures})
        sys.stderr.write(f"{name}: {figures}\n")
    return results


def main() -> None:
    """Train the variants on ``DATA/train``, grade them on ``DATA/valid`` and write the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path, help="folder with train/ and valid/")
    parser.add_argument("--steps", type=int, default=1000, help="steps of each training")
    parser.add_argument(
        "--json", type=Path, default=RESULTS / "ablation_loss.json", help="file for the result"
    )
    arguments = parser.parse_args()
    check_outputs(arguments.json, None)
    settings = TrainSettings(
        data=arguments.data / "train", steps=arguments.steps, batch=8, warmup_steps=60, decay_share=0.7,
        weight_decay=0.3, threads=1, head_every=2,
    )  # fmt: skip
    images = read_images(arguments.data / "valid")[:_VALID_IMAGES]
    results = run(settings, images)
    report = {
        "command": f"make bench-loss DATA={arguments.data.name} ARGS='--steps {arguments.steps}'",
        "commit": source_commit(),
        "seed": settings.seed,
        "machine": machine_kind(),
        "steps": arguments.steps,
        "batch": settings.batch,
        "descriptor_weight": _DESCRIPTOR,
        "what": f"{len(images)} validation photos, 16-QAM, fading and sometimes lost slots, {_SNR_DB:g} dB",
        "results": results,
    }
    write_result(arguments.json, report)


if __name__ == "__main__":
    main()
