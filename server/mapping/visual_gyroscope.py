"""How a camera that has no pose turns, from image to image.

A camera is lost where there is little to hold on to: turning before a bare wall, in images that arrive in a
poor state. A whole image still tells how it turned since the one before, and so where a new part of the map
begins.
"""

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, log_so3
from semcast.server.geometry.motion import MAX_GAP_S
from semcast.server.geometry.turning import turn_between
from semcast.server.mapping.camera_motion import CameraMotion
from semcast.server.mapping.sight import Sight

Array = NDArray[np.float64]


class VisualGyroscope:
    """Adds up turns since the last pose.

    Args:
        camera: Pinhole.

    Attributes:
        turned: ``(t_ns, R_last_then (3, 3))`` of the last frame with a pose and of each one since, for as
            long as it is known; empty before the first pose.
    """

    def __init__(self, camera: Intrinsics) -> None:
        self._camera = camera
        self._before: Sight | None = None
        self.turned: list[tuple[int, Array]] = []

    def begin(self, sight: Sight) -> None:
        """Take a frame that has a pose."""
        self._before = sight
        self.turned = [(sight.frame.t_source_ns, np.eye(3))]

    def go_on(self, sight: Sight, motion: CameraMotion, depth: float) -> None:
        """Take a frame that has none.

        Args:
            sight: The frame.
            motion: Of the camera, which is taken to go on: what moving does to an image is no turn.
            depth: How far things are, in the map's unit.
        """
        if self._before is None:
            return
        before_ns, R_last_before = self.turned[-1]
        t_ns = sight.frame.t_source_ns
        way_depths = motion.way_in((t_ns - before_ns) * 1e-9) / depth
        R_now_before = turn_between(
            self._camera, self._before.grey, sight.grey, way_depths, self._expected(t_ns, motion).T
        )
        if R_now_before is None or (t_ns - self.turned[0][0]) * 1e-9 > MAX_GAP_S:
            self._before = None
        else:
            self._before = sight
            self.turned.append((t_ns, R_last_before @ R_now_before.T))

    def _expected(self, t_ns: int, motion: CameraMotion) -> Array:
        """``R_before_now (3, 3)`` of a camera that turns on: as in the last step, at first by its poses."""
        before_ns, R_last_before = self.turned[-1]
        if len(self.turned) == 1:
            return motion.turn_in((t_ns - before_ns) * 1e-9)
        earlier_ns, R_last_earlier = self.turned[-2]
        share = (t_ns - before_ns) / max(1, before_ns - earlier_ns)
        return exp_so3(share * log_so3(R_last_earlier.T @ R_last_before))
