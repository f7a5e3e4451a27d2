"""Images of a rolling shutter as if all rows had been exposed at once.

Most cameras expose one row after the other. While they turn, each row is seen from another pose, and a pose
that is right for the middle row is wrong by pixels for the others. How points move from image to image tells
how far each row has moved by its time. The image is put right by that, and all that follows, from tracks to
adjustments, has one pose an image.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.geometry.features import to_grey
from semcast.server.mapping.sight import Sight, usable_rows
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.tracks import TrackTable

Array = NDArray[np.float64]
#: x and y of each pixel, ``(H, W)`` each.
Places = tuple[NDArray[np.float32], NDArray[np.float32]]

#: Tracks a movement is fitted to at least, and steps of reweighting (Huber).
_MIN_TRACKS, _ITERATIONS = 30, 6
#: Images further apart than this say little about how the camera moved during an exposure.
_MAX_STEP_S = 0.5
#: A hand shakes several times a second: from images further apart no trend of the movement is read.
_MAX_TREND_STEP_S = 0.06
#: Nothing is moved by more than this share of the image's height.
_MAX_SHARE = 0.2
#: How far the image is moved is computed at every so many pixels.
_GRID_PX = 16


@dataclass(frozen=True)
class ImageFlow:
    """How an image moves: as that of a plane does, which is exact for turning and about right for a scene.

    The quadratic flow of a plane under a rigid motion (Longuet-Higgins and Prazdny 1980).

    Attributes:
        camera: Pinhole.
        coefficients: ``(8,)``, in normalised coordinates and seconds.
    """

    camera: Intrinsics
    coefficients: Array

    def at(self, xy: Array) -> Array:
        """Return pixels per second ``(..., 2)`` at pixels ``(..., 2)``."""
        c, camera = self.coefficients, self.camera
        x, y = (xy[..., 0] - camera.cx) / camera.fx, (xy[..., 1] - camera.cy) / camera.fy
        u = c[0] + c[1] * x + c[2] * y + (c[6] * x + c[7] * y) * x
        v = c[3] + c[4] * x + c[5] * y + (c[6] * x + c[7] * y) * y
        return np.stack([camera.fx * u, camera.fy * v], axis=-1)

    @staticmethod
    def fitted(camera: Intrinsics, xy: Array, velocity_px_s: Array) -> "ImageFlow | None":
        """Fit to points ``(N, 2)`` and their velocities ``(N, 2)``, robustly; None where they are few."""
        count = len(xy)
        if count < _MIN_TRACKS:
            return None
        x, y = (xy[:, 0] - camera.cx) / camera.fx, (xy[:, 1] - camera.cy) / camera.fy
        one, none = np.ones(count), np.zeros(count)
        design = np.concatenate(
            [
                np.stack([one, x, y, none, none, none, x * x, x * y], axis=1),
                np.stack([none, none, none, one, x, y, x * y, y * y], axis=1),
            ]
        )
        target = np.concatenate([velocity_px_s[:, 0] / camera.fx, velocity_px_s[:, 1] / camera.fy])
        weight = np.ones(count)
        coefficients = np.zeros(8)
        for _ in range(_ITERATIONS):
            weighted = design * np.tile(weight, 2)[:, None]
            coefficients = np.linalg.solve(weighted.T @ design + 1e-9 * np.eye(8), weighted.T @ target)
            error = np.linalg.norm((target - design @ coefficients).reshape(2, count), axis=0)
            weight = 1.0 / np.maximum(error / (1.5 * np.median(error) + 1e-6), 1.0)
        return ImageFlow(camera, coefficients)


class RollingShutter:
    """Puts images and the tracks in them right, one after the other.

    Args:
        camera: Pinhole and the shutter's readout; with a global shutter nothing is done.
    """

    def __init__(self, camera: Intrinsics) -> None:
        self._camera = camera
        self._axis = int(camera.readout_from in ("top", "bottom"))
        last = max(1, (camera.width, camera.height)[self._axis] - 1)
        self._middle = 0.5 * last
        self._s_per_px = (
            1e-3 * camera.readout_ms / last * (1 if camera.readout_from in ("top", "left") else -1)
        )
        # Middles of cells, one cell more on each side: a resize puts samples there.
        x, y = (
            _GRID_PX * (np.arange(-1, -(-side // _GRID_PX) + 1) + 0.5) - 0.5
            for side in (camera.width, camera.height)
        )
        self._grid = np.stack(np.meshgrid(x, y), axis=-1)
        #: The movement at the newest image, that the image was put right by, and the mean towards the image.
        self._flow: ImageFlow | None = None
        self._applied: ImageFlow | None = None
        self._mean: ImageFlow | None = None
        self._t_ns: int | None = None
        self._step_s = 0.0
        self._has_begun = False

    @property
    def is_global(self) -> bool:
        """Whether all rows are exposed at once: there is nothing to do."""
        return self._s_per_px == 0.0

    def see(self, frame: DecodedFrame) -> Sight:
        """Return an image put right by the movement before it, for tracks to be followed in."""
        if not 0.0 < self._since_s(frame) < _MAX_STEP_S:
            self._flow = self._mean = None
        return self._sight(frame, with_colours=False)

    def settle(self, frame: DecodedFrame, sight: Sight, tracks: TrackTable) -> tuple[Sight, bool]:
        """Put an image and its tracks right by the movement towards it.

        Args:
            frame: As received.
            sight: What ``see`` made of it.
            tracks: After they were followed; their positions move.

        Returns:
            The image, and whether it is the first that was put right: points of images before can't be
            compared with those of later ones. That is said once: where points are so few that the movement is
            unknown now and then, a start from what there is comes before none.
        """
        if self.is_global:
            return sight, False
        step_s = self._since_s(frame)
        self._t_ns = frame.t_source_ns
        self._flow = self._measured(tracks, step_s)
        self._step_s = step_s
        if self._flow is None:
            return sight, False
        visible = tracks.visible
        tracks.move(visible, self._put_right(self.in_image(tracks.xy[visible])))
        sight = self._sight(frame, with_colours=True)
        tracks.replace_newest(sight)
        is_first, self._has_begun = not self._has_begun, True
        return sight, is_first

    def in_image(self, xy: Array) -> Array:
        """Return where points ``(..., 2)`` of the newest image, as put right, are in it as received."""
        if self._applied is None:
            return xy
        flow = self._applied.at(xy)
        # A point moves while the shutter runs towards it: the row it was met in is another one.
        closing = np.maximum(1.0 - self._s_per_px * flow[..., self._axis], 0.2)
        offset_s = self._s_per_px * (xy[..., self._axis] - self._middle) / closing
        return xy + self._bounded(flow * offset_s[..., None])

    def _put_right(self, xy: Array) -> Array:
        """Return where points ``(..., 2)`` of the received image go, by the newest movement."""
        assert self._flow is not None
        offset_s = self._s_per_px * (xy[..., self._axis] - self._middle)
        there = xy
        for _ in range(2):
            there = xy - self._bounded(self._flow.at(there) * offset_s[..., None])
        return there

    def _bounded(self, away: Array) -> Array:
        reach = _MAX_SHARE * self._camera.height
        return np.clip(away, -reach, reach)

    def _since_s(self, frame: DecodedFrame) -> float:
        return 0.0 if self._t_ns is None else (frame.t_source_ns - self._t_ns) * 1e-9

    def _measured(self, tracks: TrackTable, step_s: float) -> ImageFlow | None:
        """Return the movement at the newest image."""
        mean_before, self._mean = self._mean, None
        if not 0.0 < step_s < _MAX_STEP_S:
            return None
        rows = tracks.visible & (tracks.age > 1)
        way = tracks.velocity[rows]
        self._mean = ImageFlow.fitted(self._camera, tracks.xy[rows] - 0.5 * way, way / step_s)
        if self._mean is None or mean_before is None or step_s > _MAX_TREND_STEP_S:
            return self._mean
        # The mean is that of half a step ago.
        trend = (self._mean.coefficients - mean_before.coefficients) / (0.5 * (step_s + self._step_s))
        return ImageFlow(self._camera, self._mean.coefficients + 0.5 * step_s * trend)

    def _sight(self, frame: DecodedFrame, *, with_colours: bool) -> Sight:
        """Return an image put right by the newest movement that is known."""
        height, width = frame.image.shape[:2]
        usable = usable_rows(frame, height)
        self._applied = self._flow
        places = self._places((height, width))
        if places is None:
            return Sight(frame, to_grey(frame.image), usable)

        def map_taken(values: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
            return None if values is None else np.asarray(_taken(values, places), np.float32)

        image = np.asarray(_taken(frame.image, places), np.uint8) if with_colours else frame.image
        grey = to_grey(image) if with_colours else np.asarray(_taken(to_grey(frame.image), places), np.uint8)
        right = replace(
            frame,
            image=image,
            confidence=map_taken(frame.confidence),
            keypoint_confidence=map_taken(frame.keypoint_confidence),
        )
        if not usable.all():
            rows = np.clip(np.rint(places[1][:, [0, width // 2, width - 1]]), 0, height - 1).astype(np.intp)
            usable = np.asarray(usable[rows].all(axis=1))
        return Sight(right, grey, usable)

    def put_right(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the newest image ``(H, W, 3)``, given as received, as its tracks have it."""
        places = self._places((image.shape[0], image.shape[1]))
        return image if places is None else np.asarray(_taken(image, places), np.uint8)

    def _places(self, shape_hw: tuple[int, int]) -> Places | None:
        """Return where each pixel of the image as put right is as received; None where that is the same."""
        if self._applied is None or self.is_global:
            return None
        height, width = shape_hw
        away = (self.in_image(self._grid) - self._grid).astype(np.float32)
        fine = cv2.resize(away, None, fx=_GRID_PX, fy=_GRID_PX, interpolation=cv2.INTER_LINEAR)
        fine = fine[_GRID_PX : _GRID_PX + height, _GRID_PX : _GRID_PX + width]
        x = np.arange(width, dtype=np.float32) + fine[..., 0]
        y = np.arange(height, dtype=np.float32)[:, None] + fine[..., 1]
        return x, y


def _taken(values: NDArray, places: Places) -> NDArray:
    return cv2.remap(values, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
