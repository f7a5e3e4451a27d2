"""Block fading: one complex gain of unit mean power per slot, Rayleigh or Rician, with or without memory.

Memory follows Clarke's model: a sum of plane waves from random directions, which makes the gain a plain
function of time with the autocorrelation ``J0(2 pi doppler_hz tau)``. Nothing is carried from frame to frame,
so a lost frame does not change the fading that later frames see. Time counts from the first frame of a link.
"""

import numpy as np
from numpy.typing import NDArray

#: Waves in Clarke's sum; the gain is close to complex Gaussian from about 20 on.
NUM_WAVES = 64


def rayleigh_gains(num_slots: int, rng: np.random.Generator) -> NDArray[np.complex64]:
    """Draw ``(num_slots,)`` independent circular Gaussian gains of mean power 1."""
    pairs = rng.standard_normal((num_slots, 2)) * np.sqrt(0.5)
    return np.asarray(pairs[:, 0] + 1j * pairs[:, 1], dtype=np.complex64)


def clarke_gains(
    times_s: NDArray[np.float64], doppler_hz: float, rng: np.random.Generator
) -> NDArray[np.complex64]:
    """Return Rayleigh gains at given times, correlated by Clarke's model.

    Args:
        times_s: ``(N,)`` instants.
        doppler_hz: Largest Doppler shift; 0 gives one gain for all times.
        rng: Draws the waves. The same generator state gives the same fading process.
    """
    # One wave of equal power from each of NUM_WAVES sectors: every realisation has mean power 1 over time.
    angles = 2.0 * np.pi / NUM_WAVES * (np.arange(NUM_WAVES) + rng.random(NUM_WAVES))
    amplitudes = np.exp(2j * np.pi * rng.random(NUM_WAVES)) / np.sqrt(NUM_WAVES)
    shifts_rad_s = 2.0 * np.pi * doppler_hz * np.cos(angles)
    return np.asarray(np.exp(1j * times_s[:, None] * shifts_rad_s) @ amplitudes, dtype=np.complex64)


def rician_gains(
    scattered: NDArray[np.complex64], k_factor_db: float, phase_rad: float
) -> NDArray[np.complex64]:
    """Add a line of sight to Rayleigh gains, keeping mean power 1.

    Args:
        scattered: Rayleigh gains of mean power 1.
        k_factor_db: Power of the line of sight over the scattered power.
        phase_rad: Phase of the line of sight.
    """
    k = 10.0 ** (k_factor_db / 10.0)
    direct = np.sqrt(k / (1.0 + k)) * np.exp(1j * phase_rad)
    return np.asarray(direct + scattered / np.sqrt(1.0 + k), dtype=np.complex64)
