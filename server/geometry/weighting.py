"""From confidence to weight: the only place where one becomes the other.

One noise model everywhere: ``sigma^2(c) = sigma0^2 exp(beta (1 - c))`` (Eq. 23 of the paper). It sets the
thresholds of the two-view search, the weights of PnP and the factor noise of bundle adjustment.

``paper`` takes the codec's pixel confidence for ``c`` and given ``sigma0`` and ``beta``. ``robust`` first
makes a *geometric* confidence out of everything that speaks of a keypoint's displacement (see
``geometric_confidence``) and then fits ``sigma0`` and ``beta`` to the residuals, so that a confidence
without information ends at ``beta = 0``: unweighted.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import LABEL_SHARPNESS, displacement_px
from semcast.server.geometry.edges import alike, edges_at

Array = NDArray[np.float64]

ConfidenceMode = Literal["robust", "paper", "off", "constant", "shuffled", "inverted"]
#: Huber's constant: 95 % efficiency under normal noise.
HUBER_K = 1.345
#: 99 % quantile of chi-square with two degrees of freedom, as a factor on sigma.
GATE_SIGMAS = 3.035
#: Largest beta the fit may give,
_MOST_BETA = 8.0
#: and the range of its sigma0.
_SIGMA0_RANGE_PX = (0.25, 6.0)
#: Residuals that a group of like confidence needs for the fit,
_MIN_PER_BIN = 12
#: such groups at most,
_MAX_BINS = 8
#: and standard errors from which on its slope counts.
_SIGNIFICANCE = 2.0
#: A gate is never narrower than that of this sigma: landmarks have errors of their own, and a gate that
#: follows the residuals it lets through would close by itself.
_MIN_GATE_SIGMA_PX = 0.6
#: Error of tracking without a link.
_TRACKING_PX = 0.3
#: Expected error from which on a position is worth nothing.
_MOST_PX = 5.0
#: Sigma over the median of |x|, under normal noise.
MAD_TO_SIGMA = 1.0 / 0.67449


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
        huber_px: Residual in pixels at which Huber's loss turns linear, whatever the weight (Eq. 22: weights
            outside of the loss). None: ``HUBER_K`` of each observation's own sigmas.
    """

    sigma0_px: float
    beta: float
    huber_px: float | None = None

    def sigma_px(self, confidence: NDArray) -> Array:
        """Standard deviation per coordinate, ``(N,)`` for ``(N,)`` confidences; weights are ``sigma^-2``."""
        c = np.asarray(confidence, dtype=np.float64)
        return np.asarray(self.sigma0_px * np.exp(0.5 * self.beta * (1.0 - c)))

    def threshold_px(self, confidence: NDArray) -> Array:
        """Gate on a residual's length in 2D: 3 sigma, at most three times that of a fully trusted point.

        The clamp keeps a point nobody trusts from being an inlier of everything.
        """
        sigma = np.minimum(self.sigma_px(confidence), 3.0 * self.sigma0_px)
        return np.asarray(GATE_SIGMAS * np.maximum(sigma, _MIN_GATE_SIGMA_PX))


def fit_noise(confidence: Array, residual_px: Array) -> NoiseModel | None:
    """Fit ``log sigma^2 = log sigma0^2 + beta (1 - c)`` to residuals, robustly.

    Residuals are grouped by quantiles of confidence, each group's spread is its median absolute value, and a
    line goes through the groups. A slope that is not clearly positive becomes 0.

    Args:
        confidence: ``(N,)`` in [0, 1].
        residual_px: ``(N,)`` residuals per coordinate, sign of no matter.

    Returns:
        The model, or None with fewer residuals than one group needs.
    """
    count = len(confidence)
    if count < _MIN_PER_BIN:
        return None
    size = np.abs(residual_px)
    flat = NoiseModel(_clip_sigma0(float(np.median(size)) * MAD_TO_SIGMA), 0.0)
    bins = min(_MAX_BINS, count // _MIN_PER_BIN)
    if bins < 3 or float(np.ptp(confidence)) < 1e-3:
        return flat
    order = np.argsort(confidence, kind="stable")
    groups = np.array_split(order, bins)
    doubt = np.array([1.0 - float(np.mean(confidence[g])) for g in groups])
    spread = np.array([float(np.median(size[g])) for g in groups]) * MAD_TO_SIGMA
    log_variance = 2.0 * np.log(np.maximum(spread, 1e-3))
    # The standard error of log sigma^2 from a median of n absolute values is about 2.33 / sqrt(n).
    precision = np.array([len(g) for g in groups]) / 2.33**2
    mean_doubt = float((precision * doubt).sum() / precision.sum())
    mean_log = float((precision * log_variance).sum() / precision.sum())
    spread_of_doubt = float((precision * (doubt - mean_doubt) ** 2).sum())
    if spread_of_doubt < 1e-9:
        return flat
    slope = float((precision * (doubt - mean_doubt) * (log_variance - mean_log)).sum()) / spread_of_doubt
    scatter = log_variance - mean_log - slope * (doubt - mean_doubt)
    misfit = max(1.0, float((precision * scatter**2).sum()) / max(1, bins - 2))
    if slope < _SIGNIFICANCE * np.sqrt(misfit / spread_of_doubt):
        return flat
    beta = min(slope, _MOST_BETA)
    return NoiseModel(_clip_sigma0(float(np.exp(0.5 * (mean_log - beta * mean_doubt)))), beta)


def _clip_sigma0(sigma0_px: float) -> float:
    return float(np.clip(sigma0_px, *_SIGMA0_RANGE_PX))


class OnlineNoise:
    """The noise model in use, fitted again to the residuals of each bundle adjustment.

    Args:
        mode: ``paper`` keeps what is given; ``off`` fits sigma0 alone.
        sigma0_px: Start.
        beta: In mode ``paper``, and where nothing is fitted; a fit starts at 0, and mode ``off`` stays there.
        fit: False keeps the start in every mode.
    """

    def __init__(self, mode: ConfidenceMode, sigma0_px: float, beta: float, fit: bool) -> None:
        self._mode = mode
        self._fit = fit and mode != "paper"
        start_beta = beta if mode == "paper" or (not fit and mode != "off") else 0.0
        self.model = NoiseModel(sigma0_px, start_beta, HUBER_K * sigma0_px if mode == "paper" else None)
        self._recent: deque[tuple[Array, Array]] = deque(maxlen=8)

    def add(self, confidence: Array, residual_px: Array) -> None:
        """Take the residuals per coordinate of one adjustment, inliers and mild outliers, and fit again.

        The model moves half of the way, so that one bad window does not overturn it.
        """
        if not self._fit or len(confidence) == 0:
            return
        self._recent.append((confidence, residual_px))
        fitted = fit_noise(
            np.concatenate([c for c, _ in self._recent]), np.concatenate([r for _, r in self._recent])
        )
        if fitted is None:
            return
        beta = 0.0 if self._mode == "off" else 0.5 * (self.model.beta + fitted.beta)
        sigma0 = float(np.sqrt(self.model.sigma0_px * fitted.sigma0_px))
        self.model = NoiseModel(_clip_sigma0(sigma0), beta if beta > 0.02 else 0.0)

    def state(self) -> Array:
        """Parameters for a checkpoint: ``[sigma0_px, beta]``."""
        return np.array([self.model.sigma0_px, self.model.beta])

    def restore(self, state: Array) -> None:
        """Go on from ``state``; what is not fitted stays as it was set."""
        if not self._fit:
            return
        state = state * (1.0, 0.0) if self._mode == "off" else state
        self.model = NoiseModel(float(state[0]), float(state[1]))
        self._recent.clear()


@dataclass(frozen=True)
class KeypointCues:
    """All that is known about the localisation of keypoints in one image.

    Attributes:
        pixel_confidence: ``(N,)`` the codec's confidence at the keypoint, or None.
        keypoint_confidence: ``(N,)`` its displacement head at the keypoint, or None.
        gradient_grey2: ``(N,)`` smaller eigenvalue of the structure tensor, mean over the window per pixel.
        forward_backward_px: ``(N,)`` distance of tracking there and back.
        photometric_grey: ``(N,)`` mean absolute difference of the tracked windows.
        drift_px2: ``(N,)`` variance left by the images a point was followed through; 0 where it is new.
        edge: ``(N, 2)`` along which it is known less, see ``edges``.
    """

    pixel_confidence: Array | None
    keypoint_confidence: Array | None
    gradient_grey2: Array
    forward_backward_px: Array
    photometric_grey: Array
    drift_px2: Array | float = 0.0
    edge: Array = field(default_factory=alike)


def localisation_variance_px2(cues: KeypointCues) -> Array:
    """Square of the displacement that is expected in this image alone, ``(N,)``, drift left out.

    Pixel confidence alone misleads: pixel errors are largest on strong edges, where localisation is best. So
    the image noise it stands for is divided by the structure tensor (the localisation bound), and what the
    displacement head and the tracker itself say is added as independent variance.
    """
    noise_grey = np.full(len(cues.gradient_grey2), 2.0)
    if cues.pixel_confidence is not None:
        doubt = 1.0 - np.clip(cues.pixel_confidence, 0.0, 1.0)
        noise_grey = np.maximum(noise_grey, 255.0 / LABEL_SHARPNESS * np.arctanh(np.minimum(doubt, 0.999)))
    noise_grey = np.maximum(noise_grey, cues.photometric_grey)
    # Noise of decoded images is correlated over blocks: a window holds about 16 independent values.
    bound_px2 = noise_grey**2 / (16.0 * np.maximum(cues.gradient_grey2, 0.5))
    variance_px2 = bound_px2 + cues.forward_backward_px**2
    if cues.keypoint_confidence is not None:
        head_px = displacement_px(np.clip(cues.keypoint_confidence, 0.0, 1.0).astype(np.float32))
        variance_px2 = variance_px2 + np.minimum(head_px.astype(np.float64), 20.0) ** 2
    return np.asarray(variance_px2)


def variance_confidence(variance_px2: Array) -> Array:
    """Confidence in a keypoint's *position*, of the variance ``v`` that is expected: a logarithm of it.

    ``c = 1 - log(1 + v / s^2) / log(1 + v_max / s^2)`` turns ``sigma0^2 exp(beta (1 - c))`` into a power of
    ``1 + v / s^2``: what the link adds to the error ``s`` that tracking makes on clean images too. Small
    differences of ``v`` below it say nothing, and points are then weighted alike.
    """
    doubt = np.log1p(variance_px2 / _TRACKING_PX**2) / np.log1p((_MOST_PX / _TRACKING_PX) ** 2)
    return np.asarray(1.0 - np.minimum(doubt, 1.0))


def geometric_confidence(cues: KeypointCues) -> Array:
    """Confidence in a keypoint's position of everything that is known about it, ``(N,)`` in [0, 1]."""
    return variance_confidence(localisation_variance_px2(cues) + cues.drift_px2)


def observation_confidence(mode: ConfidenceMode, cues: KeypointCues, rng: np.random.Generator) -> Array:
    """The ``c`` of each keypoint that the noise model is given in a mode, ``(N,)`` in [0, 1].

    ``off`` is 1 everywhere. ``constant``, ``shuffled`` and ``inverted`` damage the confidence of ``robust``:
    by its mean, by mixing it among the keypoints, and by turning it round.
    """
    count = len(cues.gradient_grey2)
    if mode == "off":
        return np.ones(count)
    if mode == "paper":
        return np.ones(count) if cues.pixel_confidence is None else np.clip(cues.pixel_confidence, 0.0, 1.0)
    c = geometric_confidence(cues)
    if mode == "constant":
        return np.full(count, float(c.mean()) if count else 1.0)
    if mode == "shuffled":
        return np.asarray(rng.permutation(c))
    if mode == "inverted":
        return np.asarray(1.0 - c)
    return c


def observation_edges(mode: ConfidenceMode, grey: NDArray[np.uint8], xy: Array) -> Array:
    """Edges of keypoints ``(N, 2)`` that the geometry is given in a mode, ``(N, 2)``, see ``edges``.

    The paper's noise has no direction, and ``off`` leaves out all that speaks of a keypoint's displacement.
    """
    return np.zeros((len(xy), 2)) if mode in ("off", "paper") else edges_at(grey, xy)
