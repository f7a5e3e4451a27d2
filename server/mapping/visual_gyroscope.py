"""How a camera that has no pose turns, from image to image.

A camera is lost where there is little to hold on to: turning before a bare wall, in images that arrive in a
poor state. A whole image still tells how it turned since the one before, and so where a new part of the map
begins.
"""

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
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
        turned: ``(t_ns, R_last_then (3, 3))`` of the last frame with a pose and of each one since; empty
            where it is not known any more.
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
        if self._before is None or not self.turned:
            return
        before_ns, R_last_before = self.turned[-1]
        t_ns = sight.frame.t_source_ns
        way_depths = motion.way_in((t_ns - before_ns) * 1e-9) / depth
        R_now_before = turn_between(self._camera, self._before.grey, sight.grey, way_depths)
        self._before = sight
        if R_now_before is None or (t_ns - self.turned[0][0]) * 1e-9 > MAX_GAP_S:
            self.turned = []
        else:
            self.turned.append((t_ns, R_last_before @ R_now_before.T))
