import numpy as np
import pytest

from semcast.common.geometry import exp_se3, exp_so3, make_transform, rotation_angle_deg
from semcast.server.geometry.motion import ConstantVelocity

STEP = make_transform(exp_so3((0.0, 0.02, 0.01)), (0.1, 0.0, 0.3))
FRAME_NS = 100_000_000
SECOND_NS = 1_000_000_000


def test_steady_motion_goes_on():
    motion = ConstantVelocity()
    assert motion.predict(0) is None
    T = exp_se3(np.full(6, 0.2))
    for k in range(4):
        motion.observe(k * FRAME_NS, T)
        T = T @ STEP
    assert np.allclose(motion.predict(4 * FRAME_NS), T)


def test_a_gap_is_bridged_by_time():
    motion = ConstantVelocity()
    motion.observe(0, np.eye(4))
    motion.observe(FRAME_NS, make_transform(np.eye(3), (0, 0, 0.5)))
    assert np.allclose(motion.predict(4 * FRAME_NS)[:3, 3], (0, 0, 2.0))
    assert np.isclose(motion.speed_map_per_s, 5.0)


def arc(turn_deg_per_s, t_s, speed=10.0, num=2000):
    """Pose after driving forwards while turning about the vertical at a rate that is a function of time."""
    T, dt = np.eye(4), t_s / num
    for k in range(num):
        turn = np.radians(turn_deg_per_s((k + 0.5) * dt)) * dt
        T = T @ make_transform(exp_so3((0, turn, 0)), (0, 0, speed * dt))
    return T


@pytest.mark.parametrize(
    "rate_deg_per_s",
    [lambda t: 0.0, lambda t: 40.0, lambda t: 30.0 * np.clip(t - 0.1, 0.0, 1.0)],
    ids=["straight on", "an orbit", "into a bend"],
)
def test_a_gap_is_bridged_by_what_came_before_and_after(rate_deg_per_s):
    motion = ConstantVelocity()
    motion.observe(0, np.eye(4))
    motion.observe(FRAME_NS, arc(rate_deg_per_s, 0.1))
    after = arc(rate_deg_per_s, 1.1)
    later = np.linalg.inv(after) @ arc(rate_deg_per_s, 1.3)
    found = motion.bridge(11 * FRAME_NS, later, 0.2)
    angle_deg = rotation_angle_deg(found[:3, :3].T @ after[:3, :3])
    assert angle_deg < 2.0
    assert np.linalg.norm(found[:3, 3] - after[:3, 3]) < 0.25
    if rate_deg_per_s(1.1) != rate_deg_per_s(0.0):
        guess = motion.predict(11 * FRAME_NS)
        assert rotation_angle_deg(guess[:3, :3].T @ after[:3, :3]) > 10.0, "going on as before does not"


def test_turning_does_not_bend_the_way_in_the_frame_of_the_camera():
    motion = ConstantVelocity()
    for k in range(15):
        motion.observe(k * FRAME_NS, arc(lambda t: 40.0, 0.1 * k))
    np.testing.assert_allclose(motion.way_in(0.5), (0.0, 0.0, 5.0), atol=0.01)


def test_a_speed_is_that_of_a_second_not_of_one_noisy_step():
    motion = ConstantVelocity()
    for k in range(30):
        motion.observe(k * FRAME_NS, make_transform(np.eye(3), (0, 0, 0.5 * k + 0.1 * (k == 29))))
    assert motion.speed_map_per_s == pytest.approx(5.1, abs=0.02), "of the last step it would be 6"
    motion.correct(np.eye(4), scale=2.0)
    np.testing.assert_allclose(motion.way_in(0.5), (0, 0, 5.1), atol=0.02)
    assert np.isclose(motion.predict(30 * FRAME_NS)[2, 3], 1.2), "the next step is like the last"


def walked(speeds, interval_s=0.1):
    """A camera that goes straight on at a speed for each interval."""
    motion, z = ConstantVelocity(), 0.0
    motion.observe(0, np.eye(4))
    for k, speed in enumerate(speeds, start=1):
        z += speed * interval_s
        motion.observe(round(k * interval_s * 1e9), make_transform(np.eye(3), (0, 0, z)))
    return motion


def test_the_speed_of_a_robot_is_its_last_one_and_sure():
    speed, sigma = walked([2.0] * 60).speed_at(8 * SECOND_NS)
    assert speed == pytest.approx(2.0)
    assert sigma == pytest.approx(0.0, abs=1e-6)


def test_a_hand_that_has_slowed_down_goes_on_faster_and_nobody_knows_how_fast():
    """Seconds at 1, 4, 1, 4 ... and at last 1: a second apart they differ by a factor of 4, two by none."""
    motion = walked(np.repeat([1.0, 4.0, 1.0, 4.0, 1.0], 10))
    end_ns = 5 * SECOND_NS
    next_speed, sigma_next = motion.speed_at(end_ns)
    assert 1.3 < next_speed < 1.6, "between 1 and the mean of all, about 2"
    speed, sigma_later = motion.speed_at(end_ns + SECOND_NS)
    assert speed == next_speed
    assert sigma_next > 0.75 > 0.5 > sigma_later
    motion.correct(np.eye(4), scale=3.0)
    assert motion.speed_at(end_ns) == pytest.approx((3.0 * next_speed, sigma_next)), "in another unit"


def test_a_camera_that_once_stood_may_go_at_any_speed_but_not_at_none():
    speed, sigma = walked([0.0] * 20 + [2.0] * 20).speed_at(4 * SECOND_NS)
    assert 0.2 < speed < 2.0
    assert 1.0 < sigma < 4.0


@pytest.mark.parametrize("num_steps", [0, 1, 9, 25])
def test_a_motion_that_is_not_known_for_long_enough_tells_its_last_speed(num_steps):
    motion = walked([2.0] * num_steps)
    after_ns = num_steps * FRAME_NS + 2 * SECOND_NS
    assert motion.speed_at(after_ns) == pytest.approx((2.0 if num_steps else 0.0, 0.0))


def test_how_the_camera_turned_in_a_gap_is_better_known_than_guessed():
    """Neither before nor after it does the camera turn."""
    motion = ConstantVelocity()
    motion.observe(0, np.eye(4))
    motion.observe(FRAME_NS, arc(lambda t: 0.0, 0.1))
    rate_deg_per_s = 60.0
    after = arc(lambda t: rate_deg_per_s if t < 0.5 else 0.0, 1.0)
    turned = [(k * FRAME_NS, arc(lambda t: rate_deg_per_s, min(0.1 * (k - 1), 0.5))) for k in range(1, 12)]
    turned = [(t_ns, T[:3, :3]) for t_ns, T in turned]
    later = arc(lambda t: 0.0, 0.2)
    expected = arc(lambda t: 0.0, 0.1) @ after
    found = motion.bridge(11 * FRAME_NS, later, 0.2, turned)
    assert rotation_angle_deg(found[:3, :3].T @ expected[:3, :3]) < 0.1
    assert np.linalg.norm(found[:3, 3] - expected[:3, 3]) < 0.1
    as_guessed = motion.bridge(11 * FRAME_NS, later, 0.2)
    for of_another_gap in (turned[1:], turned[:-1], []):
        np.testing.assert_array_equal(motion.bridge(11 * FRAME_NS, later, 0.2, of_another_gap), as_guessed)
    assert rotation_angle_deg(as_guessed[:3, :3].T @ expected[:3, :3]) > 29.0


def test_a_gap_that_is_too_long_is_not_bridged():
    motion = ConstantVelocity()
    assert motion.bridge(FRAME_NS, STEP, 0.1) is None
    motion.observe(0, np.eye(4))
    motion.observe(FRAME_NS, STEP)
    assert motion.bridge(FRAME_NS, STEP, 0.1) is None, "no gap at all"
    assert motion.bridge(31 * FRAME_NS, STEP, 0.1) is not None
    assert motion.bridge(32 * FRAME_NS, STEP, 0.1) is None


def test_images_of_as_good_as_one_time_tell_no_motion():
    # A video with one stamp far ahead has times a nanosecond apart until the others have caught up.
    motion = ConstantVelocity()
    for k in range(5):
        motion.observe(k, make_transform(np.eye(3), (0.1 * k, 0.0, 0.0)))
    np.testing.assert_allclose(motion.predict(100_000_000)[:3, 3], (0.4, 0.0, 0.0))
    assert motion.speed_map_per_s == 0.0


def test_extrapolation_ends():
    motion = ConstantVelocity()
    motion.observe(0, np.eye(4))
    motion.observe(FRAME_NS, make_transform(np.eye(3), (0, 0, 0.1)))
    far, further = motion.predict(10**11), motion.predict(10**12)
    assert np.array_equal(far, further)
    motion.observe(10**11, np.eye(4))
    assert motion.speed_map_per_s == 0.0


def test_a_correction_keeps_the_motion_of_the_camera():
    motion = ConstantVelocity()
    motion.observe(0, np.eye(4))
    motion.observe(FRAME_NS, STEP)
    moved = exp_se3([0.5, 0, 0, 1, 2, 3])
    motion.correct(moved)
    assert np.allclose(motion.predict(2 * FRAME_NS), moved @ STEP)
    motion.correct(moved, scale=2.0)
    assert np.allclose((np.linalg.inv(moved) @ motion.predict(2 * FRAME_NS))[:3, 3], 2 * STEP[:3, 3])
