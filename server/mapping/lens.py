"""A camera's focal length and radial distortion, from what adjustments leave over."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.server.mapping.left_over import FOCAL, RADIAL, RADIAL_2, RESIDUAL, grouped, spread

Array = NDArray[np.float64]

#: Keeps the three apart where images say nothing about one of them, as share of its square.
_DAMPING = 1e-9
#: A coefficient is believed that is surer than so many standard deviations, and that explains this much more
#: of what is left than those before it.
_RADIAL_SIGMAS, _RADIAL_EXPLAINED = 3.0, 0.01


@dataclass(frozen=True)
class LensFit:
    """The change of a lens that residuals speak for.

    Attributes:
        focal: By which share the focal length is longer.
        radial: ``(k1, k2)``, by how much the radial coefficients (Brown) are larger.
        sigma_focal: Standard deviation, by leaving out a part of the keyframes at a time.
        sigma_radial: The same; zero of coefficients that were taken for right.
        explained: Share of the squared residuals that the change explains.
    """

    focal: float
    radial: tuple[float, float]
    sigma_focal: float
    sigma_radial: tuple[float, float]
    explained: float


def fit_lens(views: Sequence[Array] | Array, num_radial: int) -> LensFit | None:
    """Return the change of the lens that views speak for, None where they say nothing.

    Args:
        views: ``(6, 6)`` of each, as ``left_over.information`` gives them.
        num_radial: Radial coefficients that may change, the first ones, 0 to 2.
    """
    parts = grouped(views)
    if parts is None:
        return None
    columns = [FOCAL, RADIAL, RADIAL_2][: 1 + num_radial]
    total = parts.sum(axis=0)
    if not (np.diag(total)[columns] > 0.0).all():
        return None
    change = _solved(total, columns)
    sigma = [spread(s) for s in np.stack([_solved(total - part, columns) for part in parts], axis=1)]
    explained = change @ total[columns, RESIDUAL] / total[RESIDUAL, RESIDUAL]
    focal, k1, k2 = (*change.tolist(), 0.0, 0.0)[:3]
    sigma_focal, sigma_k1, sigma_k2 = (*sigma, 0.0, 0.0)[:3]
    return LensFit(focal, (k1, k2), sigma_focal, (sigma_k1, sigma_k2), float(explained))


def believed_lens(views: Sequence[Array] | Array, num_radial: int = 0) -> LensFit | None:
    """Return the change of the lens that views speak for, with distortion where that is worth believing.

    A wrong focal length and a wrong distortion look alike, and the one alone takes the other's place: so both
    are asked for together.

    Args:
        views: ``(6, 6)`` of each, as ``left_over.information`` gives them.
        num_radial: Coefficients, the first ones, that are believed in anyway.

    Returns:
        ``radial`` and ``sigma_radial`` are zero where it is not; None where views say nothing.
    """
    best = fit_lens(views, num_radial)
    for num in range(num_radial + 1, 3):
        if best is None or (fit := fit_lens(views, num)) is None:
            break
        is_sure = abs(fit.radial[num - 1]) >= _RADIAL_SIGMAS * fit.sigma_radial[num - 1]
        if is_sure and fit.explained >= best.explained + _RADIAL_EXPLAINED:
            best = fit
    return best


def _solved(total: Array, columns: list[int]) -> Array:
    normal = total[np.ix_(columns, columns)]
    return np.asarray(
        np.linalg.solve(normal + _DAMPING * np.diag(np.diag(normal)) + 1e-12, total[columns, RESIDUAL])
    )
