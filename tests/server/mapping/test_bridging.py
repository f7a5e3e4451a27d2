"""Where a submap begins that the camera makes after it was lost."""

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, make_transform
from semcast.server.mapping.bridging import bridge
from semcast.server.mapping.camera_motion import CameraMotion
from semcast.server.mapping.start_geometry import Start
from semcast.server.mapping.world_map import Keyframe

CAMERA = Intrinsics(fx=260, fy=260, cx=159.5, cy=119.5, width=320, height=240)
FRAME_NS = 100_000_000
POINTS = np.random.default_rng(0).uniform((-4, -3, 6), (4, 3, 12), (200, 3))


def moved(speed=2.0, num=3):
    """A camera that went straight on for ``num`` frames."""
    motion = CameraMotion(CAMERA)
    for k in range(num):
        motion.observe(k, k * FRAME_NS, make_transform(np.eye(3), (0, 0, 0.1 * speed * k)), POINTS)
    return motion


def start_at(first, num=3, turn_deg=0.0, step=0.05):
    """Keyframes of a new submap, one per frame, that turn and go on by so much from one to the next."""
    none = np.zeros(0, np.int64)
    step = make_transform(exp_so3((0, np.radians(turn_deg), 0)), (0, 0, step))
    keyframes = [
        Keyframe(
            *(first + k, (first + k) * FRAME_NS, np.linalg.matrix_power(step, k), 1),
            *(none, np.zeros((0, 2)), np.zeros(0)),
        )
        for k in range(num)
    ]
    return Start(keyframes, none, np.zeros((0, 3)), np.zeros(0))


def test_speed_tells_the_unit_and_how_far_the_camera_got():
    start = start_at(12)
    T, scale, _ = bridge(moved(), start, start, 2 * FRAME_NS, 4.0)
    assert np.isclose(scale, 0.2 / 0.05)
    np.testing.assert_allclose(T, make_transform(np.eye(3), (0, 0, 0.4 + 2.0)), atol=1e-9)


@pytest.mark.parametrize(
    ("speed", "by_depth"),
    [
        (8.0, 4.0 / (4.0 + 1.0 / (0.03**2 + 0.03**2))),  # a depth a second
        (0.9, 4.0 / (4.0 + 1.0 / (0.03**2 + (0.03 / 0.1125) ** 2))),
    ],
)
def test_the_slower_a_camera_was_the_more_its_surroundings_tell_the_unit(speed, by_depth):
    start = start_at(12, step=0.1 * speed / 4.0)
    _, scale, _ = bridge(moved(speed), start, start, 2 * FRAME_NS, 8.0)
    assert np.log2(scale / 4.0) == pytest.approx(by_depth), "4 by the speed, twice that by the depth"


def test_of_a_camera_that_was_fast_and_slow_by_turns_the_surroundings_tell_the_unit():
    motion, z = CameraMotion(CAMERA), 0.0
    for k in range(80):
        z += 0.1 * (16.0 if k // 10 % 2 else 4.0)
        motion.observe(k, k * FRAME_NS, make_transform(np.eye(3), (0, 0, z)), POINTS)
    start = start_at(99, step=0.4)
    steady, unsteady = (bridge(m, start, start, 79 * FRAME_NS, 8.0)[1] for m in (moved(16.0, 80), motion))
    assert steady == pytest.approx(4.0, rel=0.01), "by a speed that was always 16"
    assert unsteady > 6.0, "by depth it is 8"


def test_half_of_a_bend_was_driven_out_of_sight():
    start = start_at(12, turn_deg=4.0)
    T, _, _ = bridge(moved(), start, start, 2 * FRAME_NS, 4.0)
    turned_deg = np.degrees(np.arctan2(T[0, 2], T[2, 2]))
    assert turned_deg == pytest.approx(20.0, abs=0.5), "from 0 to 40 degrees per second, in a second"
    assert T[0, 3] > 0.1
    np.testing.assert_allclose(np.linalg.norm(T[:3, 3] - (0, 0, 0.4)), 2.0, atol=0.03)


def test_images_of_the_gap_tell_the_turn_up_to_where_the_submap_begins():
    start = start_at(12)
    turned = [(k * FRAME_NS, exp_so3((0, np.radians(4.0 * (k - 2)), 0))) for k in range(2, 15)]
    T, _, _ = bridge(moved(), start, start, 2 * FRAME_NS, 4.0, turned)
    assert np.degrees(np.arctan2(T[0, 2], T[2, 2])) == pytest.approx(40.0, abs=1e-6)


def test_what_is_seen_of_the_time_before_the_start_is_where_it_begins():
    start, grown = start_at(14), start_at(12, num=5)
    T, scale, _ = bridge(moved(), start, grown, 2 * FRAME_NS, 4.0)
    np.testing.assert_allclose(T[:3, 3], (0, 0, 2.4), atol=1e-9)
    assert np.isclose(scale, 4.0)


def test_two_images_of_one_time_tell_no_speed():
    start = start_at(12, num=4)
    for keyframe, frames_later in zip(start.keyframes, (0, 0, 6, 7), strict=True):
        keyframe.t_source_ns = (12 + frames_later) * FRAME_NS
    T, scale, _ = bridge(moved(), start, start, 2 * FRAME_NS, 1.4 / 0.15)
    assert np.isclose(scale, 1.4 / 0.15)
    later_per_s = 0.1 * scale / 0.6
    np.testing.assert_allclose(T[:3, 3], (0, 0, 0.4 + 0.5 * (2.0 + later_per_s)), atol=1e-9)


@pytest.mark.parametrize(
    ("motion", "first", "step"),
    [
        (moved(speed=0.0), 12, 0.05),
        (moved(), 60, 0.05),
        (moved(), 12, 0.0),
        (moved(), 12, 0.001),
    ],
    ids=["the camera stood", "too long ago", "it stands now", "the unit would be absurd"],
)
def test_else_things_are_as_far_away_as_they_were(motion, first, step):
    start = start_at(first, step=step)
    T, scale, covariance = bridge(motion, start, start, 2 * FRAME_NS, 8.0)
    assert scale == 8.0
    assert covariance is None, "the camera may be anywhere"
    np.testing.assert_array_equal(T, motion.predict(first * FRAME_NS))


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_images_tell_the_turn_of_a_camera_whose_speed_tells_no_unit(speed):
    """It turned round on the spot, or the start is an absurd one: its place is known, and not its unit."""
    turned = [(k * FRAME_NS, exp_so3((0, np.radians(9.0 * (k - 19)), 0))) for k in range(19, 24)]
    start = start_at(23, step=0.0001)
    motion = moved(speed, num=20)
    found = bridge(motion, start, start, 19 * FRAME_NS, 8.0, turned)
    assert found.scale == 8.0
    assert np.degrees(np.arctan2(found.T_world_cam[0, 2], found.T_world_cam[2, 2])) == pytest.approx(36.0)
    np.testing.assert_allclose(
        found.T_world_cam[:3, 3], motion.predict(19 * FRAME_NS)[:3, 3], atol=0.005 + 0.25 * speed
    )
    assert found.covariance[6, 6] == pytest.approx(0.25), "by the depth alone"
    blind = bridge(motion, start, start, 19 * FRAME_NS, 8.0, turned[:-1])
    assert blind.covariance is None, "what images tell ends before the part begins"
    for keyframe in start.keyframes:
        keyframe.t_source_ns = 23 * FRAME_NS
    at_once = bridge(motion, start, start, 19 * FRAME_NS, 8.0, turned)
    assert at_once.covariance is None, "nothing came after it by which to tell its speed"


def test_a_first_map_begins_at_the_origin():
    start = start_at(0)
    T, scale, covariance = bridge(CameraMotion(CAMERA), start, start, None, 1.0)
    assert covariance is None
    np.testing.assert_array_equal(T, np.eye(4))
    assert scale == 1.0


def test_what_a_steady_camera_is_guessed_by_is_off_in_speed_alone():
    """At a depth a second, the scale is off by 3 % twice over, and that is half of the way as well."""
    start = start_at(32, step=0.2)
    found = bridge(moved(8.0, num=22), start, start, 21 * FRAME_NS, 8.0)
    scale_variance = 1.0 / (4.0 + 1.0 / (0.03**2 + 0.03**2))
    at_scale = np.array([0.0, 0, 0, 0, 0, 0.5 * 1.1 * 2.0 * found.scale, 1.0])
    np.testing.assert_allclose(found.covariance, scale_variance * np.outer(at_scale, at_scale), atol=1e-9)


def test_what_an_unsteady_camera_is_guessed_by_is_off_in_turn_and_place():
    motion, T, rng = CameraMotion(CAMERA), np.eye(4), np.random.default_rng(0)
    for k in range(40):
        motion.observe(k, k * FRAME_NS, T, POINTS)
        T = T @ make_transform(exp_so3(rng.normal(0, 0.02, 3)), rng.normal((0, 0, 0.8), 0.1))
    start = start_at(49, step=0.2)
    sd = np.sqrt(np.diag(bridge(motion, start, start, 39 * FRAME_NS, 8.0).covariance))
    turn_var, place_var = motion.bridge_variances(49 * FRAME_NS, 0.2)
    np.testing.assert_allclose(sd[:3], np.sqrt(turn_var))
    np.testing.assert_allclose(sd[3:5], np.sqrt(place_var), rtol=0.1)
    assert sd[5] > 1.1 * sd[4], "ahead, the unit adds to it"


def test_of_a_past_that_is_too_short_nothing_is_told():
    start = start_at(12)
    assert bridge(moved(num=3), start, start, 2 * FRAME_NS, 4.0).covariance is None
