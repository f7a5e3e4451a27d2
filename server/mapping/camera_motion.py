"""The camera's motion from pose to pose, and images that stay while the camera goes on.

A grabber that hangs and a video that repeats frames give the same image again under a new time. Its pose is
that of the image, not of the time: on a road, ten such frames are ten metres off. While it lasts, nobody can
tell such an image from a camera that stopped at once. The next one that differs tells: a camera that stood
sets off from where it stood, one that went on is where it would have got to by then.
"""

import logging
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, transform_points
from semcast.server.geometry.bunches import Bunches, in_bunches
from semcast.server.geometry.motion import MAX_EXTRAPOLATION_S, ConstantVelocity
from semcast.server.geometry.whereabouts import Whereabouts
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]

#: A camera stops at once when the image moves by less than this share of what was expected of it ...
_STILL_SHARE = 0.15
#: ... not only in the middle of its points: of a hand that turns one way while it goes the other, points at
#: one depth stay and the rest do not. This share of the points has moved by no more.
_STILL_QUANTILE = 0.9
#: And that was at least this many pixels in the middle: less is within the error of poses.
_LEAST_EXPECTED_PX = 2.0
#: It went on when the image has moved by this share of what it would have moved all the while,
_GONE_SHARE = 0.67
#: or by this many times what it moved from one frame to the next: nothing sets off three times as fast as it
#: came.
_GONE_STEPS = 3.0
#: And in the same direction: least cosine between the two motions in the image.
_SAME_DIRECTION = 0.5
#: After so few frames the motion is told from before the stay: a video that repeats every image would seem to
#: rest and set off twice as fast with each.
_SHORT_STAY = 2
#: Points must lie so far in front of the camera, as share of their usual depth.
_LEAST_DEPTH_SHARE = 0.05
#: Time over which a camera must rest to be called at rest.
_REST_NS = 1_000_000_000
#: How far the image may move in that time, as a share of its width: a hand that rests sways by less.
_REST_SHARE = 0.03
#: A frame comes after a gap if it comes after this many intervals of the frames before it.
_GAP_INTERVALS = 3.0
#: Where they come in bunches, and each after a long interval, it is so many of the longest of so many.
_NUM_INTERVALS = 24
#: Keyframes that tell the motion of a camera whose path was put right.
_NUM_MOTION = 4
_S_PER_NS = 1e-9

logger = logging.getLogger(__name__)


class CameraMotion:
    """Predicts poses from those before, and finds those whose image was not of their time.

    Args:
        camera: Pinhole.
    """

    def __init__(self, camera: Intrinsics) -> None:
        self._camera = camera
        #: Of the last frames that came: number and time.
        self._came: list[tuple[int, int]] = []
        self._has_told_old_images = False
        self.reset()

    def reset(self) -> None:
        """Forget the motion."""
        self._motion = ConstantVelocity()
        self._bunches = Bunches()
        self._moving: tuple[int, Array] | None = None
        self._moving_id = 0
        self._still: list[int] = []
        self._still_ns = 0
        self._has_gap = False
        self._recent: list[tuple[int, Array]] = []
        self._rests = False

    def begin_with(self, keyframes: Sequence[Keyframe], world: WorldMap) -> None:
        """Forget the motion for that of the newest keyframes of a path that was put right."""
        self.reset()
        for k in keyframes[-_NUM_MOTION:]:
            self.observe(k.frame_id, k.t_source_ns, k.T_world_cam, world.landmarks.xyz_of(k.ids))

    @property
    def rests(self) -> bool:
        """Whether the camera rested when it was seen last: what it saw goes out of sight by being hidden.

        One that stopped at once may have gone on, and so may one of which frames are missing since.
        """
        return self._rests and not self._still and not self._has_gap

    def speed_at(self, t_source_ns: int) -> tuple[float, float]:
        """As ``ConstantVelocity.speed_at``; while the camera stands, as before it stopped."""
        return self._motion.speed_at(t_source_ns)

    def correct(self, T_world_cam: Array, scale: float = 1.0) -> None:
        """Replace the last pose after the map has moved; the motion in the camera's frame stays."""
        self._motion.correct(T_world_cam, scale)
        if scale != 1.0:
            self._bunches.rescale(scale)
            self._recent = []  # poses in another unit: whether the camera rests has to show anew
        if self._moving is not None:
            self._moving = (self._moving[0], T_world_cam.copy())

    def predict(self, t_source_ns: int) -> Array | None:
        """``T_world_cam`` expected at a time, None without any pose: where the camera stands or got to."""
        if self._moving is None:
            return self._motion.predict(t_source_ns)
        if self._still:
            return self._moving[1].copy()
        return self._one_more_step() if self._bunches.mislead else self._motion.predict(t_source_ns)

    def predict_step(self) -> Array | None:
        """Where one more step like the last leads, None unless the newest frames came in bunches.

        By their times the camera would stand still in a bunch and be far off at the next, which it may have
        done or not. Once it is known that they mislead, ``predict`` tells this, and there is no other guess.
        """
        return None if self._bunches.mislead else self._step_in_bunch()

    def _step_in_bunch(self) -> Array | None:
        if self._still or not in_bunches([ns / num for ns, num in self._intervals()]):
            return None
        return self._one_more_step()

    def _one_more_step(self) -> Array | None:
        if self._moving is None or (step := self._bunches.last) is None:
            return None
        return np.asarray(self._moving[1] @ step)

    def predict_on(self, t_source_ns: int) -> Array | None:
        """Where a camera that seems to have stopped would be if it went on, None where it did not stop."""
        return self._motion.predict(t_source_ns) if self._still else None

    def whereabouts(self, t_source_ns: int, depth: float) -> Whereabouts | None:
        """As ``ConstantVelocity.whereabouts``; None while the camera stands, or seems to."""
        return None if self._still else self._motion.whereabouts(t_source_ns, depth)

    def jumps_to(self, t_source_ns: int, T_world_cam: Array) -> bool:
        """As ``ConstantVelocity.jumps_to``; nowhere where times mislead, or while the camera stands."""
        return not (self._still or self._bunches.mislead) and self._motion.jumps_to(t_source_ns, T_world_cam)

    def way_in(self, elapsed_s: float) -> Array:
        """Translation ``(3,)`` in the camera's frame that goes on for so long; none while it stands."""
        return np.zeros(3) if self._still else self._motion.way_in(elapsed_s)

    def turn_in(self, elapsed_s: float) -> Array:
        """Rotation ``(3, 3)`` in the camera's frame that goes on for so long; none while it stands."""
        return np.eye(3) if self._still else self._motion.turn_in(elapsed_s)

    def bridge(
        self, t_source_ns: int, T_after_later: Array, later_s: float, turned: Sequence[tuple[int, Array]] = ()
    ) -> Array | None:
        """As ``ConstantVelocity.bridge``; None while the camera stands."""
        return None if self._still else self._motion.bridge(t_source_ns, T_after_later, later_s, turned)

    def bridge_variances(self, t_source_ns: int, later_s: float) -> tuple[float, float] | None:
        """As ``ConstantVelocity.bridge_variances``."""
        return self._motion.bridge_variances(t_source_ns, later_s)

    def comes_after_gap(self, frame_id: int, t_source_ns: int) -> bool:
        """Note that a frame has come, and tell whether frames are missing between the last pose and it.

        Args:
            frame_id: Of the frame.
            t_source_ns: Its time. Much further from the one before than that was from its own, some
                are missing; where times mislead, much further than any of late.
        """
        if intervals := self._intervals():
            usual_ns, _ = max(intervals) if self._bunches.mislead else intervals[-1]
            # Of a source that gives two images one time, these tell no interval.
            self._has_gap |= t_source_ns - self._came[-1][1] > _GAP_INTERVALS * usual_ns > 0.0
        self._came = [*self._came[-_NUM_INTERVALS:], (frame_id, t_source_ns)]
        return self._has_gap

    def _intervals(self) -> list[tuple[int, int]]:
        """Nanoseconds from each of the last frames to the next, and how many frames on that is."""
        return [(now[1] - before[1], now[0] - before[0]) for before, now in pairwise(self._came)]

    def observe(
        self, frame_id: int, t_source_ns: int, T_world_cam: Array, xyz: Array, *, stands: bool = False
    ) -> list[int]:
        """Take the pose of a frame.

        Args:
            frame_id: Of the frame.
            t_source_ns: Its time.
            T_world_cam: Its pose.
            xyz: ``(N, 3)`` points of the map that are in sight.
            stands: Something passes in front of the camera, by which it is known to be at rest already.

        Returns:
            Earlier frames whose poses are of another time: their image was an older one.
        """
        self._has_gap = False
        self._note_rest(t_source_ns, T_world_cam, xyz)
        self._rests |= stands
        T_world_go = self._motion.predict(t_source_ns)
        if self._moving is None or T_world_go is None:
            self._go_on(frame_id, t_source_ns, T_world_cam)
            return []
        since_ns, T_world_moving = self._moving
        moved, expected = self._displacements(T_world_moving, (T_world_cam, T_world_go), xyz)
        (moved_px, most_px), (expected_px, most_expected_px) = _lengths(moved), _lengths(expected)
        if not self._still and expected_px < _LEAST_EXPECTED_PX:
            self._go_on(frame_id, t_source_ns, T_world_cam)
            return []
        # From here on, motions are counted in those from the frame before to this one.
        before_ns = self._still_ns if self._still else since_ns
        known_ns = min(t_source_ns - since_ns, round(MAX_EXTRAPOLATION_S / _S_PER_NS))
        steps = known_ns / max(1, t_source_ns - before_ns)
        still_px = _STILL_SHARE * most_expected_px / max(1.0, steps)
        if (T_world_step := self._step_in_bunch()) is not None:
            # In a bunch, what moves by as much as from the frame before to the last has not stopped.
            (step,) = self._displacements(T_world_moving, [T_world_step], xyz)
            still_px = min(still_px, _STILL_SHARE * _lengths(step)[1])
        if most_px < still_px:
            self._still.append(frame_id)
            self._still_ns = t_source_ns
            return []
        withdrawn: list[int] = []
        if self._still:
            step_px = expected_px / max(1.0, steps)
            gone = moved_px >= min(_GONE_SHARE * steps, _GONE_STEPS) * step_px
            if steps > 1.0 and gone and _cosine(moved, expected) >= _SAME_DIRECTION:
                withdrawn = self._still
            elif len(self._still) > _SHORT_STAY:
                self._motion.observe(self._still_ns, T_world_moving)
        self._go_on(frame_id, t_source_ns, T_world_cam)
        return self._told_of(withdrawn)

    def give_up(self) -> list[int]:
        """Let a camera that seemed to stop have gone on: what it saw is out of sight.

        Returns:
            Frames whose image was an older one, as ``observe`` does.
        """
        withdrawn, self._still = self._still, []
        return self._told_of(withdrawn)

    def _told_of(self, frame_ids: list[int]) -> list[int]:
        """Return frames that show an older image, the first of which is told."""
        if frame_ids and not self._has_told_old_images:
            self._has_told_old_images = True
            logger.warning(
                "frame %d shows what an earlier one showed, though the camera went on (a video that repeats "
                "frames, or a camera that hangs): such frames get no pose in the results; told once",
                frame_ids[0],
            )
        return frame_ids

    def _note_rest(self, t_source_ns: int, T_world_cam: Array, xyz: Array) -> None:
        """Compare with the pose of a while ago; none is remembered that is older than need be."""
        self._recent.append((t_source_ns, T_world_cam.copy()))
        while len(self._recent) > 2 and t_source_ns - self._recent[1][0] >= _REST_NS:
            del self._recent[0]
        since_ns, T_world_then = self._recent[0]
        moved = self._displacements(T_world_then, [T_world_cam], xyz)[0]
        is_near = _lengths(moved)[0] <= _REST_SHARE * self._camera.width
        # A camera that turned right round has no point in front of it both then and now.
        self._rests = t_source_ns - since_ns >= _REST_NS and len(moved) > 0 and is_near

    def _go_on(self, frame_id: int, t_source_ns: int, T_world_cam: Array) -> None:
        if self._moving is not None and not self._still:
            before_ns, T_world_before = self._moving
            T_before_now = invert_transform(T_world_before) @ T_world_cam
            self._bunches.note(
                (t_source_ns - before_ns) * _S_PER_NS, T_before_now, frame_id - self._moving_id
            )
            self._motion.times_mislead = self._bunches.mislead
        self._motion.observe(t_source_ns, T_world_cam)
        self._moving = (t_source_ns, T_world_cam.copy())
        self._moving_id = frame_id
        self._still = []

    def _displacements(self, T_world_from: Array, to: Sequence[Array], xyz: Array) -> list[Array]:
        """How points move in the image from one pose to others, ``(M, 2)`` each: of those in front in all."""
        in_cam = [transform_points(invert_transform(T), xyz) for T in (T_world_from, *to)]
        depth = np.median(in_cam[0][:, 2]) if len(xyz) else 0.0
        front = np.all([p[:, 2] > _LEAST_DEPTH_SHARE * depth for p in in_cam], axis=0) & (depth > 0.0)
        pixels = [self._camera.project(p[front]) for p in in_cam]
        return [p - pixels[0] for p in pixels[1:]]


def _lengths(motion: Array) -> tuple[float, float]:
    """Median and ``_STILL_QUANTILE`` of the lengths of ``motion (M, 2)`` in pixels, 0 without any."""
    if len(motion) == 0:
        return 0.0, 0.0
    median, most = np.quantile(np.linalg.norm(motion, axis=1), (0.5, _STILL_QUANTILE))
    return float(median), float(most)


def _cosine(a: Array, b: Array) -> float:
    return float((a * b).sum() / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-12))
