"""Additive white Gaussian noise on complex symbols of unit average power."""

import numpy as np
from numpy.typing import NDArray


def noise_variance(snr_db: float) -> float:
    """Return the complex noise variance at ``snr_db`` (Es/N0 at unit symbol power)."""
    return float(10.0 ** (-snr_db / 10.0))


def complex_noise(
    shape: tuple[int, ...], noise_var: NDArray[np.float32] | float, rng: np.random.Generator
) -> NDArray[np.complex64]:
    """Draw circular complex Gaussian noise, half of the variance in each of the real and imaginary parts.

    Args:
        shape: Shape of the result.
        noise_var: Complex variance, broadcast against ``shape``.
        rng: Source of randomness.

    Raises:
        ValueError: A variance is negative or not finite.
    """
    variance = np.asarray(noise_var, dtype=np.float32)
    if not bool(np.all(np.isfinite(variance) & (variance >= 0))):
        raise ValueError(f"noise_var must be finite and at least 0, got {noise_var}")
    pairs = rng.standard_normal((*shape, 2), dtype=np.float32)
    noise = pairs.view(np.complex64)[..., 0]
    noise *= np.sqrt(variance / np.float32(2.0))
    return noise
