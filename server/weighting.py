"""From confidence to weight: the only place where one becomes the other.

One noise model everywhere: ``sigma^2(c) = sigma0^2 exp(beta (1 - c))`` (Eq. 22 of the paper). It sets the
thresholds of the two-view search, the weights of PnP and the factor noise of bundle adjustment.

``paper`` takes the codec's pixel confidence for ``c`` and given ``sigma0`` and ``beta``. ``robust`` first makes
a *geometric* confidence out of everything that speaks of a keypoint's displacement (see
``geometric_confidence``) and then fits ``sigma0`` and ``beta`` to the residuals, so that a confidence
without information ends at ``beta = 0``: unweighted.
"""

from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import displacement_px

Array = NDArray[np.float64]

ConfidenceMode = Literal["robust", "paper", "off", "constant", "shuffled", "inverted"]
#: Huber's constant: 95 % efficiency under normal noise.
HUBER_K = 1.345
#: 99 % quantile of chi-square with two degrees of freedom, as a factor on sigma.
GATE_SIGMAS = 3.035
#: Range of beta the fit may give.
BETA_RANGE = (0.0, 8.0)
SIGMA0_RANGE_PX = (0.15, 6.0)
#: Median of |x| / sigma under normal noise.
_MAD_TO_SIGMA = 1.0 / 0.67449


def fuse_confidence(confidence0: Array, confidence1: Array) -> Array:
    """Confidence of a match: the smaller of its two ends (Eq. 16 of the paper)."""
    return np.minimum(confidence0, confidence1)


def sampling_probability(confidence: Array) -> Array:
    """``q_i = c_i / sum c`` (Eq. 17); uniform where every confidence is zero."""
    total = float(confidence.sum())
    return confidence / total if total > 0 else np.full(len(confidence), 1.0 / max(1, len(confidence)))


def adaptive_threshold(confidence: Array, delta0: float, epsilon: float = 1e-3) -> Array:
    """``delta_i = delta0 / sqrt(c_i + epsilon)`` (Eq. 19), in the unit of ``delta0``."""
    return np.asarray(delta0 / np.sqrt(confidence + epsilon))


@dataclass(frozen=True)
class NoiseModel:
    """``sigma^2(c) = sigma0^2 exp(beta (1 - c))``.

    Attributes:
        sigma0_px: Standard deviation per pixel coordinate of a fully trusted keypoint.
        beta: How fast the variance grows as confidence falls; 0 ignores confidence.
    """

    sigma0_px: float
    beta: float

    def sigma_px(self, confidence: NDArray) -> Array:
        """Standard deviation per coordinate, ``(N,)`` for ``(N,)`` confidences."""
        c = np.asarray(confidence, dtype=np.float64)
        return np.asarray(self.sigma0_px * np.exp(0.5 * self.beta * (1.0 - c)))

    def weight(self, confidence: NDArray) -> Array:
        """``w = sigma^-2`` (Eq. 22), per square pixel."""
        return self.sigma_px(confidence) ** -2

    def threshold_px(self, confidence: NDArray) -> Array:
        """Gate on a residual's length: 3 sigma, at most three times that of a fully trusted point.

        The clamp keeps a point nobody trusts from being an inlier of everything.
        """
        sigma = np.minimum(self.sigma_px(confidence), 3.0 * self.sigma0_px)
        return np.asarray(GATE_SIGMAS * sigma)
