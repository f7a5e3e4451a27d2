"""Watches a growing map for signs of a rolling shutter that nobody told of, and of a wrong lens."""

import logging
from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import MAX_READOUT_MS, Intrinsics
from semcast.server.geometry.whereabouts import SAME_S
from semcast.server.mapping.bundle_problem import BundleProblem, BundleResult, ViewMotion
from semcast.server.mapping.lens_doubt import lens_doubt
from semcast.server.mapping.readout import Axis, Readout, body_velocity, fit_readout
from semcast.server.mapping.residual_patterns import LEAST_EXPLAINED, LEAST_SIGMAS, PatternEvidence
from semcast.server.mapping.world_map import WorldMap

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

#: Frames whose times are remembered: a minute and more of video.
_MAX_FRAMES = 2000
#: Frames further apart than this don't tell how the camera moved in between.
_MAX_STEP_S = 0.25
#: Frames before and after, by which the velocity is found. With one, that of a hand that shakes at 4 Hz would
#: seem smaller by 11 % at 30 images a second, and the readout longer; with two, by 1.5 %.
_REACH = 2
#: New keyframes from one look to the next, that each counts about once.
_INTERVAL = 8
#: Readout from which on a shutter is called rolling: 2.6 ms of a phone change its path's error by less than a
#: tenth.
_LEAST_MS = 4.0
#: Change of a readout that was found before, at least.
_LEAST_CHANGE_MS = 1.0
#: Share of the squared residuals that a change of what was found must explain: whether the shutter rolls is
#: then no question any more.
_LEAST_EXPLAINED_MORE = 0.002
#: From this many keyframes on, an estimate is the last one if it is sure,
_ENOUGH_VIEWS = 24
#: which is a standard deviation below this.
_SURE_MS = 1.0
#: After this many there is none: a camera that hardly turns does not tell, and it matters little.
_MOST_VIEWS = 170
#: Keyframes from which on the lens of the calibration may be called wrong.
_LENS_VIEWS = 16


class ReadoutWatch:
    """Collects what adjustments say about the readout, until it is known.

    Args:
        camera: With the readout it is said to have; its distortion, if any, is what images were freed of.
        is_wanted: Whether to watch at all.
    """

    def __init__(self, camera: Intrinsics, is_wanted: bool) -> None:
        self._camera = camera
        self._is_done = not is_wanted
        self._axis: Axis | None = None
        self._evidence = PatternEvidence()
        self._found: Readout | None = None
        self._lens_doubt: str | None = None
        self._lens_is_told = False
        self.forget_frames()

    @property
    def is_on(self) -> bool:
        """Whether the readout may still change."""
        return not self._is_done

    def forget_frames(self) -> None:
        """Frames to come are of another map."""
        self._frames: deque[tuple[int, int]] = deque(maxlen=_MAX_FRAMES)
        self._newest_id = -1

    def note(self, frame_id: int, t_source_ns: int) -> None:
        """A frame has got a pose."""
        self._frames.append((frame_id, t_source_ns))

    def _velocities(self, world: WorldMap, frame_ids: Sequence[int]) -> Array:
        """Return ``(N, 6)`` velocities of the camera at frames, see ``ViewMotion``; NaN where unknown."""
        row = {frame_id: k for k, (frame_id, _) in enumerate(self._frames)}
        velocity = np.full((len(frame_ids), 6), np.nan)
        for k, frame_id in enumerate(frame_ids):
            T_world_cam = world.pose_of_frame(frame_id)
            if T_world_cam is not None and (at := row.get(frame_id)) is not None:
                around = [self._around(world, at, way) for way in (-1, 1)]
                if all(around):
                    since_s, poses = zip(*around[0], *around[1], strict=True)
                    velocity[k] = body_velocity(T_world_cam, np.array(poses), np.array(since_s))
        return velocity

    def _around(self, world: WorldMap, at: int, way: int) -> list[tuple[float, Array]]:
        """Return the next frames before or after a row's, as far as known: seconds since its, and poses."""
        found: list[tuple[float, Array]] = []
        last_ns = at_ns = self._frames[at][1]
        for k in range(at + way, at + way * (_REACH + 1), way):
            if not 0 <= k < len(self._frames):
                break
            frame_id, t_ns = self._frames[k]
            T_world_cam = world.pose_of_frame(frame_id)
            if T_world_cam is None or not SAME_S * 1e9 < way * (t_ns - last_ns) <= _MAX_STEP_S * 1e9:
                break
            found.append(((t_ns - at_ns) * 1e-9, T_world_cam))
            last_ns = t_ns
        return found

    def motion(self, world: WorldMap, problem: BundleProblem) -> ViewMotion | None:
        """Return how a window's views move, when it is time for another look; else None."""
        if self._is_done or int((problem.keyframe_ids > self._newest_id).sum()) < _INTERVAL:
            return None
        self._newest_id = int(problem.keyframe_ids[-1])
        velocity = self._velocities(world, problem.keyframe_ids.tolist())
        return ViewMotion((self._camera.width, self._camera.height), velocity, self._camera.distortion)

    def take(self, result: BundleResult) -> None:
        """Take what an adjustment has told."""
        if result.pattern_products is None or self._is_done or self._found is not None:
            return
        self._evidence.note(result)
        self._look_at_lens()
        fit = fit_readout(self._evidence.views, self._axis)
        if fit is None:
            return
        num_views, sigma_ms = len(self._evidence), fit.sigma_ms * self._evidence.sigma_factor
        logger.debug(
            "readout by %d views: %s, sigma %.2f ms, explains %.4f",
            num_views,
            fit.readout,
            sigma_ms,
            fit.explained,
        )
        is_first = self._axis is None
        least_ms = _LEAST_MS if is_first else _LEAST_CHANGE_MS
        least_explained = LEAST_EXPLAINED if is_first else _LEAST_EXPLAINED_MORE
        is_sure = fit.readout.ms >= LEAST_SIGMAS * sigma_ms and fit.explained >= least_explained
        # An object in the middle of the image is read in no time: what its corners do wrong would take a
        # readout longer than any camera's, and images put right for that would be spoilt.
        if is_sure and least_ms <= fit.readout.ms <= MAX_READOUT_MS:
            self._found, self._axis, self._evidence = fit.readout, fit.readout.axis, PatternEvidence()
            self._lens_doubt = None  # of images that have yet to be put right
        else:
            is_known = num_views >= _ENOUGH_VIEWS and sigma_ms <= _SURE_MS
            self._is_done = is_known or num_views >= _MOST_VIEWS
        if self._is_done:
            self.conclude()

    def _look_at_lens(self) -> None:
        """Say once if the lens is clearly another one, at two looks in a row.

        The first views of a room with bare walls spoke for a focal length 19 % off, by six standard
        deviations; with eight more, the right one was found.
        """
        if self._lens_is_told or len(self._evidence) < _LENS_VIEWS:
            return
        before = self._lens_doubt
        self._lens_doubt = lens_doubt(self._evidence.views, self._evidence.sigma_factor, self._camera)
        if before is not None:
            self.conclude()

    def conclude(self) -> None:
        """Say of the lens what the last look left in doubt, if there is no other to come."""
        if self._lens_doubt is not None and not self._lens_is_told:
            self._lens_is_told = True
            logger.warning("%s, by what is seen: semcast lens measures it", self._lens_doubt)

    def take_found(self) -> Readout | None:
        """Return, once, the readout to be added to what images are put right for; views to come have it."""
        found, self._found = self._found, None
        return found
