"""What to say of the lens of the calibration when what is seen fits another one better."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.mapping.lens import LensFit, believed_lens, fit_lens
from semcast.server.mapping.residual_patterns import LEAST_EXPLAINED, LEAST_SIGMAS

Array = NDArray[np.float64]

#: A focal length counts where it seems off by this share: one that is off by 2 %, which makes the path in a
#: drawn room ten times worse, seems off by 1.2 to 1.9, as the map has come to terms with some of it;
_LEAST_FOCAL = 0.012
#: named alone up to this share, beyond which untold distortion has been taken for it,
_MOST_FOCAL = 0.1
#: and this share of that is left when distortion may explain it too;
_LEAST_LEFT = 0.5
#: distortion where it displaces a pixel by this share of the distance to the centre,
_LEAST_RADIAL = 0.012
#: the principal point where it is off by this share of a focal length.
_LEAST_CENTRE = 0.01


def lens_doubt(views: Sequence[Array], sigma_factor: float, camera: Intrinsics) -> str | None:
    """Say what seems wrong with a lens; None where nothing surely is.

    Far from the right lens, focal length, distortion and principal point take each other's place: where
    distortion has a part in it, what residuals say of each is often wrong, even in sign. So a value is told
    only of a focal length that is wrong alone.

    Args:
        views: ``(9, 9)`` of each, as ``residual_patterns.pattern_products_of`` gives them.
        sigma_factor: On standard deviations, see ``PatternEvidence``.
        camera: As it is believed to be, of the images that were tracked.
    """
    fit = believed_lens(views)
    if fit is None or fit.explained < LEAST_EXPLAINED:
        return None
    least_sigmas = LEAST_SIGMAS * sigma_factor
    is_focal = abs(fit.focal) >= max(_LEAST_FOCAL, least_sigmas * fit.sigma_focal)
    is_focal &= any(fit.radial) or _is_no_distortion(fit.focal, views)
    radial = zip(fit.radial, fit.sigma_radial, strict=True)
    is_bent = any(abs(k) >= least_sigmas * sigma > 0.0 for k, sigma in radial)
    is_bent &= _most_bent(fit, camera) >= _LEAST_RADIAL
    centre = zip(fit.centre, fit.sigma_centre, strict=True)
    is_off_centre = any(abs(c) >= max(_LEAST_CENTRE, least_sigmas * sigma) for c, sigma in centre)
    if not (is_focal or is_bent or is_off_centre):
        return None
    if any(fit.radial) or abs(fit.focal) > _MOST_FOCAL:
        return "the lens seems to be another one (distortion, and perhaps focal length and principal point)"
    if is_off_centre:
        return "the principal point seems off" + (", and the focal length" if is_focal else "")
    way = "short" if fit.focal > 0.0 else "long"
    return f"the focal length seems too {way}, by about {100.0 * abs(fit.focal):.0f} % or more"


def _is_no_distortion(focal: float, views: Sequence[Array]) -> bool:
    """Whether a focal length stays wrong when distortion is allowed for that is too small to be believed."""
    fit = fit_lens(views, num_radial=1)
    return fit is not None and focal * fit.focal > 0.0 and abs(fit.focal) >= _LEAST_LEFT * abs(focal)


def _most_bent(fit: LensFit, camera: Intrinsics) -> float:
    """Return by which share of its distance to the centre a pixel is displaced at most."""
    corner = (max(camera.cx, camera.width - camera.cx) / camera.fx) ** 2
    corner += (max(camera.cy, camera.height - camera.cy) / camera.fy) ** 2
    r2 = corner * np.linspace(0.0, 1.0, 11)
    return float(np.abs(fit.radial[0] * r2 + fit.radial[1] * r2**2).max())
