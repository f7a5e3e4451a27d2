"""What a lens with distortion makes of the picture that a pinhole camera would take."""

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError

#: Pixels around those a sample lies between, for bicubic interpolation.
_REACH = 3
#: Steps and accuracy (in rays) of the search for the ray of a pixel, and the error that is left at most.
_SEARCH = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)
_MAX_ERROR_PX = 0.01


@dataclass(frozen=True)
class Optics:
    """A lens: where each pixel is found in the image of a pinhole camera that sees at least as much.

    Attributes:
        pinhole: The camera without distortion.
        margin: By how many pixels its image is larger on each side.
        sources: ``(H, W, 2)`` of each pixel, in pixels of the pinhole camera; None where they are the same.
    """

    pinhole: Intrinsics
    margin: int = 0
    sources: NDArray[np.float32] | None = None

    @classmethod
    @lru_cache(maxsize=4)
    def of(cls, camera: Intrinsics) -> "Optics":
        """Return the optics of a camera.

        Raises:
            SourceError: The distortion shows some pixels no ray, or one of more than a right angle.
        """
        if not camera.is_distorted:
            return cls(camera.undistorted())
        shape = (camera.height, camera.width, 2)
        pixels = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=-1).astype(float)
        flat = pixels.reshape(-1, 1, 2)
        rays, again = _rays_of(flat, camera)
        sources = rays * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        most = (camera.width, camera.height)
        is_seen = np.isfinite(again).all() and np.abs(again - flat).max() < _MAX_ERROR_PX
        if not is_seen or (np.abs(sources - (camera.cx, camera.cy)) > most).any():
            raise SourceError(
                "distortion must let every pixel of the image see somewhere in front of the camera, got "
                + " ".join(f"{value:g}" for value in camera.distortion)
            )
        beyond = max(-sources.min(), (sources - (camera.width - 1, camera.height - 1)).max(), 0.0)
        margin = int(np.ceil(beyond)) + _REACH
        pinhole = replace(
            camera.undistorted(),
            cx=camera.cx + margin,
            cy=camera.cy + margin,
            width=camera.width + 2 * margin,
            height=camera.height + 2 * margin,
        )
        return cls(pinhole, margin, (sources + margin).reshape(shape).astype(np.float32))

    def rows(self, top: int, bottom: int) -> tuple[int, int]:
        """Return which rows of the pinhole camera's image the rows from top to bottom are made from."""
        if self.sources is None:
            return top, bottom
        y = self.sources[top:bottom, :, 1]
        return max(int(y.min()) - _REACH, 0), min(int(y.max()) + _REACH + 1, self.pinhole.height)

    def bend(self, drawn: NDArray[np.float32], top: int, bottom: int) -> NDArray[np.float32]:
        """Return the rows from top to bottom, from those that ``rows`` names."""
        if self.sources is None:
            return drawn
        first, _ = self.rows(top, bottom)
        sources = self.sources[top:bottom] - np.array([0, first], np.float32)
        x, y = sources[..., 0], sources[..., 1]
        return np.asarray(cv2.remap(drawn, x, y, cv2.INTER_CUBIC), np.float32)


def _rays_of(
    pixels: NDArray[np.float64], camera: Intrinsics
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rays of unit depth, ``(N, 2)``, for pixels ``(N, 1, 2)``, and the pixels they are seen at."""
    K, coefficients = camera.K, np.array(camera.distortion)
    if camera.distortion_model == "equidistant":
        rays = cv2.fisheye.undistortPoints(pixels, K, coefficients, criteria=_SEARCH)
        again = cv2.fisheye.distortPoints(rays, K, coefficients)
    else:
        rays = cv2.undistortPoints(pixels, K, coefficients, criteria=_SEARCH)
        points, still = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=2), np.zeros(3)
        again, _ = cv2.projectPoints(points, still, still, K, coefficients)
    return np.asarray(rays, np.float64).reshape(-1, 2), np.asarray(again, np.float64)
