"""How a camera without a pose turns, added up from image to image."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, make_transform, rotation_angle_deg
from semcast.server.mapping.camera_motion import CameraMotion
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.visual_gyroscope import VisualGyroscope

CAMERA = Intrinsics(fx=260, fy=260, cx=159.5, cy=119.5, width=320, height=240)
K = np.array([[260, 0, 159.5], [0, 260, 119.5], [0, 0, 1.0]])
FRAME_NS = 100_000_000
TURN = np.radians((0.0, 3.0, 0.0))
#: A wall at unit depth, of smooth patches.
PATCHES = np.random.default_rng(0).uniform(60, 190, (9, 21)).astype(np.float32)
WALL = cv2.resize(PATCHES, (1500, 640), interpolation=cv2.INTER_CUBIC)


def sight_at(frame, x=0.0, wall=WALL):
    """What a camera sees that turned a step with each frame, and went to the right by so much."""
    R_cam_wall = exp_so3(frame * TURN).T
    plane = R_cam_wall @ (np.eye(3) - np.outer((x, 0.0, 0.0), (0.0, 0.0, 1.0)))
    to_wall = np.array([[260, 0, 700], [0, 260, 319.5], [0, 0, 1.0]])
    grey = cv2.warpPerspective(wall, K @ plane @ np.linalg.inv(to_wall), (320, 240))
    grey = np.clip(grey, 0, 255).astype(np.uint8)
    image = np.repeat(grey[..., None], 3, axis=2)
    return Sight(DecodedFrame(frame, frame * FRAME_NS, image), grey, np.ones(240, bool))


def motion_of(speed):
    """Of a camera that goes to the right at a speed."""
    motion = CameraMotion(CAMERA)
    for k in range(3):
        T = make_transform(np.eye(3), (0.1 * speed * k, 0, 0))
        motion.observe(k, k * FRAME_NS, T, np.zeros((0, 3)))
    return motion


@pytest.mark.parametrize("speed", [0.0, 0.4])
def test_turns_add_up_while_the_camera_goes_on(speed):
    gyroscope, motion = VisualGyroscope(CAMERA), motion_of(4.0 * speed)
    gyroscope.go_on(sight_at(0), motion, 4.0)
    assert gyroscope.turned == [], "since when?"
    for k in range(9):
        sight = sight_at(k, 0.1 * speed * k)
        gyroscope.begin(sight) if k == 2 else gyroscope.go_on(sight, motion, 4.0)
    times_ns, R_last_then = zip(*gyroscope.turned, strict=True)
    assert times_ns == tuple(k * FRAME_NS for k in range(2, 9))
    for k, R in enumerate(R_last_then):
        assert rotation_angle_deg(R.T @ exp_so3(k * TURN)) < 0.1 + 0.3 * k, "and not two degrees each"


def test_after_another_view_nothing_more_is_known():
    gyroscope, motion = VisualGyroscope(CAMERA), motion_of(0.0)
    gyroscope.begin(sight_at(0))
    gyroscope.go_on(sight_at(1), motion, 1.0)
    assert len(gyroscope.turned) == 2
    for k in (2, 3):
        gyroscope.go_on(sight_at(k, wall=WALL[::-1, ::-1]), motion, 1.0)
        assert [t_ns for t_ns, _ in gyroscope.turned] == [0, FRAME_NS]
    gyroscope.begin(sight_at(4))
    assert [t_ns for t_ns, _ in gyroscope.turned] == [4 * FRAME_NS]


def test_a_turn_that_images_alone_do_not_reach_is_told_from_how_the_camera_turned_before():
    """Twelve degrees a step are a sixth of the image."""
    fine = np.random.default_rng(0).uniform(60, 190, (27, 63)).astype(np.float32)
    fine = cv2.resize(fine, WALL.shape[::-1], interpolation=cv2.INTER_CUBIC)
    fast = 4 * np.arange(5)
    motion = CameraMotion(CAMERA)
    for at, k in enumerate(fast[:2]):
        pose = make_transform(exp_so3(k * TURN), np.zeros(3))
        motion.observe(at, at * FRAME_NS, pose, np.zeros((0, 3)))
    gyroscope, alone = VisualGyroscope(CAMERA), VisualGyroscope(CAMERA)
    for at, k in enumerate(fast[1:], 1):
        sight = sight_at(int(k), wall=fine)
        sight = Sight(replace(sight.frame, t_source_ns=at * FRAME_NS), sight.grey, sight.usable)
        for one, moved in ((gyroscope, motion), (alone, motion_of(0.0))):
            one.begin(sight) if at == 1 else one.go_on(sight, moved, 1.0)
    assert rotation_angle_deg(gyroscope.turned[-1][1].T @ exp_so3(12 * TURN)) < 1.0
    assert len(alone.turned) < 4 or rotation_angle_deg(alone.turned[-1][1].T @ exp_so3(12 * TURN)) > 5.0


def test_what_is_no_use_to_a_bridge_is_not_kept():
    gyroscope, motion, rested = VisualGyroscope(CAMERA), motion_of(0.0), sight_at(0)
    gyroscope.begin(rested)
    for k in range(1, 32):
        assert len(gyroscope.turned) == k
        frame = replace(rested.frame, t_source_ns=k * FRAME_NS)
        gyroscope.go_on(Sight(frame, rested.grey, rested.usable), motion, 1.0)
    assert len(gyroscope.turned) == 31, "more than three seconds"
