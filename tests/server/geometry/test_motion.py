import numpy as np

from semcast.common.geometry import exp_se3, exp_so3, make_transform
from semcast.server.geometry.motion import ConstantVelocity

STEP = make_transform(exp_so3((0.0, 0.02, 0.01)), (0.1, 0.0, 0.3))
FRAME_NS = 100_000_000


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
    motion.reset()
    assert motion.predict(0) is None
