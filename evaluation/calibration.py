"""Grades of an uncertainty map: expected calibration error, reliability table and sparsification error."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Reliability:
    """A reliability diagram.

    Attributes:
        predicted: ``(B,)`` mean prediction of each bin that has samples.
        observed: ``(B,)`` mean of the true values in the bin.
        share: ``(B,)`` share of all samples in the bin, sums to 1.
    """

    predicted: Array
    observed: Array
    share: Array

    @property
    def ece(self) -> float:
        """Expected calibration error: the mean ``|predicted - observed|``, weighted by share."""
        return float(np.sum(self.share * np.abs(self.predicted - self.observed)))


def reliability(predicted: ArrayLike, observed: ArrayLike, num_bins: int = 15) -> Reliability:
    """Bin predictions in [0, 1] in equal widths and compare them with what came true.

    Args:
        predicted: ``(N,)`` in [0, 1], such as a confidence.
        observed: ``(N,)`` the value the prediction stands for, such as ``1 - |error|``.
        num_bins: Bins between 0 and 1.

    Raises:
        ValueError: Lengths differ, there is no sample, or a prediction leaves [0, 1].
    """
    p = np.asarray(predicted, dtype=np.float64).ravel()
    o = np.asarray(observed, dtype=np.float64).ravel()
    if len(p) != len(o) or len(p) == 0:
        raise ValueError(f"need as many predictions as observations and at least one, got {len(p)}, {len(o)}")
    if not (np.all(p >= 0) and np.all(p <= 1)):
        raise ValueError(f"predicted must be in [0, 1], got [{p.min()}, {p.max()}]")
    bin_idx = np.minimum((p * num_bins).astype(np.int64), num_bins - 1)
    counts = np.bincount(bin_idx, minlength=num_bins)
    used = counts > 0
    sums_p = np.bincount(bin_idx, weights=p, minlength=num_bins)[used]
    sums_o = np.bincount(bin_idx, weights=o, minlength=num_bins)[used]
    return Reliability(sums_p / counts[used], sums_o / counts[used], counts[used] / len(p))


def sparsification_curve(order_by: ArrayLike, errors: ArrayLike, num_points: int = 50) -> Array:
    """Return the mean error left after removing the samples with the largest ``order_by``.

    Args:
        order_by: ``(N,)`` uncertainty; the largest go first. Equal values are averaged over, as if removed
            in random order, so a constant map gives a flat curve.
        errors: ``(N,)`` true errors.
        num_points: Shares 0, 1/num_points, ... are removed.

    Returns:
        ``(num_points,)`` mean errors, the first over all samples.
    """
    u = np.asarray(order_by, dtype=np.float64).ravel()
    e = np.asarray(errors, dtype=np.float64).ravel()
    _, group_idx, counts = np.unique(u, return_inverse=True, return_counts=True)
    group_mean = np.bincount(group_idx, weights=e) / counts
    kept_error = np.concatenate([[0.0], np.cumsum(np.repeat(group_mean, counts))])
    num_kept = np.round(len(e) * (1.0 - np.arange(num_points) / num_points)).astype(np.int64)
    num_kept = np.maximum(num_kept, 1)
    return np.asarray(kept_error[num_kept] / num_kept)


def normalised_ause(uncertainty: ArrayLike, errors: ArrayLike) -> float | None:
    """Return the area between the sparsification curve and the oracle's, over that of a random order.

    0 is a perfect order by error, 1 no better than random, above 1 worse than random.

    Args:
        uncertainty: ``(N,)``, larger means less trusted.
        errors: ``(N,)`` non-negative true errors.

    Returns:
        None when all errors are equal: no order is better than another.

    Raises:
        ValueError: Lengths differ or there is no sample.
    """
    u = np.asarray(uncertainty, dtype=np.float64).ravel()
    e = np.asarray(errors, dtype=np.float64).ravel()
    if len(u) != len(e) or len(e) == 0:
        raise ValueError(f"need as many uncertainties as errors and at least one, got {len(u)} and {len(e)}")
    oracle = sparsification_curve(e, e)
    random_area = float((e.mean() - oracle).sum())
    if random_area <= 1e-12 * max(float(e.mean()), 1e-30):
        return None
    return float((sparsification_curve(u, e) - oracle).sum()) / random_area
