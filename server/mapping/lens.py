"""A camera's focal length, radial distortion and principal point, from the residuals of adjustments."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.server.mapping.residual_patterns import (
    CENTRE_X,
    CENTRE_Y,
    FOCAL,
    NUM_PATTERNS,
    RADIAL,
    RADIAL_2,
    RESIDUAL,
    grouped,
    spread,
)

Array = NDArray[np.float64]

_ALL = [FOCAL, RADIAL, RADIAL_2, CENTRE_X, CENTRE_Y]
#: Keeps them apart where images say nothing about one of them, as share of its square.
_DAMPING = 1e-9
#: More parameters than the focal length are believed where they are this many standard deviations from 0,
_MORE_SIGMAS = 3.0
#: and explain at least this much more of the squared residuals, as a share.
_MORE_EXPLAINED = 0.01
#: The principal point is looked for once the focal length changes by no more than this share,
_NEAR_FOCAL = 0.08
#: and radial distortion by no more than this: far from the right lens it takes their place.
_NEAR_RADIAL = 0.1


@dataclass(frozen=True)
class LensFit:
    """The change of a lens that residuals speak for; zero, and surely so, of what was taken for right.

    Attributes:
        focal: By which share the focal length is longer.
        radial: ``(k1, k2)``, by how much the radial coefficients (Brown) are larger.
        centre: ``(x, y)``, how far the principal point is to the right and down, in focal lengths.
        sigma_focal: Standard deviation, by leaving out a part of the keyframes at a time.
        sigma_radial: The same.
        sigma_centre: The same.
        explained: Share of the squared residuals that the change explains.
        unit: Of focal length, k1, k2, x and y in turn, the change that would double the squared residuals
            while the others make up for it as well as they can.
    """

    focal: float = 0.0
    radial: tuple[float, float] = (0.0, 0.0)
    centre: tuple[float, float] = (0.0, 0.0)
    sigma_focal: float = 0.0
    sigma_radial: tuple[float, float] = (0.0, 0.0)
    sigma_centre: tuple[float, float] = (0.0, 0.0)
    explained: float = 0.0
    unit: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)


def fit_lens(views: Sequence[Array] | Array, num_radial: int, with_centre: bool = False) -> LensFit | None:
    """Return the change of the lens that views speak for, None where they say nothing.

    Args:
        views: ``(9, 9)`` of each, as ``residual_patterns.pattern_products_of`` gives them.
        num_radial: Radial coefficients that may change, the first ones, 0 to 2.
        with_centre: Whether the principal point may move.
    """
    parts = grouped(views)
    if parts is None:
        return None
    columns = [FOCAL, *(RADIAL, RADIAL_2)[:num_radial], *((CENTRE_X, CENTRE_Y) if with_centre else ())]
    total = parts.sum(axis=0)
    if not (np.diag(total)[columns] > 0.0).all():
        return None
    change, sigma, unit = np.zeros((3, NUM_PATTERNS))
    change[columns] = _solved(total, columns)
    without = np.stack([_solved(total - part, columns) for part in parts], axis=1)
    sigma[columns] = [spread(each) for each in without]
    unit[columns] = np.sqrt(total[RESIDUAL, RESIDUAL] * np.diag(np.linalg.inv(_normal(total, columns))))
    focal, k1, k2, x, y = change[_ALL].tolist()
    sigma_focal, sigma_k1, sigma_k2, sigma_x, sigma_y = sigma[_ALL].tolist()
    explained = float(change @ total[:, RESIDUAL] / total[RESIDUAL, RESIDUAL])
    sigmas = (sigma_focal, (sigma_k1, sigma_k2), (sigma_x, sigma_y))
    return LensFit(focal, (k1, k2), (x, y), *sigmas, explained, tuple(unit[_ALL].tolist()))


def believed_lens(
    views: Sequence[Array] | Array, num_radial: int = 0, with_centre: bool = False
) -> LensFit | None:
    """Return the change of the lens that views speak for, of more than its focal length where that is sure.

    A wrong focal length and a wrong distortion look alike, and the one alone takes the other's place: so both
    are asked for together.

    Args:
        views: ``(9, 9)`` of each, as ``residual_patterns.pattern_products_of`` gives them.
        num_radial: Coefficients, the first ones, that are believed in anyway.
        with_centre: Whether another principal point is.

    Returns:
        None where views say nothing.
    """
    best = fit_lens(views, num_radial, with_centre)
    for num in range(num_radial + 1, 3):
        fit = fit_lens(views, num, with_centre)
        if fit is not None and _is_more(fit, best, fit.radial[num - 1 :], fit.sigma_radial[num - 1 :]):
            best, num_radial = fit, num
    if not with_centre and best is not None and _is_near(best):
        fit = fit_lens(views, num_radial, with_centre=True)
        if fit is not None and _is_more(fit, best, fit.centre, fit.sigma_centre):
            best = fit
    return best


def _is_near(fit: LensFit) -> bool:
    return abs(fit.focal) <= _NEAR_FOCAL and max(map(abs, fit.radial)) <= _NEAR_RADIAL


def _is_more(
    fit: LensFit, best: LensFit | None, values: tuple[float, ...], sigmas: tuple[float, ...]
) -> bool:
    """Whether a fit is worth believing over a simpler one, for values that only it has."""
    is_sure = any(abs(v) >= _MORE_SIGMAS * sigma > 0.0 for v, sigma in zip(values, sigmas, strict=True))
    return best is not None and is_sure and fit.explained >= best.explained + _MORE_EXPLAINED


def _normal(total: Array, columns: list[int]) -> Array:
    normal = total[np.ix_(columns, columns)]
    return np.asarray(normal + _DAMPING * np.diag(np.diag(normal)) + 1e-12 * np.eye(len(columns)))


def _solved(total: Array, columns: list[int]) -> Array:
    return np.asarray(np.linalg.solve(_normal(total, columns), total[columns, RESIDUAL]))
