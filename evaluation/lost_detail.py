"""Fit and grade pixel confidence where a picture is coded at a smaller size than the camera's.

Run by ``make bench-lost-detail DATA=<folder>``; about four minutes of one core. The factors of
``common.lost_detail`` are fitted to photos of ``DATA/train``, of which every second one is kept for choosing
between forms, and graded once on ``DATA/valid``, which chose nothing.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.channel.link import Link
from semcast.channel.settings import ChannelSettings
from semcast.common.codec import DEFAULT_CODEC, LABEL_SHARPNESS, Codec, DecodedImage
from semcast.common.codecs import load_codec
from semcast.common.image_file import read_image
from semcast.common.layouts.files import images_in
from semcast.common.lost_detail import ERROR_FACTORS, detail_at, scaled_errors
from semcast.common.rate import Rate, from_coded, to_coded
from semcast.common.source_commit import source_commit
from semcast.evaluation.calibration import reliability
from semcast.evaluation.report import RESULTS, check_outputs, machine_kind, write_result
from semcast.evaluation.uncertainty_maps import GRADED, pixel_label

Array = NDArray[np.float64]

#: Rates of the fit; another one is graded too.
_FIT_RATES: tuple[Rate, ...] = ("1/48", "1/24")
_GRADED_RATES: tuple[Rate, ...] = ("1/48", "1/32", "1/24")
_SNRS_DB = (2.0, 6.0, 10.0)
#: Conventional codecs are graded by the same factors.
_CODECS = (DEFAULT_CODEC, "jpeg-amc")
#: Photos of the fit and of what is kept from it, of either half.
_NUM_PHOTOS = 64
#: Pixels of a photo that the fit sees.
_PIXELS = 1000
_STEPS = 12


@dataclass(frozen=True)
class _Sent:
    """One photo as it arrived.

    Attributes:
        small: At the coded size.
        large: At the camera's.
        original: Of the camera.
    """

    small: DecodedImage
    large: DecodedImage
    original: NDArray[np.uint8]

    @property
    def ratio(self) -> float:
        """Of the coded size to the camera's."""
        return float(np.sqrt(self.small.image[..., 0].size / self.original[..., 0].size))

    @property
    def label(self) -> NDArray[np.float32]:
        """What confidence should be, at the camera's size."""
        label: NDArray[np.float32] = pixel_label(self.large.image, self.original, LABEL_SHARPNESS)
        return label


def fit_factors(errors: Array, label: Array) -> tuple[float, float]:
    """Return the factors by which ``1 - tanh(factors @ errors)`` is closest to the labels, in least squares.

    Args:
        errors: ``(2, N)`` of ``scaled_errors``.
        label: ``(N,)``, means over pixels of the label that confidence is trained on.
    """
    factors = np.array([1.0, 0.0])
    for _ in range(_STEPS):  # Gauss-Newton
        doubt = np.tanh(factors @ errors)
        slope = -(1.0 - doubt**2) * errors  # (2, N)
        step, *_ = np.linalg.lstsq(slope.T, label - (1.0 - doubt), rcond=None)
        factors = factors + step
    return float(factors[0]), float(factors[1])


def _photos(folder: Path, count: int) -> list[NDArray[np.uint8]]:
    """Return photos spread evenly over a folder."""
    paths = images_in(folder)
    chosen = np.unique(np.linspace(0, len(paths) - 1, min(count, len(paths))).round().astype(int))
    return [read_image(paths[i]) for i in chosen]


def _sent(photos: Sequence[NDArray[np.uint8]], codec: Codec, rate: Rate, snr_db: float) -> Iterator[_Sent]:
    """Send photos over AWGN, each over its own link."""
    for k, photo in enumerate(photos):
        link = Link(ChannelSettings(snr_db=snr_db), seed=k)
        received = link.carry(codec.encode(to_coded(photo, rate), snr_db), 0.0)
        if received is None:
            continue
        small = codec.decode(received)
        if not small.outage:
            yield _Sent(small, from_coded(small, (photo.shape[0], photo.shape[1])), photo)


def _samples(sent: _Sent, rng: np.random.Generator) -> Array:
    """Return ``(3, N)``: both errors and the label, at pixels of the coded picture."""
    shape_hw = sent.small.image.shape[:2]
    errors = scaled_errors(sent.small.confidence, detail_at(sent.small.image, sent.ratio))
    label = cv2.resize(sent.label, (shape_hw[1], shape_hw[0]), interpolation=cv2.INTER_AREA)
    rows = np.concatenate([errors.reshape(2, -1), label.reshape(1, -1)])
    return np.asarray(rows[:, rng.choice(rows.shape[1], min(_PIXELS, rows.shape[1]), replace=False)], float)


def _fit(photos: Sequence[NDArray[np.uint8]], codec: Codec) -> tuple[float, float]:
    rng = np.random.default_rng(0)
    parts = [
        _samples(sent, rng)
        for rate, snr_db in product(_FIT_RATES, _SNRS_DB)
        for sent in _sent(photos, codec, rate, snr_db)
    ]
    rows = np.concatenate(parts, axis=1)
    return fit_factors(rows[:2], rows[2])


def _grade(photos: Sequence[NDArray[np.uint8]], codec: Codec, rate: Rate, snr_db: float) -> dict[str, Any]:
    """Return calibration errors of the map scaled up as it is and with what scaling adds."""
    graded: dict[str, list[tuple[Array, Array]]] = {"as_decoded": [], "with_lost_detail": []}
    for sent in _sent(photos, codec, rate, snr_db):
        label = sent.label[GRADED].ravel().astype(np.float64)
        size_wh = (sent.original.shape[1], sent.original.shape[0])
        plain = cv2.resize(sent.small.confidence, size_wh, interpolation=cv2.INTER_LINEAR)
        for name, confidence in (("as_decoded", plain), ("with_lost_detail", sent.large.confidence)):
            graded[name].append((confidence[GRADED].ravel().astype(np.float64).clip(0.0, 1.0), label))
    row: dict[str, Any] = {"codec": codec.name, "rate": rate, "snr_db": snr_db}
    for name, pairs in graded.items():
        row[f"ece_{name}"] = float(np.mean([reliability(*pair).ece for pair in pairs]))
        predicted, observed = (np.concatenate(side) for side in zip(*pairs, strict=True))
        row[f"ece_of_all_{name}"] = reliability(predicted, observed).ece
    return row


def run(data: Path, num_photos: int) -> dict[str, Any]:
    """Fit the factors and grade those of ``common.lost_detail``.

    Args:
        data: Folder with ``train/`` and ``valid/``.
        num_photos: Of ``train/``, half of them for the fit; as many of ``valid/`` as that half.

    Returns:
        ``fitted`` and ``used`` factors; ``kept`` and ``valid``, rows with the calibration error as the mean
        over photos (``ece_*``) and of all their pixels together (``ece_of_all_*``).
    """
    learned, conventional = (load_codec(name, num_threads=1) for name in _CODECS)
    photos = _photos(data / "train", num_photos)
    valid = _photos(data / "valid", num_photos // 2)

    def grades(group: Sequence[NDArray[np.uint8]], *codecs: Codec) -> list[dict[str, Any]]:
        return [_grade(group, *cell) for cell in product(codecs, _GRADED_RATES, _SNRS_DB)]

    return {
        "fitted": _fit(photos[::2], learned),
        "used": ERROR_FACTORS,
        "kept": grades(photos[1::2], learned),
        "valid": grades(valid, learned, conventional),
    }


def main() -> None:
    """Fit to ``DATA/train``, grade on the rest of it and on ``DATA/valid`` and write the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path, help="folder with train/ and valid/")
    parser.add_argument("--photos", type=int, default=_NUM_PHOTOS, help="photos of train/, half for the fit")
    parser.add_argument("--json", type=Path, default=RESULTS / "lost_detail.json", help="file for the result")
    arguments = parser.parse_args()
    check_outputs(arguments.json, None)
    report = {
        "command": f"make bench-lost-detail DATA={arguments.data.name} ARGS='--photos {arguments.photos}'",
        "commit": source_commit(),
        "machine": machine_kind(),
        "what": f"AWGN, 16-QAM, photos coded smaller than they are, {arguments.photos} of train/",
        **run(arguments.data, arguments.photos),
    }
    write_result(arguments.json, report)


if __name__ == "__main__":
    main()
