"""Images of a rolling shutter as if all rows had been exposed at once.

Most cameras expose one row after the other. While they turn, each row is seen from another pose, and a pose
that is right for the middle row is wrong by pixels for the others. How points move from image to image tells
how far each row has moved by its time. The image is put right by that, and all that follows, from tracks to
adjustments, has one pose an image.
"""

import logging
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.geometry.finite_differences import slope_weights
from semcast.server.geometry.grey import to_grey
from semcast.server.geometry.whereabouts import SAME_S
from semcast.server.mapping.readout import Readout
from semcast.server.mapping.sight import Sight, usable_rows
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.tracks import TrackTable

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]
#: x and y of each pixel, ``(H, W)`` each.
Places = tuple[NDArray[np.float32], NDArray[np.float32]]

#: Tracks a movement is fitted to, at least.
_MIN_TRACKS = 30
#: Steps of reweighting (Huber).
_ITERATIONS = 6
#: Images further apart than this say little about how the camera moved during an exposure.
_MAX_STEP_S = 0.5
#: An image is read before the next one begins: one that comes sooner after it than this share of the readout
#: was not taken then.
_LEAST_READ_SHARE = 0.5
#: A hand shakes several times a second: from images further apart no trend of the movement is read.
_MAX_TREND_STEP_S = 0.06
#: Steps that the trend is read from. At 30 images a second two are wrong by 13 % about a hand that shakes at
#: 3 Hz, which they make seem faster, three by 6 % and four by 3 %.
_TREND_STEPS = 4
#: Nothing is moved by more than this share of the image's height.
_MAX_SHARE = 0.2
#: Images whose movement is kept: a minute and more of video.
_MAX_FLOWS = 2000
#: Distance of the pixels at which it is computed how far the image is moved.
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


class RowTimes:
    """When each pixel of an image is read, and where that puts it.

    Args:
        camera: Pinhole and the shutter's readout.
    """

    def __init__(self, camera: Intrinsics) -> None:
        self._axis = int(camera.readout_from in ("top", "bottom"))
        last = max(1, (camera.width, camera.height)[self._axis] - 1)
        self._middle = 0.5 * last
        self._s_per_px = (
            1e-3 * camera.readout_ms / last * (1 if camera.readout_from in ("top", "left") else -1)
        )
        self._reach_px = _MAX_SHARE * camera.height
        # Middles of cells, one cell more on each side: a resize puts samples there.
        x, y = (
            _GRID_PX * (np.arange(-1, -(-side // _GRID_PX) + 1) + 0.5) - 0.5
            for side in (camera.width, camera.height)
        )
        self._grid = np.stack(np.meshgrid(x, y), axis=-1)

    def as_received(self, flow: ImageFlow, xy: Array) -> Array:
        """Return where points ``(..., 2)`` of an image that was put right are in it as received."""
        moved = flow.at(xy)
        # A point moves while the shutter runs towards it: the row it was met in is another one.
        closing = np.maximum(1.0 - self._s_per_px * moved[..., self._axis], 0.2)
        offset_s = self._s_per_px * (xy[..., self._axis] - self._middle) / closing
        return xy + self._bounded(moved * offset_s[..., None])

    def put_right(self, flow: ImageFlow, xy: Array) -> Array:
        """Return where points ``(..., 2)`` of an image as received go."""
        offset_s = self._s_per_px * (xy[..., self._axis] - self._middle)
        there = xy
        for _ in range(2):
            there = xy - self._bounded(flow.at(there) * offset_s[..., None])
        return there

    def _bounded(self, away: Array) -> Array:
        return np.clip(away, -self._reach_px, self._reach_px)

    def places(self, flow: ImageFlow, shape_hw: tuple[int, int]) -> Places:
        """Return where each pixel of an image that is put right is as received."""
        height, width = shape_hw
        away = (self.as_received(flow, self._grid) - self._grid).astype(np.float32)
        fine = cv2.resize(away, None, fx=_GRID_PX, fy=_GRID_PX, interpolation=cv2.INTER_LINEAR)
        fine = fine[_GRID_PX : _GRID_PX + height, _GRID_PX : _GRID_PX + width]
        x = np.arange(width, dtype=np.float32) + fine[..., 0]
        y = np.arange(height, dtype=np.float32)[:, None] + fine[..., 1]
        return x, y


class RollingShutter:
    """Puts images and the tracks in them right, one after the other.

    Args:
        camera: Pinhole and the shutter's readout; with a global shutter nothing is done.
        wants_flows: Asked with every image whether its movement is to be kept with a global shutter too: it
            may turn out to be none.

    Attributes:
        camera: With the readout that is made up for.
    """

    def __init__(self, camera: Intrinsics, wants_flows: Callable[[], bool] = lambda: False) -> None:
        self._take(camera)
        self._wants_flows = wants_flows
        self._flows: OrderedDict[int, ImageFlow] = OrderedDict()
        self._first_id: int | None = None
        #: The movement at the newest image, and that the image was put right by.
        self._flow: ImageFlow | None = None
        self._applied: ImageFlow | None = None
        #: Times from image to image, the newest first, and the mean movements meanwhile.
        self._steps: deque[tuple[float, Array]] = deque(maxlen=_TREND_STEPS)
        self._t_ns: int | None = None
        self._waiting: Callable[[], None] | None = None
        self._has_begun = False

    def _take(self, camera: Intrinsics) -> None:
        self.camera, self._rows = camera, RowTimes(camera)

    def add(self, more: Readout) -> Intrinsics:
        """From the next image on, make up for a readout that is longer.

        Returns:
            The camera with what is new of its readout: what images so far still have to be put right for.
        """
        camera = self.camera
        readout = Readout.of(camera).with_more(more)
        logger.info("rolling shutter: %s, as adjustments have found; images are put right", readout)
        self._take(readout.put_on(camera))
        return more.put_on(camera)

    @property
    def is_global(self) -> bool:
        """Whether all rows are exposed at once: there is nothing to do."""
        return self.camera.readout_ms == 0.0

    def see(self, frame: DecodedFrame) -> Sight:
        """Return an image put right by the movement before it, for tracks to be followed in."""
        if not self._tells(self._since_s(frame)):
            self._flow = None
            self._steps.clear()
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
        step_s = self._since_s(frame)
        self._first_id = frame.frame_id if self._t_ns is None else self._first_id
        self._t_ns = frame.t_source_ns
        if self.is_global and not self._wants_flows():
            return sight, False
        rows = tracks.visible & (tracks.age > 1)
        self._waiting = partial(self._measure, frame.frame_id, step_s, tracks.xy[rows], tracks.velocity[rows])
        if self.is_global:
            return sight, False
        self.keep_up()
        if self._flow is None:
            return sight, False
        visible = tracks.visible
        tracks.move(visible, self._rows.put_right(self._flow, self.in_image(tracks.xy[visible])))
        sight = self._sight(frame, with_colours=True)
        tracks.replace_newest(sight)
        is_first, self._has_begun = not self._has_begun, True
        return sight, is_first

    def keep_up(self) -> None:
        """Find out how the newest image moved, which can wait where no image is put right by it."""
        waiting, self._waiting = self._waiting, None
        if waiting is not None:
            waiting()

    def in_image(self, xy: Array) -> Array:
        """Return where points ``(..., 2)`` of the newest image, as put right, are in it as received."""
        return xy if self._applied is None or self.is_global else self._rows.as_received(self._applied, xy)

    @property
    def flows(self) -> Mapping[int, ImageFlow]:
        """How the newest images moved, by frame id, as far as that is known."""
        return self._flows

    def _keep(self, frame_id: int, flow: ImageFlow) -> None:
        """Keep a movement; with the one of the next image, that of the first image too, by their trend."""
        if len(self._flows) == 1 and self._first_id is not None:
            after = next(iter(self._flows.values()))
            self._flows[self._first_id] = ImageFlow(flow.camera, 2.0 * after.coefficients - flow.coefficients)
        self._flows[frame_id] = flow
        if len(self._flows) > _MAX_FLOWS:
            self._flows.popitem(last=False)

    def _since_s(self, frame: DecodedFrame) -> float:
        return 0.0 if self._t_ns is None else (frame.t_source_ns - self._t_ns) * 1e-9

    def _tells(self, step_s: float) -> bool:
        """Whether two images so far apart tell how fast the later one moved."""
        return max(SAME_S, _LEAST_READ_SHARE * 1e-3 * self.camera.readout_ms) < step_s < _MAX_STEP_S

    def _measure(self, frame_id: int, step_s: float, xy: Array, way: Array) -> None:
        """Take the movement at the newest image from points ``(N, 2)`` and their ways ``(N, 2)`` there."""
        self._flow = self._measured(step_s, xy, way)
        if self._flow is not None:
            self._keep(frame_id, self._flow)
        elif frame_id != self._first_id:
            self._first_id = None  # what comes later tells no trend at the first image

    def _measured(self, step_s: float, xy: Array, way: Array) -> ImageFlow | None:
        mean = None
        if self._tells(step_s):
            mean = ImageFlow.fitted(self.camera, xy - 0.5 * way, way / step_s)
        if mean is None:
            self._steps.clear()
            return None
        if step_s > _MAX_TREND_STEP_S:
            self._steps.clear()
        self._steps.appendleft((step_s, mean.coefficients))
        return ImageFlow(self.camera, _at_the_end(self._steps))

    def _sight(self, frame: DecodedFrame, *, with_colours: bool) -> Sight:
        """Return an image put right by the newest movement that is known."""
        height, width = frame.image.shape[:2]
        usable = usable_rows(frame, height)
        self._applied = self._flow
        places = self._places((height, width))
        if places is None:
            return Sight(frame, to_grey(frame.image), usable)

        def map_right(values: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
            return None if values is None else np.asarray(taken_from(values, places), np.float32)

        image = np.asarray(taken_from(frame.image, places), np.uint8) if with_colours else frame.image
        grey = to_grey(image)
        if not with_colours:
            grey = np.asarray(taken_from(grey, places), np.uint8)
        right = replace(
            frame,
            image=image,
            confidence=map_right(frame.confidence),
            keypoint_confidence=map_right(frame.keypoint_confidence),
        )
        if not usable.all():
            rows = np.clip(np.rint(places[1][:, [0, width // 2, width - 1]]), 0, height - 1).astype(np.intp)
            usable = np.asarray(usable[rows].all(axis=1))
        return Sight(right, grey, usable)

    def put_right(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the newest image ``(H, W, 3)``, given as received, as its tracks have it."""
        places = self._places((image.shape[0], image.shape[1]))
        return image if places is None else np.asarray(taken_from(image, places), np.uint8)

    def _places(self, shape_hw: tuple[int, int]) -> Places | None:
        """Return where each pixel of the image as put right is as received; None where that is the same."""
        if self._applied is None or self.is_global:
            return None
        return self._rows.places(self._applied, shape_hw)


def taken_from(values: NDArray, places: Places) -> NDArray:
    """Return an image of other places of an image."""
    return cv2.remap(values, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _at_the_end(steps: Iterable[tuple[float, Array]]) -> Array:
    """Return a rate ``(N,)`` at the end of steps, the newest first, from how long and its mean in each."""
    lengths_s, means = zip(*steps, strict=True)
    since_s = np.concatenate([[0.0], -np.cumsum(lengths_s)])
    ways = np.multiply(lengths_s, np.transpose(means))
    behind = np.concatenate([np.zeros((len(ways), 1)), -np.cumsum(ways, axis=1)], axis=1)
    return np.asarray(behind @ slope_weights(since_s))
