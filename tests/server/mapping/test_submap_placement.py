"""A new part of the map is placed when it begins, and again when a second of it is known."""

import cv2
import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_se3, invert_transform, make_transform
from semcast.server.mapping.camera_motion import CameraMotion
from semcast.server.mapping.guessed_place import GuessedPlace
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.start_geometry import Start
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.submap_placement import SubmapPlacement
from semcast.server.mapping.world_map import Keyframe, WorldMap

CAMERA = Intrinsics(fx=260, fy=260, cx=159.5, cy=119.5, width=320, height=240)
FRAME_NS = 100_000_000
IDS = np.arange(60)
NONE = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0)


def path(frame):
    """Of a camera that goes on at two units a second."""
    return make_transform(np.eye(3), (0.0, 0.0, 0.2 * frame))


def keyframe(frame, T_world_cam, submap):
    xy, ids = np.zeros((len(IDS), 2)), IDS + 100 * submap
    return Keyframe(frame, frame * FRAME_NS, T_world_cam, submap, ids, xy, np.ones(len(ids)))


def add(world, frames, T_of, submap, xyz):
    for frame in frames:
        world.add_keyframe(keyframe(frame, T_of(frame), submap))
    rgb, confidence = np.zeros((len(IDS), 3), np.uint8), np.ones(len(IDS))
    world.add_landmarks(IDS + 100 * submap, xyz, rgb, confidence, submap, frames[0])


@pytest.fixture
def world():
    found, rng = WorldMap(), np.random.default_rng(0)
    add(found, range(0, 10, 3), path, 0, rng.uniform((-2, -2, 5), (2, 2, 7), (len(IDS), 3)))
    return found


def laid(world, submap=1):
    """The placement of a part that began at frame 15, in a unit of a fifth of the world's."""
    motion = CameraMotion(CAMERA)
    for k in range(10):
        motion.observe(k, k * FRAME_NS, path(k), world.landmarks.xyz)
    begun = Start([keyframe(15 + k, make_transform(np.eye(3), (0, 0, 0.04 * k)), 0) for k in range(3)], *NONE)
    placement = SubmapPlacement(CAMERA, 20)
    T, scale, covariance = placement.place(motion, begun, begun, world, submap)
    motion.reset()
    world.guesses[submap] = GuessedPlace(15, covariance)
    np.testing.assert_allclose(T, path(15), atol=0.02)
    assert scale == pytest.approx(5.0, rel=0.03)
    return placement


@pytest.mark.parametrize("drift", [0.7, 1.3])
def test_a_part_whose_unit_changed_after_its_start_is_placed_again(world, drift):
    """The first adjustments have shrunk it, or stretched it, and turned it about its first view."""
    placement = laid(world)
    T_off = path(15) @ exp_se3([0.0, 0.1, 0.0, 0.0, 0.0, 0.0])

    def T_drifted(frame):
        T_first_cam = invert_transform(path(15)) @ path(frame)
        T_first_cam[:3, 3] *= drift
        return T_off @ T_first_cam

    in_front = np.random.default_rng(1).uniform((-2, -2, 7), (2, 2, 9), (len(IDS), 3))
    xyz = (drift * in_front) @ T_off[:3, :3].T + T_off[:3, 3]
    add(world, [15, 18, 21, 24], T_drifted, 1, xyz)
    assert placement.place_again(world, 1) is None, "it is too young"
    world.add_keyframe(keyframe(26, T_drifted(26), 1))
    assert placement.place_again(world, 2) is None, "that is another part"
    scale, T, guess = placement.place_again(world, 1)
    assert guess.frame_id == 15
    np.testing.assert_allclose(guess.covariance, world.guesses[1].covariance, rtol=0.2, atol=1e-6)
    assert scale == pytest.approx(1.0 / drift, rel=0.03)
    world.transform_submap(1, 1, scale, T)
    for frame in (15, 18, 21, 24, 26):
        np.testing.assert_allclose(world.poses[frame], path(frame), atol=0.07)
    assert placement.place_again(world, 1) is None, "once is enough"


@pytest.mark.parametrize(("frame", "stays"), [(26, False), (36, True)])
def test_a_camera_that_stood_for_a_while_has_not_gone_on_as_before(world, frame, stays):
    placement = laid(world)
    add(world, [15, 18, frame], path, 1, np.random.default_rng(1).uniform((-2, -2, 9), (2, 2, 11), (60, 3)))
    assert (placement.place_again(world, 1) is None) == stays
    world.add_keyframe(keyframe(frame + 1, path(frame + 1), 1))
    assert placement.place_again(world, 1) is None


def test_a_part_that_nothing_is_known_of_stays(world):
    placement = laid(world)
    for frame in (15, 18, 26):
        world.add_keyframe(keyframe(frame, path(frame), 1))
    assert placement.place_again(world, 1) is None, "how far away is what it sees?"


def test_a_part_that_nothing_led_to_is_not_placed_again(world):
    """The server was started again, and its camera sees nothing of the map so far."""
    begun = Start([keyframe(15 + k, make_transform(np.eye(3), (0, 0, 0.04 * k)), 0) for k in range(3)], *NONE)
    placement = SubmapPlacement(CAMERA, 20)
    T, scale, covariance = placement.place(CameraMotion(CAMERA), begun, begun, world, 1)
    assert covariance is None
    np.testing.assert_array_equal(T, np.eye(4))
    assert scale == 1.0
    in_front = np.random.default_rng(1).uniform((-2, -2, 7), (2, 2, 9), (len(IDS), 3))
    add(world, [15, 18, 26], path, 1, in_front)
    assert placement.place_again(world, 1) is None


def back_from(world, scale, *, seen=True, guessed=0.5, end=35):
    """Come back from a part in another unit into the older one, at a frame of the path it has gone on."""
    placement = SubmapPlacement(CAMERA, 20)
    if guessed is not None:
        covariance = np.diag(np.repeat((0.05, 0.1, guessed), (3, 3, 1)) ** 2)
        world.guesses[1] = GuessedPlace(15, covariance)
    in_front = np.random.default_rng(1).uniform((-2, -2, 7), (2, 2, 9), (len(IDS), 3))

    def T_in_part(frame):
        T_first_cam = invert_transform(path(15)) @ path(frame)
        T_first_cam[:3, 3] /= scale
        return path(15) @ T_first_cam

    add(world, range(15, 31, 3), T_in_part, 1, in_front / scale + path(15)[:3, 3])
    motion, wall = CameraMotion(CAMERA), np.random.default_rng(2).uniform(60, 190, (3, 4)).astype(np.float32)
    grey = cv2.resize(wall, (320, 240), interpolation=cv2.INTER_CUBIC).astype(np.uint8)
    for frame in range(15, 31):
        motion.observe(frame, frame * FRAME_NS, T_in_part(frame), world.landmarks.xyz)
    for frame in (30, end):
        image = np.repeat((grey if seen or frame == 30 else np.full_like(grey, 90))[..., None], 3, axis=2)
        sight = Sight(DecodedFrame(frame, frame * FRAME_NS, image), image[..., 0], np.ones(240, bool))
        if frame == 30:
            placement.note(sight, T_in_part(frame), motion, world)
    return placement.come_back(sight, path(end), 0, motion, world)


@pytest.mark.parametrize("scale", [0.6, 1.5])
def test_a_part_is_put_between_what_it_began_behind_and_where_the_camera_is_back(world, scale):
    found = back_from(world, scale)
    assert found[0] == pytest.approx(scale, rel=0.06)
    world.transform_submap(1, 1, *found[:2])
    for frame in (15, 21, 30):
        np.testing.assert_allclose(world.poses[frame], path(frame), atol=0.2)
    assert found[2].frame_id == 15
    assert found[2].covariance[6, 6] < 0.1**2, "it was half of it before"


def test_a_part_put_behind_a_guessed_one_is_off_by_that_guess_too(world):
    alone = back_from(world, 1.5)[2].covariance
    again = WorldMap()
    add(again, range(0, 10, 3), path, 0, np.random.default_rng(0).uniform((-2, -2, 5), (2, 2, 7), (60, 3)))
    again.guesses[0] = GuessedPlace(0, np.diag([0.0] * 6 + [0.2**2]))
    covariance = back_from(again, 1.5)[2].covariance
    # Of another unit, all that is at frame 15 is as much further away from frame 0.
    np.testing.assert_allclose(covariance[6, 6] - alone[6, 6], 0.2**2)
    np.testing.assert_allclose(covariance[5, 5] - alone[5, 5], (0.2 * 0.2 * 15) ** 2, rtol=0.2)


@pytest.mark.parametrize(
    "how",
    [{"guessed": None}, {"seen": False}, {"end": 70}],
    ids=["its place was not guessed", "no image tells how the camera turned", "long ago"],
)
def test_without_a_way_from_its_end_a_part_stays(world, how):
    assert back_from(world, 1.5, **how) is None


def test_a_first_map_is_where_it_is():
    placement, empty = SubmapPlacement(CAMERA, 20), WorldMap()
    begun = Start([keyframe(k, path(k), 0) for k in range(3)], *NONE)
    T, scale, _ = placement.place(CameraMotion(CAMERA), begun, begun, empty, 0)
    np.testing.assert_array_equal(T, np.eye(4))
    assert scale == 1.0
    add(empty, range(30), path, 0, np.full((len(IDS), 3), 9.0))
    assert placement.place_again(empty, 0) is None


@pytest.mark.parametrize("again", [False, True], ids=["at its start", "placed again"])
def test_a_part_behind_one_that_was_guessed_is_off_by_both_guesses(again):
    """What turned the part before by a little moves this one by as much times the way from there."""

    def worth(guess):
        world = WorldMap()
        add(
            world, range(0, 10, 3), path, 0, np.random.default_rng(0).uniform((-2, -2, 5), (2, 2, 7), (60, 3))
        )
        world.guesses = {} if guess is None else {0: guess}
        placement = laid(world)
        if not again:
            return world.guesses[1].covariance
        add(world, [15, 18, 26], path, 1, np.random.default_rng(1).uniform((-2, -2, 9), (2, 2, 11), (60, 3)))
        return placement.place_again(world, 1)[2].covariance

    added = worth(GuessedPlace(0, np.diag([0.0, 0.01, 0, 0, 0, 0, 0.02]))) - worth(None)
    at_3 = [0, 0.01, 0, 0.01 * 3.0**2, 0, 0.02 * 3.0**2, 0.02]
    np.testing.assert_allclose(np.diag(added), at_3, rtol=0.03, atol=1e-9)
    assert worth(GuessedPlace(0, None)) is None, "that one may be anywhere, and so may this one"
