"""``semcast eval confidence``: grade the confidence maps of a codec on real images over a real link."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from semcast.common.codec import LABEL_SHARPNESS, Codec
from semcast.common.errors import ConfigError
from semcast.common.image import psnr_db
from semcast.common.sequence import Sequence as RecordedSequence
from semcast.evaluation.confidence_grades import KeypointGrader, PixelGrader, SlotGrader
from semcast.evaluation.interruption import until_interrupted
from semcast.evaluation.pipeline import (
    CLEAN,
    ORIGINALS_BYTES,
    UNUSED_LINK_FIELDS,
    FrameRun,
    Selection,
    StreamSettings,
    open_stream,
    select_frames,
)
from semcast.evaluation.plots import plot_reliability
from semcast.evaluation.report import naming, provenance, short_names, write_result
from semcast.evaluation.statistics import finite_mean
from semcast.evaluation.trace_snr import snr_label, stated_snr_db

VERB = "eval confidence"
#: Flags that have no meaning here.
UNUSED_FIELDS = UNUSED_LINK_FIELDS


@dataclass(frozen=True, kw_only=True)
class ConfidenceSettings(StreamSettings):
    """Settings of ``evaluate_confidence``; ``sequence`` may be a plain folder of images of one size.

    Raises:
        ValueError: A value is out of range, or there is no codec to grade.
    """

    pixel_alpha: float = field(
        default=LABEL_SHARPNESS,
        metadata={"help": "alpha of the label 1 - tanh(alpha |error|) the codec was trained on"},
    )
    out: Path | None = field(
        default=None, metadata={"help": "folder for reliability diagrams and, without --json, result.json"}
    )

    def __post_init__(self) -> None:
        """Check ranges."""
        super().__post_init__()
        if self.codec == CLEAN:
            raise ValueError(f"codec must have a confidence to grade, got {CLEAN!r}")
        if not self.pixel_alpha > 0:
            raise ValueError(f"pixel_alpha must be positive, got {self.pixel_alpha:g}")


def evaluate_confidence(settings: ConfidenceSettings, codec: Codec | None = None) -> dict[str, Any]:
    """Grade pixel, keypoint and slot confidence at each SNR, over all seeds together.

    Args:
        settings: What to grade.
        codec: Used instead of the codec that ``settings.codec`` names.

    Returns:
        Provenance and ``results``, one entry per SNR with ``psnr_db``, ``pixel``, ``keypoint`` and ``slots``:
        see ``confidence_grades``. Written to ``settings.json`` and plotted into ``settings.out`` where given.

    Raises:
        SourceError: The sequence can't be read.
        ConfigError: The codec is unknown or no frame was received.
    """
    settings = naming(settings, codec)
    sequence, codec = open_stream(settings, codec)
    chosen = select_frames(sequence, settings, keep_bytes=ORIGINALS_BYTES)
    results: list[dict[str, Any]] = []
    with until_interrupted(results) as part:
        for snr_db in settings.snr_db:
            results.append(_grade_at(settings, sequence, chosen, codec, snr_db))
    report = write_result(
        settings.json,
        {
            **provenance(VERB, settings),
            "frames_left_out": chosen.left_out,
            "results": results,
        },
        part,
    )
    if settings.out is not None:
        tables = {
            f"SNR {snr_label(snr_db, settings.link)}": result["pixel"]["reliability"]
            for snr_db, result in zip(settings.snr_db, report["results"], strict=True)
        }
        label = f"1 - tanh({settings.pixel_alpha:g} |error|)"
        title = f"{short_names([settings.codec])[0]}, {sequence.name}"
        plot_reliability(settings.out / "reliability.png", tables, label, title)
    return report


def _grade_at(
    settings: ConfidenceSettings,
    sequence: RecordedSequence,
    chosen: Selection,
    codec: Codec | None,
    snr_db: float,
) -> dict[str, Any]:
    pixel, keypoint, slots = PixelGrader(settings.pixel_alpha), KeypointGrader(), SlotGrader()
    quality_db: list[float] = []
    num_lost = 0
    for seed in settings.all_seeds:
        link, images = settings.link_at(snr_db), chosen.images
        run = FrameRun(sequence, chosen.ids, codec, link, seed, images=images, cache_bytes=0)
        for frame in run:
            if frame.decoded is None or frame.row_snr_db is None:
                num_lost += 1
                continue
            quality_db.append(psnr_db(frame.original, frame.decoded.image))
            pixel.add(frame.decoded, frame.original)
            keypoint.add(frame.decoded, frame.original)
            slots.add(frame.decoded, frame.row_snr_db)
    if num_lost == len(chosen.ids) * settings.seeds:
        level = snr_label(snr_db, settings.link)
        raise ConfigError(f"no frame was received at {level}: there is no confidence to grade")
    return {
        "snr_db": stated_snr_db(snr_db, settings.link),
        "num_frames": len(chosen.ids) * settings.seeds,
        "num_frames_lost": num_lost,
        "psnr_db": finite_mean(quality_db),
        "pixel": pixel.result(),
        "keypoint": keypoint.result(),
        "slots": slots.result(),
    }
