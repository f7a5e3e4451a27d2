"""A relative pose, refined with the noise of its own pair of images, and the share of edges that fits it."""

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.geometry.epipolar import (
    Shapes,
    fundamental_matrix,
    half_line_px,
    refine_relative_pose,
    sampson_px,
    shape_of,
)
from semcast.server.geometry.two_view_candidates import MIN_MATCHES
from semcast.server.geometry.weighting import NoiseModel, fit_noise

Array = NDArray[np.float64]

#: Points near the camera have larger errors and most of the information: the fitted beta overstates what
#: confidence is worth, half of it does best.
_BETA_SHARE = 0.5
#: Standard deviations at which errors are cut off in the refinement,
_CUT_SIGMAS = 2.5
#: and the least that is believed of a pair, however well its matches fit.
_MIN_SIGMA_PX = 0.1
#: Shares of the edges that errors may have.
_SHARES = (0.25, 0.5, 0.75, 1.0)
#: Log-likelihood that a share must gain over none: what a parameter costs (Akaike).
_SHARE_SURE = 1.0
#: No match is known to lie nearer to its line than that.
_LEAST_PX = 1e-6


def shapes_of_errors(
    camera: Intrinsics, T: Array, xy0: Array, xy1: Array, edges: tuple[Array, Array], threshold_px: float
) -> Shapes | None:
    """Shapes of errors as far as the matches near a pose bear them out.

    Where images tell a point across an edge only, its error has the shape of the structure tensor; where
    descriptors or a blurred image place it, hardly any. Which share of the edges makes the distances to the
    epipolar lines likeliest (Laplace) is asked of this pair, as its noise is. None where no share does.
    """
    F = fundamental_matrix(camera, T)
    distance = np.abs(sampson_px(F, xy0, xy1))
    near = distance < 3.0 * threshold_px
    if int(near.sum()) < MIN_MATCHES:
        return None
    xy0, xy1, distance = xy0[near], xy1[near], distance[near] + _LEAST_PX
    least, likeliest = float(len(distance) * np.log(distance.mean())) - _SHARE_SURE, None
    for share in _SHARES:
        shapes = shape_of(share * edges[0]), shape_of(share * edges[1])
        shaped = np.abs(sampson_px(F, xy0, xy1, (shapes[0][near], shapes[1][near]))) + _LEAST_PX
        cost = float(len(distance) * np.log(shaped.mean()) - np.log(shaped / distance).sum())
        if cost < least:
            least, likeliest = cost, shapes
    return likeliest


def refine_to_own_noise(
    camera: Intrinsics,
    T: Array,
    xy0: Array,
    xy1: Array,
    shapes: Shapes | None,
    confidence: Array | None,
    threshold_px: float,
) -> Array:
    """Refine with the noise fitted to this pair; with equal weights where confidence tells nothing."""
    residual = half_line_px(camera, T, xy0, xy1, shapes)
    near = residual < 3.0 * threshold_px
    if int(near.sum()) < MIN_MATCHES:
        return T
    sigma = np.ones(len(xy0))
    model = fit_noise(confidence[near], residual[near]) if confidence is not None else None
    if model is not None and confidence is not None:
        sigma = NoiseModel(1.0, _BETA_SHARE * model.beta).sigma_px(confidence)
    scale_px = float(np.median(residual[near] / sigma[near])) / 0.6745
    sigma_px = max(scale_px, _MIN_SIGMA_PX) * sigma
    return refine_relative_pose(camera, T, xy0, xy1, sigma_px, shapes=shapes, cut_sigmas=_CUT_SIGMAS)
