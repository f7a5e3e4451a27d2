"""A rolling shutter that nobody told of is found while the map grows, and made up for."""

import functools
import logging
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import shaken_views
from drawn_boards import CAMERA, ate_percent, make, render

from semcast.common.geometry import exp_se3, exp_so3, make_transform
from semcast.server.mapping.keyframe_images import KeyframeImages, SeenFrom
from semcast.server.mapping.late_readout import put_map_right
from semcast.server.mapping.readout import lean
from semcast.server.mapping.readout_watch import ReadoutWatch
from semcast.server.mapping.residual_patterns import COLUMNS, ROWS
from semcast.server.mapping.rolling_shutter import ImageFlow, RollingShutter
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.tracks import TrackTable
from semcast.server.mapping.world_map import Keyframe, WorldMap

NUM_FRAMES, STEP_S, READOUT_S, NUM_BANDS = 50, 1 / 30, 0.025, 12


def pose_at(t_s):
    """A hand that goes sideways and shakes."""
    turn = (0.03 * np.sin(9.0 * t_s), -0.1 * t_s + 0.03 * np.sin(12.0 * t_s), 0.03 * np.sin(7.0 * t_s))
    return make_transform(exp_so3(turn), (0.9 * t_s, 0.04 * np.sin(8.0 * t_s), 0.3 * t_s))


@functools.cache  # several reconstructions see the same images, and drawing them takes as long as one
def rolled(t_s, readout_s, axis):
    """An image whose rows (axis 0) or columns (1) are read one after the other."""
    size = CAMERA.shape_hw[axis]
    image = np.zeros((*CAMERA.shape_hw, 3), np.uint8)
    edges = np.linspace(0, size, NUM_BANDS + 1 if readout_s else 2, dtype=int)
    for low, high in pairwise(edges):
        late_s = readout_s * (0.5 * (low + high) / size - 0.5)
        band = (slice(None),) * axis + (slice(low, high),)
        corner_xy, size_wh = [0, 0], [CAMERA.width, CAMERA.height]
        corner_xy[1 - axis], size_wh[1 - axis] = low, high - low
        image[band] = render(pose_at(t_s + late_s), corner_xy, tuple(size_wh))
    return image


@functools.cache
def run(readout_s, axis=0, **settings):
    """A reconstruction, its path and its error; tests share it and leave it as it is."""
    reconstruction = make(**settings)
    results = [
        reconstruction.process(DecodedFrame(k, round(k * STEP_S * 1e9), rolled(k * STEP_S, readout_s, axis)))
        for k in range(NUM_FRAMES)
    ]
    reconstruction.conclude()
    trajectory = reconstruction.final_trajectory()
    assert results[-1].T_world_cam is not None
    truth = [pose_at(k * STEP_S) for k in range(NUM_FRAMES)]
    return reconstruction, trajectory, ate_percent(trajectory, truth)


@pytest.mark.parametrize(
    ("readout_s", "axis", "side"),
    [(READOUT_S, 0, "top"), pytest.param(-READOUT_S, 1, "right", marks=pytest.mark.slow)],
)
def test_the_readout_is_found_and_the_path_is_put_right(readout_s, axis, side, caplog):
    with caplog.at_level(logging.INFO, "semcast.server.mapping"):
        reconstruction, trajectory, ate = run(readout_s, axis)
    assert reconstruction.camera.readout_from == side
    assert reconstruction.camera.readout_ms == pytest.approx(25.0, abs=3.0)
    assert "rolling shutter: " in caplog.text
    assert sorted(trajectory) == list(range(NUM_FRAMES)), "frames before it was found have poses too"
    as_global, _, ate_as_global = run(readout_s, axis, readout_ms=0.0)
    assert as_global.camera.readout_ms == 0.0
    assert ate < 0.65 * ate_as_global


def test_keyframes_are_put_right_by_what_they_have_in_view(rng):
    camera = replace(CAMERA, readout_ms=25.0)
    flow = ImageFlow(camera, np.array([2.0, 0, 0, 0, 0, 0, 0, 0]))
    size = camera.width, camera.height
    in_view = camera.unproject(rng.uniform(0, size, (30, 2))) * rng.uniform(2.0, 6.0, (30, 1))
    beside = camera.unproject(rng.uniform(2 * camera.width, 3 * camera.width, (30, 2))) * 3.0
    xyz = np.concatenate([in_view, beside])
    world, images = WorldMap(), KeyframeImages(3)
    for frame_id, ids in ((0, np.arange(60)), (10, np.arange(11)), (20, np.arange(60))):
        xy = camera.project(xyz[ids])
        world.add_keyframe(Keyframe(frame_id, frame_id, exp_se3(np.zeros(6)), 0, ids, xy, np.ones(len(ids))))
    world.add_landmarks(np.arange(60), xyz, np.zeros((60, 3), np.uint8), np.ones(60), 0, 0)
    late_s = 0.025 * (np.arange(camera.height) / (camera.height - 1) - 0.5)
    line_x = np.rint(camera.cx + 2.0 * camera.fx * late_s).astype(int)
    leaning = np.zeros(camera.shape_hw, np.uint8)
    leaning[np.arange(camera.height), line_x] = 255
    images.append(SeenFrom(0, leaning))
    put_map_right(world, images, camera, {0: flow, 10: flow})
    assert np.ptp(line_x) > 10
    (upright,) = images
    assert np.ptp(upright.grey.argmax(axis=1)) <= 1
    off = lean(camera, in_view, flow.at(camera.project(in_view)))
    np.testing.assert_allclose(world.pose_of_frame(0), exp_se3(-off), atol=1e-12)
    np.testing.assert_array_equal(world.pose_of_frame(10), np.eye(4), "eleven points are too few")
    np.testing.assert_array_equal(world.pose_of_frame(20), np.eye(4), "how it moved is not known")
    first, second, third = world.keyframes
    assert np.abs(first.xy[:30] - camera.project(in_view)).max() > 5.0
    np.testing.assert_array_equal(second.xy, first.xy[:11])
    np.testing.assert_array_equal(third.xy[:30], camera.project(in_view))


def test_frames_that_are_put_right_are_told_as_moved(rng):
    camera = replace(CAMERA, readout_ms=25.0)
    flows = {k: ImageFlow(camera, np.array([0.1 * k, 0, 0, 0, 0, 0, 0, 0])) for k in (1, 2)}
    xyz = camera.unproject(rng.uniform(0, (camera.width, camera.height), (30, 2))) * 3.0
    world, ids = WorldMap(), np.arange(30)
    world.add_keyframe(Keyframe(0, 0, np.eye(4), 0, ids, camera.project(xyz), np.ones(30)))
    world.add_landmarks(ids, xyz, np.zeros((30, 3), np.uint8), np.ones(30), 0, 0)
    for frame_id in (1, 2, 3):
        world.add_frame(frame_id, 0, np.eye(4))
    world.take_changes()
    put_map_right(world, KeyframeImages(3), camera, flows)
    assert world.frames[1][0] == 0, "it moves with the same keyframe"
    assert all(np.abs(world.pose_of_frame(k) - np.eye(4)).max() > 1e-4 for k in flows)
    assert world.take_changes().frames.tolist() == [1, 2]


def test_what_was_found_outlives_a_restart_and_a_reset():
    reconstruction, _, _ = run(READOUT_S, 0)
    found = reconstruction.camera
    arrays = reconstruction.snapshot()
    again = make()
    again.restore(arrays)
    assert again.camera == found
    told = make(readout_ms=0.0)
    told.restore(arrays)
    assert told.camera.readout_ms == 0.0, "settings win over what was found"
    older = {name: array for name, array in arrays.items() if name != "readout"}
    again = make()
    again.restore(older)
    assert again.camera == CAMERA
    with pytest.raises(ValueError, match="readout of a snapshot"):
        make().restore({**arrays, "readout": np.array([2.0, 20.0])})
    again = make()
    again.restore(arrays)
    again.reset()
    assert again.camera == found


def test_a_global_shutter_is_taken_for_one():
    reconstruction, trajectory, ate = run(0.0)
    assert reconstruction.camera == CAMERA
    _, told, _ = run(0.0, readout_ms=0.0)
    assert all(np.array_equal(trajectory[k], T) for k, T in told.items()), "watching changes nothing"
    assert ate < 0.5


def test_a_readout_longer_than_any_camera_has_is_not_believed():
    result = shaken_views.adjusted(replace(shaken_views.CAMERA, readout_ms=60.0))

    def found(slower):
        """What is found where rows and columns are so many times closer in time than they seem."""
        unit = np.ones(result.pattern_products.shape[-1])
        unit[[ROWS, COLUMNS]] = 1.0 / slower
        watch = ReadoutWatch(shaken_views.CAMERA, is_wanted=True)
        watch.take(replace(result, pattern_products=unit[:, None] * result.pattern_products * unit))
        assert watch.is_on, "views to come may tell"
        return watch.take_found()

    assert found(1.0).ms == pytest.approx(60.0, rel=0.1)
    assert found(1.5).ms == pytest.approx(90.0, rel=0.1)
    assert found(2.0) is None


def test_a_lens_that_is_clearly_another_one_is_told_once(caplog):
    camera = replace(shaken_views.CAMERA, fx=1.06 * 400.0, fy=1.06 * 400.0)
    watch = ReadoutWatch(shaken_views.CAMERA, is_wanted=True)
    for seed in range(3):  # twelve keyframes each
        result = shaken_views.adjusted(camera, seed=seed)
        others = replace(result.problem, keyframe_ids=100 * seed + result.problem.keyframe_ids)
        watch.take(replace(result, problem=others))
        told = caplog.text.count("too short, by about 5 % or more, by what is seen: semcast lens measures it")
        assert told == (seed > 0), "sixteen keyframes are enough"


def test_movements_are_measured_only_while_they_are_wanted():
    wanted = [True] * 6 + [False] * 4
    answers = iter(wanted)
    shutter, tracks = RollingShutter(CAMERA, lambda: next(answers)), TrackTable("robust", 200, 0)
    for k in range(len(wanted)):
        frame = DecodedFrame(k, round(k * STEP_S * 1e9), rolled(k * STEP_S, 0.0, 0))
        sight = shutter.see(frame)
        tracks.follow(sight, tracks.xy + tracks.velocity) if len(tracks) else tracks.remember(sight)
        before = len(shutter.flows)
        shutter.settle(frame, sight, tracks)
        tracks.refill(sight)
        assert len(shutter.flows) == before, "no image is put right by it: it waits until there is time"
        shutter.keep_up()
    assert sorted(shutter.flows) == [0, 1, 2, 3, 4, 5], "the first one by those after it"
    middle = np.array([[160.0, 120.0]])
    speeds = [shutter.flows[k].at(middle)[0, 0] for k in range(3)]
    assert speeds[0] == pytest.approx(2 * speeds[1] - speeds[2])


def test_the_velocity_of_a_shaking_hand_is_found_by_frames_to_either_side():
    w_rad_s, rate_hz = 2 * np.pi * 3.0, 30.0

    def turned(frame_id):
        return exp_se3(np.array([0.02 * np.sin(w_rad_s * frame_id / rate_hz), 0.0, 0.0, 0.0, 0.0, 0.0]))

    watch = ReadoutWatch(CAMERA, is_wanted=True)
    for frame_id in range(40):
        watch.note(frame_id, round(frame_id / rate_hz * 1e9))
    keyframe_ids = np.arange(0, 40, 3)
    world = SimpleNamespace(pose_of_frame=lambda frame_id: None if frame_id == 30 else turned(frame_id))
    motion = watch.motion(world, SimpleNamespace(keyframe_ids=keyframe_ids))
    found_rad_s, known = motion.velocity[:, 0], np.isfinite(motion.velocity).all(axis=1)
    assert keyframe_ids[~known].tolist() == [0, 30, 39], "ends, and where a frame has no pose"
    truth_rad_s = 0.02 * w_rad_s * np.cos(w_rad_s * keyframe_ids / rate_hz)
    error_rad_s = np.abs(found_rad_s - truth_rad_s)[known]
    assert np.median(error_rad_s) < 0.01 * 0.02 * w_rad_s


def test_frames_of_as_good_as_one_time_tell_no_velocity():
    # A video with one stamp far ahead, of frame 20, has times a nanosecond apart until the others catch up.
    watch, t_ns = ReadoutWatch(CAMERA, is_wanted=True), -1
    for frame_id in range(40):
        t_ns = max(t_ns + 1, 33_000_000 * (frame_id + (5 if frame_id == 20 else 0)))
        watch.note(frame_id, t_ns)
    world = SimpleNamespace(pose_of_frame=lambda frame_id: exp_se3(np.full(6, 0.01 * frame_id)))
    keyframe_ids = np.arange(0, 40, 3)
    velocity = watch.motion(world, SimpleNamespace(keyframe_ids=keyframe_ids)).velocity
    known = np.isfinite(velocity).all(axis=1)
    assert keyframe_ids[~known].tolist() == [0, 21, 24, 39]
    assert np.abs(velocity[known]).max() < 1.0
