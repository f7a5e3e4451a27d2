"""A camera's focal length and radial distortion, from what adjustments leave over."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.server.mapping.left_over import FOCAL, RADIAL, RESIDUAL, grouped, spread

Array = NDArray[np.float64]

#: Keeps the two apart where images say nothing about one of them, as share of its square.
_DAMPING = 1e-9
#: Distortion is believed that is surer than so many standard deviations, and that explains this much more of
#: what is left than the focal length alone.
_RADIAL_SIGMAS, _RADIAL_EXPLAINED = 3.0, 0.01


@dataclass(frozen=True)
class LensFit:
    """The change of a lens that residuals speak for.

    Attributes:
        focal: By which share the focal length is longer.
        radial: By how much the first radial coefficient (Brown) is larger.
        sigma_focal: Standard deviation, by leaving out a part of the keyframes at a time.
        sigma_radial: The same.
        explained: Share of the squared residuals that the change explains.
    """

    focal: float
    radial: float
    sigma_focal: float
    sigma_radial: float
    explained: float


def fit_lens(views: Sequence[Array] | Array, *, with_radial: bool) -> LensFit | None:
    """Return the change of the lens that views speak for, None where they say nothing.

    Args:
        views: ``(5, 5)`` of each, as ``left_over.information`` gives them.
        with_radial: Whether distortion may change too.
    """
    parts = grouped(views)
    if parts is None:
        return None
    columns = [FOCAL, RADIAL] if with_radial else [FOCAL]
    total = parts.sum(axis=0)
    if not (np.diag(total)[columns] > 0.0).all():
        return None
    change = _solved(total, columns)
    sigma = [spread(s) for s in np.stack([_solved(total - part, columns) for part in parts], axis=1)]
    explained = change @ total[columns, RESIDUAL] / total[RESIDUAL, RESIDUAL]
    focal, radial = (*change.tolist(), 0.0)[:2]
    sigma_focal, sigma_radial = (*sigma, 0.0)[:2]
    return LensFit(focal, radial, sigma_focal, sigma_radial, float(explained))


def believed_lens(views: Sequence[Array] | Array) -> LensFit | None:
    """Return the change of the lens that views speak for, with distortion where that is worth believing.

    A wrong focal length and a wrong distortion look alike, and the one alone takes the other's place: so both
    are asked for together.

    Args:
        views: ``(5, 5)`` of each, as ``left_over.information`` gives them.

    Returns:
        ``radial`` and ``sigma_radial`` are zero where it is not; None where views say nothing.
    """
    plain = fit_lens(views, with_radial=False)
    bent = fit_lens(views, with_radial=True)
    if plain is None or bent is None:
        return plain
    is_bent = abs(bent.radial) >= _RADIAL_SIGMAS * bent.sigma_radial
    is_bent &= bent.explained >= plain.explained + _RADIAL_EXPLAINED
    return bent if is_bent else plain


def _solved(total: Array, columns: list[int]) -> Array:
    normal = total[np.ix_(columns, columns)]
    return np.asarray(
        np.linalg.solve(normal + _DAMPING * np.diag(np.diag(normal)) + 1e-12, total[columns, RESIDUAL])
    )
