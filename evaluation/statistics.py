"""Statistics of evaluations: ranks, AUROC, Spearman, pose AUC, percentiles and paired bootstrap intervals.

Everything is numpy; a statistic that is not defined for its input (an empty class, a constant variable) is
``None``, never NaN, so results can be written as JSON.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: Resamples of a bootstrap: the 95 % bounds are then steady to a few percent of their width.
NUM_RESAMPLES = 2000
#: Resamples behind an interval in a table of a page, of which there are few: the second digit is then steady.
_NUM_PAGE_RESAMPLES = 4000
_PAGE_SEED = 0
#: Samples from which an interval is given.
MIN_SAMPLES = 5


def average_ranks(values: ArrayLike) -> Array:
    """Return ranks from 1 of ``(N,)`` values; equal values share the mean of their ranks."""
    x = np.asarray(values, dtype=np.float64).ravel()
    _, group_idx, counts = np.unique(x, return_inverse=True, return_counts=True)
    last_rank = np.cumsum(counts)
    return np.asarray((last_rank - 0.5 * (counts - 1))[group_idx])


def auroc(scores: ArrayLike, positive: ArrayLike) -> float | None:
    """Return the probability that a positive scores above a negative, ties counted half (Mann-Whitney).

    Args:
        scores: ``(N,)``, higher should mean positive.
        positive: ``(N,)`` bool.

    Returns:
        A number in [0, 1], 0.5 for scores that say nothing, or None when one class is empty.

    Raises:
        ValueError: Lengths differ or a score is NaN.
    """
    x = np.asarray(scores, dtype=np.float64).ravel()
    is_positive = np.asarray(positive, dtype=bool).ravel()
    if len(x) != len(is_positive) or np.isnan(x).any():
        raise ValueError(f"need N scores without NaN and N labels, got {len(x)} and {len(is_positive)}")
    num_positive = int(is_positive.sum())
    num_negative = len(x) - num_positive
    if num_positive == 0 or num_negative == 0:
        return None
    rank_sum = float(average_ranks(x)[is_positive].sum())
    return (rank_sum - num_positive * (num_positive + 1) / 2) / (num_positive * num_negative)


def spearman(a: ArrayLike, b: ArrayLike) -> float | None:
    """Return Spearman's rank correlation of two ``(N,)`` variables in [-1, 1].

    Returns:
        None with fewer than two samples or when a variable is constant.

    Raises:
        ValueError: Lengths differ or a value is NaN.
    """
    x = np.asarray(a, dtype=np.float64).ravel()
    y = np.asarray(b, dtype=np.float64).ravel()
    if len(x) != len(y) or np.isnan(x).any() or np.isnan(y).any():
        raise ValueError(f"need two variables of one length without NaN, got {len(x)} and {len(y)}")
    if len(x) < 2:
        return None
    rank_x = average_ranks(x) - (len(x) + 1) / 2
    rank_y = average_ranks(y) - (len(y) + 1) / 2
    norm = float(np.sqrt((rank_x @ rank_x) * (rank_y @ rank_y)))
    return None if norm == 0.0 else float(np.clip(rank_x @ rank_y / norm, -1.0, 1.0))


def pose_auc_percent(errors_deg: ArrayLike, threshold_deg: float) -> float | None:
    """Return the area under the recall curve up to a threshold, in percent.

    The recall at error e is the share of pairs with an error of at most e, drawn as straight lines between
    the sorted errors (the trapezoid rule of SuperGlue's and LoFTR's evaluations).

    Args:
        errors_deg: ``(N,)`` errors in degrees; ``inf`` is a failed pair.
        threshold_deg: Positive.

    Raises:
        ValueError: An error is negative or NaN, or the threshold is not positive.
    """
    errors = np.sort(np.asarray(errors_deg, dtype=np.float64).ravel())
    if np.isnan(errors).any() or (errors < 0).any():
        raise ValueError("errors_deg must be non-negative numbers")
    if not threshold_deg > 0:
        raise ValueError(f"threshold_deg must be positive, got {threshold_deg}")
    if len(errors) == 0:
        return None
    recall = np.arange(len(errors) + 1) / len(errors)
    num_below = int(np.searchsorted(errors, threshold_deg))
    e = np.concatenate([[0.0], errors[:num_below], [threshold_deg]])
    r = np.concatenate([recall[: num_below + 1], [recall[num_below]]])
    return float(100.0 * np.sum(np.diff(e) * (r[1:] + r[:-1]) / 2) / threshold_deg)


def finite_mean(values: Iterable[float | None]) -> float | None:
    """Return the mean of the values that are there and finite, or None when there are none."""
    known = [v for v in values if v is not None and np.isfinite(v)]
    return float(np.mean(known)) if known else None


def percentiles(values: ArrayLike, which: Sequence[int] = (50, 95)) -> dict[str, float | None]:
    """Return ``{"p50": ..., "p95": ...}`` of ``(N,)`` values; None each when there are none."""
    x = np.asarray(values, dtype=np.float64).ravel()
    return {f"p{p}": float(np.percentile(x, p)) if len(x) else None for p in which}


@dataclass(frozen=True)
class PairedDifference:
    """How a differs from its rival b on the same samples.

    Attributes:
        difference: Mean of a minus mean of b.
        low: Lower bound of the interval of the difference; None with too few samples for one.
        high: Upper bound.
        ratio: Mean of a over mean of b; None when b's mean is zero.
        ratio_low: Lower bound of the ratio; None when a mean of some resample is not positive.
        ratio_high: Upper bound of the ratio.
        num_samples: Samples (clusters) resampled.
    """

    difference: float
    low: float | None
    high: float | None
    ratio: float | None
    ratio_low: float | None
    ratio_high: float | None
    num_samples: int


def small_sample_factor(count: int, level: float = 0.95) -> float:
    """Return by how much a percentile interval of ``count`` samples must grow to cover what it says.

    Resampling a few values shows too little of their spread by ``sqrt((n - 1) / n)``, and takes that spread
    for known: Student's quantile over the normal one (Hesterberg 2015, "What teachers should know about the
    bootstrap", expanded percentile interval).

    Raises:
        ValueError: There are fewer than 5 samples, for which the expansion of the quantile is not good.
    """
    normal = NormalDist().inv_cdf(0.5 + 0.5 * level)
    return float(student_quantile(count, level) / normal * np.sqrt(count / (count - 1)))


def student_quantile(count: int, level: float = 0.95) -> float:
    """Return how many standard deviations, told by ``count`` samples, an interval reaches to either side.

    Raises:
        ValueError: As ``small_sample_factor``.
    """
    if count < MIN_SAMPLES:
        raise ValueError(f"count must be at least {MIN_SAMPLES}, got {count}")
    z = NormalDist().inv_cdf(0.5 + 0.5 * level)
    nu = count - 1
    # In powers of 1 / nu (Abramowitz and Stegun 26.7.5).
    quantile = z + (z**3 + z) / (4 * nu) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * nu**2)
    return quantile + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * nu**3)


def scatter_of_mean(values: Array, rng: np.random.Generator) -> Array:
    """Return by how much means of resampled values are off, widened as ``small_sample_factor`` says.

    Args:
        values: ``(N,)``, at least 5.
        rng: Source of the resamples.

    Returns:
        ``(R,)``: with the mean of the values added, its percentiles are the bounds of an interval.

    Raises:
        ValueError: As ``small_sample_factor``.
    """
    factor, size = small_sample_factor(len(values)), (_NUM_PAGE_RESAMPLES, len(values))
    off = values[rng.integers(len(values), size=size)].mean(axis=1) - values.mean()
    return np.asarray(factor * off)


def mean_ratio(log_ratios: Sequence[Array]) -> tuple[float, float, float]:
    """Return the geometric mean of ratios, all groups of them alike, and its 95 % bootstrap interval.

    Args:
        log_ratios: Logarithms ``(N,)`` of the ratios of each group, at least 5; each group is resampled by
            itself.

    Returns:
        The mean, and the bounds of the interval, which are the same at each call.

    Raises:
        ValueError: As ``small_sample_factor``.
    """
    rng = np.random.default_rng(_PAGE_SEED)
    off = np.mean([scatter_of_mean(logs, rng) for logs in log_ratios], axis=0)
    mean = np.mean([logs.mean() for logs in log_ratios])
    low, high = np.exp(mean + np.percentile(off, [2.5, 97.5]))
    return float(np.exp(mean)), float(low), float(high)


def _checked_pair(
    a: ArrayLike, b: ArrayLike, level: float, block: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Check what ``paired_bootstrap`` was asked; its samples as arrays."""
    x = np.asarray(a, dtype=np.float64)
    y = np.asarray(b, dtype=np.float64)
    if x.shape != y.shape or x.ndim not in (1, 2):
        raise ValueError(f"a and b must share a shape (N,) or (N, S), got {x.shape} and {y.shape}")
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("a and b must be finite")
    if not 0.0 < level < 1.0:
        raise ValueError(f"level must be in (0, 1), got {level}")
    if block < 1:
        raise ValueError(f"block must be at least 1, got {block}")
    return x, y


def _resamples(
    num_samples: int, block: int, num_resamples: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Rows of each resample, ``(num_resamples, num_samples)``: blocks begin anywhere and go round the end."""
    num_blocks = -(-num_samples // block)
    starts = rng.integers(num_samples, size=(num_resamples, num_blocks, 1))
    return ((starts + np.arange(block)) % num_samples).reshape(num_resamples, -1)[:, :num_samples]


def paired_bootstrap(
    a: ArrayLike,
    b: ArrayLike,
    rng: np.random.Generator,
    *,
    block: int = 1,
    level: float = 0.95,
    num_resamples: int = NUM_RESAMPLES,
) -> PairedDifference | None:
    """Bootstrap the difference of two means over paired samples (expanded percentile interval).

    Args:
        a: ``(N,)``, or ``(N, S)`` where the S columns are replicates (such as seeds) of the same N samples:
            rows are resampled whole, so correlated replicates do not pass for new evidence.
        b: Same shape, paired with ``a`` entry by entry.
        rng: Source of the resamples.
        block: Consecutive rows drawn together (circular block bootstrap), more than rows are correlated over:
            two pairs of frames ``gap`` apart share a frame when they are ``gap`` rows apart. 1 resamples rows
            independently. The interval is as wide as so many fewer samples make it.
        level: Coverage of the interval.
        num_resamples: Resamples drawn.

    Returns:
        The difference with its interval (without one below ``MIN_SAMPLES`` blocks: resampling one or two
        values says nothing about the others that could have come), or None for no samples.

    Raises:
        ValueError: Shapes differ, a value is not finite, or ``level`` or ``block`` is out of range.
    """
    x, y = _checked_pair(a, b, level, block)
    if x.size == 0:
        return None
    x, y = x.reshape(len(x), -1).mean(axis=1), y.reshape(len(y), -1).mean(axis=1)
    num_samples = len(x)
    difference = float(x.mean() - y.mean())
    ratio = float(x.mean() / y.mean()) if y.mean() != 0 else None
    if num_samples // block < MIN_SAMPLES:
        return PairedDifference(difference, None, None, ratio, None, None, num_samples)
    idx = _resamples(num_samples, block, num_resamples, rng)
    mean_x, mean_y = x[idx].mean(axis=1), y[idx].mean(axis=1)
    tails = 100 * np.array([(1 - level) / 2, (1 + level) / 2])
    widen = small_sample_factor(num_samples // block, level)
    low, high = difference + widen * (np.percentile(mean_x - mean_y, tails) - difference)
    bounds: tuple[float | None, ...] = (None, None)
    if ratio is not None and ratio > 0 and np.all(mean_x > 0) and np.all(mean_y > 0):
        logs = np.log(mean_x / mean_y) - np.log(ratio)
        bounds = tuple((ratio * np.exp(widen * np.percentile(logs, tails))).tolist())
    return PairedDifference(
        difference=difference,
        low=float(low),
        high=float(high),
        ratio=ratio,
        ratio_low=None if bounds[0] is None else float(bounds[0]),
        ratio_high=None if bounds[1] is None else float(bounds[1]),
        num_samples=num_samples,
    )
