"""Streaks of motion blur that differ between two images, told by their spectra, and both images made alike.

A camera that shakes while it exposes draws every point out to a streak, each image in another direction. A
window then looks different in the next image, and Lucas-Kanade loses it or puts it in a wrong place. A streak
of length L takes ``sinc^2(f . L)`` off the power at frequency f, and the scene, which is that of both images,
drops out of the ratio of their spectra. What is left tells the streak of each; with that of the other laid on
it, each image is blurred by both, and a point looks alike in the two. Streaks they have in common stay as
they are: those do no harm.
"""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

#: Side by which images are made smaller first: shorter streaks than are told do no harm.
_SHRINK = 2
#: Directions by which spectra and streaks are told, over half a turn,
_NUM_DIRECTIONS = 18
#: and limits of the rings of frequency, in cycles per pixel of the full image.
_RINGS = np.geomspace(0.016, 0.2, 9)
#: Lengths of streaks that are tried.
_LENGTHS_PX = (5.0, 7.0, 9.0, 12.0, 15.0, 18.0, 21.0, 25.0, 30.0, 36.0)
#: Power that is left where a streak leaves none: noise, and what streaks of other directions elsewhere leave.
_FLOOR = 0.02
#: Root mean square difference of two spectra, in nepers of power, below which images are blurred alike.
_LEAST_DIFFERENCE = 0.5
#: Share of its square that streaks must explain.
_EXPLAINED = 0.6
#: Added to the mean square misfit for each pixel of streak: of all that explain as much, the shortest.
_PER_PIXEL = 0.002


@dataclass(frozen=True)
class Streak:
    """Blur along a line.

    Attributes:
        length_px: Of the line.
        angle_rad: Its direction in the image, from x towards y, in [0, pi).
    """

    length_px: float
    angle_rad: float

    def laid_on(self, grey: Grey) -> Grey:
        """Blur a ``(H, W)`` image by it."""
        return np.asarray(cv2.filter2D(grey, -1, _kernel(self), borderType=cv2.BORDER_REFLECT_101), np.uint8)


def band_power(grey: Grey) -> Array:
    """Logarithm of the mean power of an ``(H, W)`` image by ring and direction, their mean taken off.

    Returns:
        ``(R * D,)``, rings of frequency first.
    """
    size = (max(1, grey.shape[1] // _SHRINK), max(1, grey.shape[0] // _SHRINK))
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    window, band, count = _bands(small.shape[0], small.shape[1])
    # Lengths whose transform is quick: what is filled up with zeros has the same spectrum, more finely told.
    lengths = tuple(map(cv2.getOptimalDFTSize, small.shape))
    filled = np.zeros(lengths, np.float32)
    filled[: small.shape[0], : small.shape[1]] = (small - small.mean()) * window
    spectrum = cv2.dft(filled, flags=cv2.DFT_COMPLEX_OUTPUT)[:, : band.shape[1]]
    power = np.einsum("vuk,vuk->vu", spectrum, spectrum)
    total = np.bincount(band.ravel(), power.ravel(), minlength=len(count) + 1)[:-1]
    log_power = np.log(total / np.maximum(1, count) + 1e-3)
    return np.asarray(log_power - log_power.mean())


def differing_streaks(bands0: Array, bands1: Array) -> tuple[Streak | None, Streak | None] | None:
    """Tell the streaks of two images of a scene, as far as they differ, by their ``band_power``.

    Returns:
        Of the first and of the second image, None for one that has none; None where the images are blurred
        alike, or differ in something else.
    """
    difference = bands0 - bands1
    square = float((difference**2).mean())
    if square < _LEAST_DIFFERENCE**2:
        return None
    model, gram, length_px = _models()
    along = model @ difference / len(difference)
    norm = np.diag(gram)
    misfit = square - 2.0 * (along[:, None] - along) + norm[:, None] + norm - 2.0 * gram
    first, second = np.unravel_index(
        np.argmin(misfit + _PER_PIXEL * (length_px[:, None] + length_px)), misfit.shape
    )
    if misfit[first, second] > (1.0 - _EXPLAINED) * square:
        return None
    streaks = _streaks()
    return streaks[int(first)], streaks[int(second)]


def blurred_alike(grey0: Grey, grey1: Grey, bands0: Array, bands1: Array) -> tuple[Grey, Grey]:
    """Lay the streak of each of two ``(H, W)`` images on the other one, given their ``band_power``.

    Returns:
        Both, as they are where they are blurred alike.
    """
    streak0, streak1 = differing_streaks(bands0, bands1) or (None, None)
    return (
        grey0 if streak1 is None else streak1.laid_on(grey0),
        grey1 if streak0 is None else streak0.laid_on(grey1),
    )


@cache
def _streaks() -> tuple[Streak | None, ...]:
    angles = np.arange(_NUM_DIRECTIONS) * np.pi / _NUM_DIRECTIONS
    return None, *(Streak(length_px, float(a)) for length_px in _LENGTHS_PX for a in angles)


@cache
def _models() -> tuple[Array, Array, Array]:
    """What each streak does to ``band_power`` ``(S, R * D)``, their inner products, and lengths ``(S,)``."""
    frequency = np.sqrt(_RINGS[:-1] * _RINGS[1:])
    spread = np.linspace(-0.5, 0.5, 7)
    ring = frequency[:, None] * (_RINGS[1] / _RINGS[0]) ** spread
    angle = (np.arange(_NUM_DIRECTIONS)[:, None] + spread) * np.pi / _NUM_DIRECTIONS
    rows = []
    for streak in _streaks():
        length_px, towards = (0.0, 0.0) if streak is None else (streak.length_px, streak.angle_rad)
        phase = ring[:, None, :, None] * length_px * np.cos(angle - towards)[None, :, None, :]
        power = np.log((np.sinc(phase) ** 2).mean(axis=(2, 3)) + _FLOOR).ravel()
        rows.append(power - power.mean())
    model = np.stack(rows)
    lengths = np.array([0.0 if streak is None else streak.length_px for streak in _streaks()])
    return model, model @ model.T / model.shape[1], lengths


@cache
def _bands(height: int, width: int) -> tuple[NDArray[np.float32], NDArray[np.intp], NDArray[np.intp]]:
    """Window of the spectrum of a small image, the band of each frequency, and the frequencies in each band.

    What is in no band is in one more.
    """
    window = np.outer(np.hanning(height), np.hanning(width)).astype(np.float32)
    y = np.fft.fftfreq(cv2.getOptimalDFTSize(height))[:, None] / _SHRINK
    x = np.fft.rfftfreq(cv2.getOptimalDFTSize(width))[None, :] / _SHRINK
    ring = np.searchsorted(_RINGS, np.hypot(x, y)) - 1
    step = np.pi / _NUM_DIRECTIONS
    direction = np.rint(np.arctan2(y, x) / step).astype(np.intp) % _NUM_DIRECTIONS
    num_rings = len(_RINGS) - 1
    is_in = (ring >= 0) & (ring < num_rings)
    band = np.where(is_in, ring * _NUM_DIRECTIONS + direction, num_rings * _NUM_DIRECTIONS)
    return window, band, np.bincount(band[is_in], minlength=num_rings * _NUM_DIRECTIONS)


@cache
def _kernel(streak: Streak) -> NDArray[np.float32]:
    """Line through the middle of a square of odd side, ``(K, K)``, with a sum of 1."""
    reach = int(np.ceil(0.5 * streak.length_px))
    offset = np.arange(-reach, reach + 1)
    along = offset * np.cos(streak.angle_rad) + offset[:, None] * np.sin(streak.angle_rad)
    across = offset[:, None] * np.cos(streak.angle_rad) - offset * np.sin(streak.angle_rad)
    inside = np.clip(0.5 * streak.length_px + 0.5 - np.abs(along), 0.0, 1.0)
    kernel = inside * np.clip(1.0 - np.abs(across), 0.0, 1.0)
    return np.asarray(kernel / kernel.sum(), np.float32)
