"""Places a new submap after a gap, again once its scale has settled, and when the camera is back from it.

Its pose and scale come from the camera's motion before and after the gap and its rotation meanwhile, see
``bridging``. The views of a start are close to each other, and the first adjustments change its scale; so the
submap is placed once more after a second, by the camera's path in that second. An older part that is in sight
again tells where the camera was in the end, see ``known_end``.
"""

from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, make_transform, rotation_angle_deg
from semcast.server.mapping.bridging import Bridge, bridge
from semcast.server.mapping.camera_motion import CameraMotion
from semcast.server.mapping.guessed_place import GuessedPlace
from semcast.server.mapping.known_end import place_by_end
from semcast.server.mapping.scene_depth import median_depth, usual_depth
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.start_geometry import Start
from semcast.server.mapping.visual_gyroscope import VisualGyroscope
from semcast.server.mapping.world_map import WorldMap

Array = NDArray[np.float64]

#: A part of the map is placed again this long after its start,
_SETTLED_NS = 1_000_000_000
#: but not later than this: a camera that stood since, or was elsewhere, has not gone on as before.
_LATEST_NS = 2_000_000_000
#: How far off it may be how the camera turned while it had no pose: radians, and share of the turn.
_TURN_SIGMA = (0.01, 0.03)


@dataclass(frozen=True)
class _Before:
    """What a submap was placed by.

    Attributes:
        motion: Of the camera before.
        last_ns: Time of the newest keyframe before.
        depth: Median depth before, map units.
        turned: Rotation of the camera since, see ``VisualGyroscope``.
        former: Number of the submap before.
        submap: That of the new one.
        start_ns: Time of the first view that told its scale.
    """

    motion: CameraMotion
    last_ns: int
    depth: float
    turned: list[tuple[int, Array]]
    former: int
    submap: int
    start_ns: int


class SubmapPlacement:
    """Tells where a submap is by how the camera moved since the one before.

    Args:
        camera: Pinhole.
        enough: Landmarks in sight, from which on their depth is worth something.
    """

    def __init__(self, camera: Intrinsics, enough: int) -> None:
        self._gyroscope = VisualGyroscope(camera)
        self._enough = enough
        self._before: _Before | None = None

    def note(self, sight: Sight, T_world_cam: Array | None, motion: CameraMotion, world: WorldMap) -> None:
        """Take a frame with its pose, or None without."""
        if T_world_cam is not None:
            self._gyroscope.begin(sight)
        elif world.keyframes:
            self._gyroscope.go_on(sight, motion, usual_depth(world, self._enough))

    def place(self, motion: CameraMotion, start: Start, grown: Start, world: WorldMap, submap: int) -> Bridge:
        """Pose and scale of a new submap and what they are worth, see ``bridging.bridge``.

        The submap before may have been placed by a guess too: the new one is off by both.
        """
        depth = usual_depth(world, self._enough)
        self._before = None
        if not world.keyframes or motion.predict(grown.keyframes[0].t_source_ns) is None:
            # The first part; or, after a restart of the server, one whose second will tell nothing either.
            return bridge(motion, start, grown, None, depth)
        newest, turned = world.keyframes[-1], self._gyroscope.turned.copy()
        last_ns, start_ns = newest.t_source_ns, start.keyframes[0].t_source_ns
        self._before = _Before(deepcopy(motion), last_ns, depth, turned, newest.submap, submap, start_ns)
        return _with_former(bridge(motion, start, grown, last_ns, depth, turned), world, newest.submap)

    def place_again(self, world: WorldMap, submap: int) -> tuple[float, Array, GuessedPlace] | None:
        """Similarity that moves a submap to where its first second says it is.

        Args:
            world: The map; its newest keyframe is of the submap.
            submap: The one that was placed last.

        Returns:
            ``(scale, T)`` with ``x_new = T @ (scale * x)`` and what that place is worth, once for each
            submap; None while it is too young, when it is too old, and when it has been joined with an older
            one.
        """
        before = self._before
        if before is None or before.submap != submap:
            return None
        age_ns = world.keyframes[-1].t_source_ns - before.start_ns
        if age_ns < _SETTLED_NS:
            return None
        self._before = None
        if age_ns > _LATEST_NS:
            return None
        mine = world.keyframes_of(submap)
        T_first_world = invert_transform(mine[0].T_world_cam)
        unit = float(np.median([median_depth(world, k) for k in mine]))
        if not np.isfinite(unit):
            return None
        keyframes = []
        for keyframe in mine:
            T_first_cam = T_first_world @ keyframe.T_world_cam
            T_first_cam[:3, 3] /= unit
            keyframes.append(replace(keyframe, T_world_cam=T_first_cam))
        none = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0)
        grown = Start(keyframes, *none)
        start = Start([k for k in keyframes if k.t_source_ns >= before.start_ns], *none)
        found = bridge(before.motion, start, grown, before.last_ns, before.depth, before.turned)
        found = _with_former(found, world, before.former)
        first_id, T_world_first = mine[0].frame_id, mine[0].T_world_cam
        return _moved(first_id, T_world_first, found.T_world_cam, found.scale / unit, found.covariance)

    def come_back(
        self, sight: Sight, T_world_cam: Array, submap: int, motion: CameraMotion, world: WorldMap
    ) -> tuple[float, Array, GuessedPlace] | None:
        """Similarity that moves the newest submap to where its end says it is.

        Args:
            sight: An image in which an older submap was recognised, shortly after the newest one was lost.
            T_world_cam: ``(4, 4)`` its pose there.
            submap: The older one, whose own place may be a guess.
            motion: Of the camera, by poses in the newest submap.
            world: The map.

        Returns:
            As ``place_again``; None where its place was not guessed, or where it is not known how the camera
            moved since.
        """
        guess = world.guesses.get(world.keyframes[-1].submap)
        depth = usual_depth(world, self._enough)
        t_ns = sight.frame.t_source_ns
        there = motion.whereabouts(t_ns, depth)
        if guess is None or there is None:
            return None
        self._gyroscope.go_on(sight, motion, depth)
        turned = self._gyroscope.turned
        if not turned or turned[-1][0] != t_ns:
            return None
        since_ns, R_last_now = turned[0][0], turned[-1][1]
        turn_rad = np.radians(rotation_angle_deg(R_last_now))
        T_world_led = there.turned_alike(make_transform(there.T_world_last[:3, :3] @ R_last_now, np.zeros(3)))
        gap_s = (t_ns - since_ns) * 1e-9
        variances = motion.bridge_variances(t_ns, gap_s)
        place_sigma = there.radius if variances is None else np.sqrt(variances[1])
        sigma = (_TURN_SIGMA[0] + _TURN_SIGMA[1] * turn_rad, float(place_sigma))
        T_world_first = world.poses[guess.frame_id]
        T_first_world = invert_transform(T_world_first)
        found = place_by_end(
            guess.covariance, T_first_world @ T_world_led, T_first_world @ T_world_cam, sigma, depth
        )
        if found is None:
            return None
        there_now = _with_former(
            Bridge(T_world_first @ found.T, found.scale, found.covariance), world, submap
        )
        return _moved(guess.frame_id, T_world_first, *there_now)


def _moved(
    frame_id: int, T_world_first: Array, T_world_first_new: Array, scale: float, covariance: Array | None
) -> tuple[float, Array, GuessedPlace]:
    """Similarity that takes a camera to its new pose and scales what is seen from there."""
    T_scaled_first = T_world_first.copy()
    T_scaled_first[:3, 3] *= scale
    T_new_old = T_world_first_new @ invert_transform(T_scaled_first)
    return scale, T_new_old, GuessedPlace(frame_id, covariance)


def _with_former(found: Bridge, world: WorldMap, former: int) -> Bridge:
    """Add what the place of the submap is worth from which the bridge leads."""
    guess = world.guesses.get(former)
    if guess is None or found.covariance is None:
        return found
    behind = guess.seen_from(invert_transform(world.poses[guess.frame_id]) @ found.T_world_cam)
    return found._replace(covariance=None if behind is None else found.covariance + behind)
