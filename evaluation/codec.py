"""``semcast eval codec``: image quality of codecs over a link, all on the same images and the same channel.

Codecs take turns on every image, so slow drifts of the machine hit all alike, and image k sees the same noise
under every codec.
"""

import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from semcast.channel.link import Link
from semcast.channel.settings import ChannelSettings
from semcast.common.codec import (
    DEFAULT_CODEC,
    LABEL_SHARPNESS,
    MODULATION_HELP,
    OUTAGE_GREY,
    PRECISION_HELP,
    Codec,
    DecodedImage,
    EncodedImage,
    Modulation,
    Precision,
    ReceivedImage,
)
from semcast.common.codecs import LEARNED_CODECS, is_conventional, load_codec
from semcast.common.config import check_at_least
from semcast.common.cores import check_threads
from semcast.common.errors import ConfigError, SourceError
from semcast.common.image import psnr_db
from semcast.common.image_file import read_image
from semcast.common.layouts.files import IMAGE_SUFFIXES, images_in
from semcast.common.link_report import LinkReporter
from semcast.common.phy.slots import layout_for
from semcast.common.rate import NATIVE_RATE, Rate, from_coded, to_coded
from semcast.evaluation.calibration import reliability
from semcast.evaluation.image_quality import ms_ssim, ssim
from semcast.evaluation.interruption import until_interrupted
from semcast.evaluation.picture_strip import write_picture_strip
from semcast.evaluation.pipeline import UNUSED_LINK_FIELDS, check_seeds
from semcast.evaluation.plots import plot_against_snr
from semcast.evaluation.report import naming, provenance, short_names, write_result
from semcast.evaluation.sounding import told_at_first
from semcast.evaluation.statistics import finite_mean, percentiles, spearman
from semcast.evaluation.trace_snr import check_snrs, snr_file_label, stated_snr_db
from semcast.evaluation.uncertainty_maps import GRADED, block_means, pixel_label

logger = logging.getLogger(__name__)

VERB = "eval codec"
UNUSED_FIELDS = UNUSED_LINK_FIELDS
_SNRS_DB = (2.0, 4.0, 6.0, 8.0, 10.0, 12.0)
_STRIP_SNR_DB = 10.0
_STRIP_IMAGES = 2
_FRAME_INTERVAL_S = 0.1


@dataclass(frozen=True, kw_only=True)
class CodecSettings:
    """Settings of ``evaluate_codec``.

    Raises:
        ValueError: A value is out of range.
    """

    images: Path = field(metadata={"help": "folder of images, used in the order of their names"})
    codec: tuple[str, ...] = field(
        default=(DEFAULT_CODEC, "jpeg-ldpc"),
        metadata={"help": "codecs by name or .safetensors file, one or more"},
    )
    snr_db: tuple[float, ...] = field(
        default=_SNRS_DB,
        metadata={
            "help": "SNRs in dB, one or more; without a meaning where a file has the SNR (--trace file)"
        },
    )
    modulation: Modulation = field(default="16qam", metadata={"help": MODULATION_HELP})
    runtime: Literal["torch", "onnx"] = field(
        default="torch", metadata={"help": "what computes learned encoders: torch, or onnx as exported"}
    )
    rate: Rate = field(default=NATIVE_RATE, metadata={"help": "channel uses per pixel value"})
    link: ChannelSettings = field(default=ChannelSettings(), metadata={"help": "the channel"})
    perfect_csi: bool = field(
        default=False, metadata={"help": "tell the receiver the true channel instead of estimating it"}
    )
    seed: int = field(default=0, metadata={"help": "seed of the channel"})
    max_images: int | None = field(default=None, metadata={"help": "images used at most"})
    threads: int = field(default=2, metadata={"help": "threads of a learned codec"})
    precision: Precision = field(default="auto", metadata={"help": PRECISION_HELP})
    json: Path | None = field(default=None, metadata={"help": "file for the result, - for stdout"})
    out: Path | None = field(
        default=None,
        metadata={"help": "folder for PSNR and SSIM curves, pictures and, without --json, result.json"},
    )

    def __post_init__(self) -> None:
        """Check ranges."""
        check_snrs(self.snr_db, self.link, _SNRS_DB)
        if not self.codec or len(set(self.codec)) != len(self.codec):
            raise ValueError(f"codec must be one or more different names, got {self.codec}")
        check_at_least(self, max_images=1)
        check_seeds(self.seed)
        check_threads(self.threads)

    @property
    def links(self) -> dict[float, ChannelSettings]:
        """Channel settings by the SNR that is set; a trace from a file is one link."""
        snrs_db = self.snr_db[:1] if self.link.has_own_snr else self.snr_db
        return {snr_db: replace(self.link, snr_db=snr_db) for snr_db in snrs_db}


@dataclass(frozen=True)
class _Sample:
    """One image through one codec at one SNR."""

    figures: dict[str, float | None]
    confidence: dict[str, float | None]
    times_ms: dict[str, float]
    decoded: DecodedImage
    report_db: float


class _Stream:
    """A codec and its link.

    All images share the link, so that traces and fading go on from image to image; every codec sees the same
    noise, which belongs to the image's number.
    """

    def __init__(
        self,
        codec: Codec,
        images: Mapping[str, NDArray[np.uint8]],
        link: ChannelSettings,
        settings: CodecSettings,
    ) -> None:
        self._codec, self._settings = codec, settings
        self._link = Link(link, settings.seed)
        self._reporter = LinkReporter(codec.name)
        first = to_coded(next(iter(images.values())), settings.rate)
        self._told_db = told_at_first(
            codec, first, self._link, self._reporter, 0.0, perfect_csi=settings.perfect_csi
        )

    def send(self, image: NDArray[np.uint8], k: int) -> _Sample:
        """Send the image of number ``k`` with what the receiver reported on the one before."""
        sample = _run(self._codec, image, self._link, self._reporter, k, self._told_db, self._settings)
        self._told_db = sample.report_db
        return sample


def read_images(
    folder: Path, max_images: int | None = None
) -> tuple[dict[str, NDArray[np.uint8]], list[str]]:
    """Read the images of a folder.

    Returns:
        File name to ``(H, W, 3)`` uint8 RGB, in the order of the names; and the names of those that can't be
        read, each told with why.

    Raises:
        SourceError: The folder can't be read or holds no image, or none of them can be read.
    """
    paths = images_in(folder)
    if not paths:
        inside = next((p for p in sorted(folder.iterdir()) if p.is_dir() and images_in(p)), None)
        hint = f"; {inside} does" if inside else ""
        raise SourceError(f"{folder} holds no images ({', '.join(IMAGE_SUFFIXES)}){hint}")
    images: dict[str, NDArray[np.uint8]] = {}
    left_out: list[str] = []
    for path in (paths := paths[:max_images]):
        try:
            images[path.name] = read_image(path)
        except SourceError as err:
            if len(left_out) == len(paths) - 1:
                raise
            logger.warning("left out: %s", err)
            left_out.append(path.name)
    return images, left_out


def evaluate_codec(settings: CodecSettings, codecs: Sequence[Codec] | None = None) -> dict[str, Any]:
    """Send every image through every codec at every SNR and measure what arrives.

    A lost frame or an outage counts with the grey picture the receiver shows then, and in ``outage``. The
    transmitter is told what the receiver reported on the image before; before the first, a learned one is
    told the SNR that is set, and one that chooses a rate what the receiver reported on a frame that is not
    counted.

    Args:
        settings: What to measure.
        codecs: Used instead of the codecs that ``settings.codec`` names.

    Returns:
        Provenance and ``results``: one row per codec and SNR (``snr_db``, of a trace its start, None for that
        of a file) with means over the images of ``psnr_db``, ``ssim`` (None for images below 11 pixels),
        ``ms_ssim`` (below 176) and ``cbr``, pilots included; the share of ``outage``; ``snr_db_estimate`` of
        the receiver; ``encode_ms`` and ``decode_ms`` (p50, p95); ``confidence`` with ``mean``, ``ece``
        against the pixel label and ``spearman_blocks``, which are such means too; and ``images``, one row
        per image. Written to ``settings.json`` and drawn into ``settings.out`` where given.

    Raises:
        SourceError: The images can't be read.
        ConfigError: A codec is unknown.
        SemcastError: A result can't be written.
    """
    settings = naming(settings, codecs)
    images, left_out = read_images(settings.images, settings.max_images)
    if codecs is None:
        codecs = [_load(name, settings) for name in settings.codec]
    under_name = dict(zip(short_names(settings.codec), codecs, strict=True))
    sizes = {image.shape: to_coded(image, settings.rate) for image in images.values()}
    _warm_up(under_name.values(), list(sizes.values()))
    strip_snr_db = min(settings.links, key=lambda snr_db: abs(snr_db - _STRIP_SNR_DB))
    strip: list[dict[str, NDArray[np.uint8]]] = []
    results: list[dict[str, Any]] = []
    with until_interrupted(results) as part:
        for snr_db, link in settings.links.items():
            streams = {label: _Stream(codec, images, link, settings) for label, codec in under_name.items()}
            samples: dict[str, list[_Sample]] = {label: [] for label in streams}
            for k, (name, image) in enumerate(images.items()):
                for label, stream in streams.items():
                    samples[label].append(stream.send(image, k))
                if snr_db == strip_snr_db and len(strip) < _STRIP_IMAGES:
                    strip.append(_strip_row(name, image, {n: s[-1] for n, s in samples.items()}))
            stated_db = stated_snr_db(snr_db, link)
            results += [_row(name, stated_db, list(images), rows) for name, rows in samples.items()]
    report = write_result(
        settings.json,
        {
            **provenance(VERB, settings),
            "num_images": len(images),
            "images_left_out": left_out,
            "results": results,
        },
        part,
    )
    if settings.out is not None:
        if settings.link.channel != "trace":
            learned = {codec.modulation for codec in under_name.values() if not is_conventional(codec.name)}
            _draw(settings, sorted(learned), results)
        label = snr_file_label(strip_snr_db, settings.link)
        write_picture_strip(settings.out / f"pictures_{label}.png", strip)
    return report


@dataclass(frozen=True)
class _Exported:
    """A learned codec whose images the exported encoder encodes."""

    encoder: Codec
    decoder: Codec

    @property
    def name(self) -> str:
        return self.decoder.name

    @property
    def digest(self) -> str:
        return self.decoder.digest

    @property
    def modulation(self) -> Modulation:
        return self.encoder.modulation

    def encode(self, image: NDArray[np.uint8], snr_db: float) -> EncodedImage:
        return self.encoder.encode(image, snr_db)

    def decode(self, received: ReceivedImage) -> DecodedImage:
        return self.decoder.decode(received)


def _load(name: str, settings: CodecSettings) -> Codec:
    codec = load_codec(
        name, modulation=settings.modulation, num_threads=settings.threads, precision=settings.precision
    )
    if settings.runtime == "torch" or codec.name not in LEARNED_CODECS:
        return codec
    encoder = load_codec(
        name, modulation=settings.modulation, num_threads=settings.threads, runtime=settings.runtime
    )
    if encoder.digest != codec.digest:
        raise ConfigError(
            f"the exported encoder of {name} is of other weights: its digest must be {codec.digest}, "
            f"got {encoder.digest}"
        )
    return _Exported(encoder, codec)


def _warm_up(codecs: Iterable[Codec], images: Sequence[NDArray[np.uint8]]) -> None:
    """Let every codec build what it builds at its first image of a size, outside the measured times."""
    for codec, image in product(codecs, images):
        received = Link(ChannelSettings(snr_db=15.0), 0).carry(codec.encode(image, 15.0), 0.0)
        if received is not None:
            codec.decode(received)


def _run(
    codec: Codec,
    image: NDArray[np.uint8],
    link: Link,
    reporter: LinkReporter,
    k: int,
    told_db: float,
    settings: CodecSettings,
) -> _Sample:
    start_ns = time.perf_counter_ns()
    encoded = codec.encode(to_coded(image, settings.rate), told_db)
    encode_ms = (time.perf_counter_ns() - start_ns) * 1e-6
    equalised = link.receive(encoded, k * _FRAME_INTERVAL_S, k, perfect_csi=settings.perfect_csi)
    times_ms = {"encode": encode_ms}
    if equalised is None:
        decoded = DecodedImage(
            image=np.full_like(image, OUTAGE_GREY),
            confidence=np.zeros(image.shape[:2], dtype=np.float32),
            outage=True,
        )
    else:
        start_ns = time.perf_counter_ns()
        decoded = from_coded(codec.decode(equalised.received), (image.shape[0], image.shape[1]))
        times_ms["decode"] = (time.perf_counter_ns() - start_ns) * 1e-6
    figures = {
        "psnr_db": psnr_db(decoded.image, image),
        "ssim": ssim(decoded.image, image),
        "ms_ssim": ms_ssim(decoded.image, image),
        "cbr": layout_for(encoded.shape_hw).num_uses / image.size,
        "outage": float(decoded.outage),
        "snr_db_estimate": None if equalised is None else equalised.snr_db,
    }
    report_db = told_db if equalised is None else reporter.snr_db(equalised)
    return _Sample(figures, _grade_confidence(decoded, image), times_ms, decoded, report_db)


def _grade_confidence(decoded: DecodedImage, image: NDArray[np.uint8]) -> dict[str, float | None]:
    label = pixel_label(decoded.image, image, LABEL_SHARPNESS)
    graded = label[GRADED]
    return {
        "mean": float(decoded.confidence.mean()),
        "ece": reliability(decoded.confidence[GRADED], graded).ece if graded.size else None,
        "spearman_blocks": spearman(block_means(decoded.confidence), block_means(label)),
    }


def _row(codec: str, snr_db: float | None, names: list[str], samples: list[_Sample]) -> dict[str, Any]:
    return {
        "codec": codec,
        "snr_db": snr_db,
        **{key: finite_mean([s.figures[key] for s in samples]) for key in samples[0].figures},
        "encode_ms": percentiles([s.times_ms["encode"] for s in samples]),
        "decode_ms": percentiles([s.times_ms["decode"] for s in samples if "decode" in s.times_ms]),
        "confidence": {
            key: finite_mean([s.confidence[key] for s in samples]) for key in samples[0].confidence
        },
        "images": [
            {"image": name, **{key: s.figures[key] for key in ("psnr_db", "ssim", "outage")}}
            for name, s in zip(names, samples, strict=True)
        ],
    }


def _strip_row(
    name: str, image: NDArray[np.uint8], samples: dict[str, _Sample]
) -> dict[str, NDArray[np.uint8]]:
    row = {f"original ({name})": image}
    for codec, sample in samples.items():
        psnr, similarity = sample.figures["psnr_db"], sample.figures["ssim"]
        label = f"{codec}: {psnr:.2f} dB" + ("" if similarity is None else f", SSIM {similarity:.3f}")
        row[label] = sample.decoded.image
    return row


def _draw(settings: CodecSettings, modulations: list[str], results: list[dict[str, Any]]) -> None:
    """Draw PSNR and SSIM over SNR (Fig. 7 and 8 of the paper), with the link they were measured over.

    Args:
        settings: With ``out``.
        modulations: Those of learned codecs; conventional ones have their own.
        results: Rows of the report.
    """
    assert settings.out is not None
    order = sorted(settings.snr_db)
    num_images = len(results[0]["images"])
    sent = [f"{modulation} (learned codecs)" for modulation in modulations]
    title = ", ".join(
        [
            settings.link.channel,
            *sent,
            f"CBR {settings.rate}",
            f"mean of {num_images} image{'s' if num_images > 1 else ''}",
        ]
    )
    names = list(dict.fromkeys(row["codec"] for row in results))
    for key, file_name, label in (
        ("psnr_db", "fig7_psnr.png", "PSNR (dB)"),
        ("ssim", "fig8_ssim.png", "SSIM"),
        ("ms_ssim", "ms_ssim.png", "MS-SSIM"),
    ):
        values = {(row["codec"], row["snr_db"]): row[key] for row in results}
        curves = {name: [values[name, s] for s in order] for name in names}
        if any(v is not None for curve in curves.values() for v in curve):
            plot_against_snr(settings.out / file_name, order, curves, label, title)
