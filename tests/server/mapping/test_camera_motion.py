"""Where the camera goes on to, and images that stayed while it did."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, make_transform
from semcast.common.sequence import open_sequence
from semcast.common.trajectory_error import ate
from semcast.server.export.outputs import trajectory_of
from semcast.server.geometry.grey import to_grey
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.camera_motion import CameraMotion
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.tracks import TrackTable

CAMERA = Intrinsics(fx=260, fy=260, cx=159.5, cy=119.5, width=320, height=240)
FRAME_NS = 100_000_000
POINTS = np.random.default_rng(0).uniform((-4, -3, 6), (4, 3, 12), (200, 3))
STREET = Path(__file__).parents[3] / "deploy" / "demo" / "kitti_06"


def at(x):
    return make_transform(exp_so3((0.0, 0.01 * x, 0.0)), (x, 0.0, 0.1 * x))


def go(motion, xs, first=0, frame_ns=FRAME_NS):
    """Frames that withdraw others -> those, for a camera that is at ``xs`` one after the other."""
    withdrawn = {}
    for k, x in enumerate(xs, start=first):
        gone = motion.observe(k, k * frame_ns, at(x), POINTS)
        if gone:
            withdrawn[k] = gone
    return withdrawn


@pytest.mark.parametrize("num", [1, 4, 12, 30])
def test_images_that_stay_while_the_camera_goes_on_are_of_another_time(num):
    steps = [*range(5), *[4] * num, *range(5 + num, 9 + num)]
    assert go(CameraMotion(CAMERA), 0.2 * np.array(steps)) == {5 + num: list(range(5, 5 + num))}


@pytest.mark.parametrize("num", [1, 4, 12, 30])
def test_a_camera_that_stood_keeps_its_poses(num):
    steps = [*range(5), *[4] * num, *range(5, 9)]
    assert go(CameraMotion(CAMERA), 0.2 * np.array(steps)) == {}


def test_a_camera_that_turns_back_did_not_go_on():
    assert go(CameraMotion(CAMERA), 0.2 * np.array([0, 1, 2, 3, 4, 4, 4, 1.5, 0])) == {}


def test_a_hand_that_turns_one_way_while_it_goes_the_other_has_not_stopped():
    # Points at 10 m stay where they are in the image; nearer and further ones move.
    T_before = [at(0.2 * k) for k in range(5)]
    T_against = T_before[-1] @ make_transform(exp_so3((0.0, -0.02, 0.0)), (0.2, 0.0, 0.0))
    motion = CameraMotion(CAMERA)
    withdrawn = [motion.observe(k, k * FRAME_NS, T, POINTS) for k, T in enumerate(T_before)]
    withdrawn.append(motion.observe(5, 5 * FRAME_NS, T_against, POINTS))
    withdrawn.append(motion.observe(6, 6 * FRAME_NS, at(1.2), POINTS))
    assert withdrawn == [[]] * 7


def test_a_shaking_camera_turns_at_its_ends():
    assert go(CameraMotion(CAMERA), 0.2 * np.sin(np.pi / 4 + np.arange(40) * np.pi / 2)) == {}


def test_a_video_with_every_image_twice_has_every_second_pose_withdrawn():
    withdrawn = go(CameraMotion(CAMERA), 0.2 * np.repeat(np.arange(8), 2))
    assert [k for gone in withdrawn.values() for k in gone] == [5, 7, 9, 11, 13]


def test_frames_that_were_lost_after_the_stay_do_not_make_a_camera_that_stood_go_on():
    motion = CameraMotion(CAMERA)
    assert go(motion, 0.2 * np.array([0, 1, 2, 3, 4, 4, 4])) == {}
    assert go(motion, 0.2 * np.array([7]), first=9) == {}, "three steps in three frames"


def test_a_camera_that_seems_to_have_stopped_is_expected_where_it_is_or_where_it_got_to():
    motion = CameraMotion(CAMERA)
    go(motion, 0.2 * np.arange(5))
    assert motion.predict_on(5 * FRAME_NS) is None
    assert np.allclose(motion.predict(5 * FRAME_NS), at(1.0), atol=1e-3)
    go(motion, [0.8, 0.8], first=5)
    assert np.allclose(motion.predict(7 * FRAME_NS), at(0.8))
    assert np.allclose(motion.predict_on(7 * FRAME_NS), at(1.4), atol=2e-2)
    assert motion.give_up() == [5, 6]
    assert motion.predict_on(7 * FRAME_NS) is None
    assert np.allclose(motion.predict(7 * FRAME_NS), at(1.4), atol=2e-2)


def test_a_camera_that_stood_sets_off_from_rest():
    motion = CameraMotion(CAMERA)
    go(motion, 0.2 * np.array([0, 1, 2, 3, 4, 4, 4, 4, 5]))
    assert np.allclose(motion.predict(9 * FRAME_NS), at(1.2), atol=1e-2)


def test_a_gap_is_longer_than_the_frames_before_were_apart():
    motion = CameraMotion(CAMERA)
    assert not motion.comes_after_gap(0, 0)
    assert not motion.comes_after_gap(5, 5 * FRAME_NS), "nothing is known yet"
    assert not motion.comes_after_gap(20, 20 * FRAME_NS), "three intervals"
    assert motion.comes_after_gap(66, 66 * FRAME_NS)
    assert motion.comes_after_gap(67, 67 * FRAME_NS), "until there is a pose"
    motion.observe(67, 67 * FRAME_NS, at(0.0), POINTS)
    assert not motion.comes_after_gap(68, 68 * FRAME_NS)
    assert motion.comes_after_gap(72, 72 * FRAME_NS)
    motion.reset()
    assert not motion.comes_after_gap(73, 73 * FRAME_NS)
    assert not motion.comes_after_gap(74, 74 * FRAME_NS)
    assert motion.comes_after_gap(78, 78 * FRAME_NS), "how often frames come is known still"


def test_images_that_share_a_time_tell_no_interval():
    motion = CameraMotion(CAMERA)
    times = np.repeat(np.arange(4), 2) * FRAME_NS
    assert not any(motion.comes_after_gap(k, int(t_ns)) for k, t_ns in enumerate(times))


def test_a_row_of_equal_houses_does_not_hold_the_camera_back_after_a_gap():
    """What is seen of the houses fits where the camera was before the gap, but for one house."""
    sequence = open_sequence(STREET)
    reconstruction = Reconstruction(sequence.intrinsics, ReconstructionSettings(), InlineBundle())
    times_ns = {}
    for k in (0, 1, 2, *range(12, 24)):
        times_ns[k] = int(sequence.times_ns[k])
        reconstruction.process(DecodedFrame(k, times_ns[k], sequence.image(k)))
    poses = reconstruction.final_trajectory()
    reconstruction.close()
    assert set(poses) == set(times_ns)
    assert ate(trajectory_of(poses, times_ns), sequence.groundtruth()).rmse < 1.0


def times_of_bunches(num, size):
    """Times at which frames come that wait for each other: ``size`` at once, 2 ms apart."""
    return [(k // size * size + size - 1) * FRAME_NS + k % size * 2_000_000 for k in range(num)]


@pytest.mark.parametrize("size", [2, 3, 5])
def test_a_camera_whose_frames_come_in_bunches_neither_stops_nor_is_gone(size):
    motion = CameraMotion(CAMERA)
    gaps, withdrawn = [], []
    for k, t_ns in enumerate(times_of_bunches(30, size)):
        gaps.append(motion.comes_after_gap(k, t_ns))
        withdrawn += motion.observe(k, t_ns, at(0.2 * k), POINTS)
        assert not motion._still
    assert withdrawn == []
    assert not any(gaps[2 * size + 1 :]), "each of the first two long intervals may be one"
    last_ns = times_of_bunches(30, size)[-1]
    for later_ns in (2_000_000, size * FRAME_NS):
        np.testing.assert_allclose(motion.predict(last_ns + later_ns), at(0.2 * 30), atol=0.01)
    assert motion.predict_step() is None, "what was tried is no other guess"
    assert motion.comes_after_gap(70, last_ns + 40 * FRAME_NS)


@pytest.mark.parametrize(("num_before", "num_lost"), [(3, 7), (15, 26), (15, 60)])
def test_regular_frames_around_a_gap_come_in_no_bunches(num_before, num_lost):
    """A hand that sways is nearer to where it was than its speed led after it, as after a bunch."""
    motion, after = CameraMotion(CAMERA), num_before + num_lost
    for k in (*range(num_before), *range(after, after + 5)):
        motion.comes_after_gap(k, k * FRAME_NS)
        assert motion.predict_step() is None
        x = 0.3 * np.sin(0.105 * k)
        if k > after:
            assert abs(motion.predict(k * FRAME_NS)[0, 3] - x) < 0.1
        motion.observe(k, k * FRAME_NS, at(x), POINTS)
    assert motion.comes_after_gap(after + 15, (after + 15) * FRAME_NS), "another one"


def test_before_it_is_known_that_times_mislead_one_more_step_is_another_guess():
    motion = CameraMotion(CAMERA)
    assert motion.predict_step() is None
    for k, t_ns in enumerate(times_of_bunches(3, 3)):
        motion.comes_after_gap(k, t_ns)
        motion.observe(k, t_ns, at(0.2 * k), POINTS)
        assert motion.predict_step() is None, "regular so far"
    next_ns = times_of_bunches(4, 3)[3]
    motion.comes_after_gap(3, next_ns)
    assert motion.predict(next_ns)[0, 3] > 10.0
    np.testing.assert_allclose(motion.predict_step(), at(0.6), atol=0.01)
    motion.correct(at(0.2), scale=0.5)
    np.testing.assert_allclose(motion.predict_step()[:3, 3], at(0.3)[:3, 3], atol=0.01)
    motion.reset()
    assert motion.predict_step() is None, "steps of another map"


@pytest.mark.parametrize(
    ("size", "first", "readout_ms"),
    [(3, 0, 0.0), (5, 0, 10.0), pytest.param(5, 2, 0.0, marks=pytest.mark.slow)],
)
def test_a_road_is_driven_by_frames_that_come_in_bunches(size, first, readout_ms):
    """Where the camera would be by their times, nothing is in sight: it was a new part with each bunch."""
    sequence = open_sequence(STREET)
    camera = replace(sequence.intrinsics, readout_ms=readout_ms)
    reconstruction = Reconstruction(camera, ReconstructionSettings(max_features=400), InlineBundle())
    came_ns = times_of_bunches(30, size)
    for k in range(first, 30):
        reconstruction.process(DecodedFrame(k, came_ns[k], sequence.image(k)))
    poses = reconstruction.final_trajectory()
    submaps = set(reconstruction.world.part_of_frames().values())
    reconstruction.close()
    assert submaps == {0}
    assert sorted(poses) == list(range(first, 30))
    taken_ns = {k: int(sequence.times_ns[k]) for k in poses}
    assert ate(trajectory_of(poses, taken_ns), sequence.groundtruth()).rmse < 0.1


def test_less_than_the_error_of_poses_is_no_stop():
    assert go(CameraMotion(CAMERA), 0.01 * np.array([0, 1, 2, 3, 3, 3, 6, 7])) == {}


@pytest.mark.parametrize(("num_hung", "parts"), [pytest.param(4, 1, marks=pytest.mark.slow), (10, 2)])
def test_a_road_is_driven_past_a_grabber_that_hangs(num_hung, parts, caplog):
    """After a second nothing is left in sight, and a new part of the map begins."""
    sequence = open_sequence(STREET)
    times_ns = {}
    reconstruction = Reconstruction(
        sequence.intrinsics, ReconstructionSettings(max_features=400), InlineBundle()
    )
    hung = range(16, 16 + num_hung)
    num = 28 + num_hung
    for k in range(num):
        image = sequence.image(15 if k in hung else k)
        times_ns[k] = int(sequence.times_ns[k])
        reconstruction.process(DecodedFrame(k, times_ns[k], image))
    poses = reconstruction.final_trajectory()
    submaps = set(reconstruction.world.part_of_frames().values())
    reconstruction.close()
    assert len(submaps) == parts
    assert sorted(set(range(num)) - set(poses)) == list(hung)
    told = [r.getMessage() for r in caplog.records if r.name.endswith("camera_motion")]
    assert [text[:9] for text in told if "shows what an earlier one showed" in text] == ["frame 16 "]
    error = ate(trajectory_of(poses, times_ns), sequence.groundtruth())
    assert error.rmse < 0.2


def test_an_image_is_looked_at_again_from_where_the_camera_would_have_got_to():
    street = open_sequence(STREET).image(0)

    def sight_of(k, image):
        frame = DecodedFrame(k, k * FRAME_NS, np.ascontiguousarray(image))
        return Sight(frame, to_grey(frame.image), np.ones(len(image), bool))

    way = np.array([90.0, 0.0])
    tracks = TrackTable("robust", 300, 0)
    first, jumped = sight_of(0, street[:, :-90]), sight_of(1, street[:, 90:])
    tracks.remember(first)
    tracks.refill(first)
    ids, xy = tracks.ids.copy(), tracks.xy.copy()
    assert not tracks.follow_again(jumped, lambda before: before.xy), "nothing was followed yet"
    tracks.follow(jumped, tracks.xy + way)
    asked = []

    def guess(before):
        asked.append(before.xy.copy())
        return before.xy - way

    assert tracks.follow_again(jumped, guess)
    assert np.array_equal(asked[0], xy), "tracks as they were before the image"
    assert tracks.frame_ids == [1, 0], "the image counts once"
    was = xy[np.searchsorted(ids, tracks.ids[tracks.visible])]
    assert len(was) > 150
    assert np.median(np.abs(tracks.xy[tracks.visible] - (was - way))) < 0.1


def test_a_camera_rests_when_the_image_has_hardly_moved_for_a_second():
    motion = CameraMotion(CAMERA)
    brakes = [*np.linspace(0.0, 5.0, 11), *(5.0 + 0.5 * (1 - 0.5 ** np.arange(1, 4)))]
    go(motion, brakes)
    go(motion, [5.5 + 0.01 * (-1) ** k for k in range(6)], first=14)
    assert not motion.rests, "not for long"
    go(motion, [5.5 + 0.01 * (-1) ** k for k in range(8)], first=20)
    assert motion.rests, "it sways"
    go(motion, [6.0, 6.5], first=28)
    assert not motion.rests


def test_a_camera_that_turned_round_does_not_rest_though_no_point_was_in_sight_all_the_while():
    motion = CameraMotion(CAMERA)
    for k in range(12):
        T_world_cam = make_transform(exp_so3((0.0, 0.25 * k, 0.0)), np.zeros(3))
        ahead = POINTS @ T_world_cam[:3, :3].T
        motion.observe(k, k * FRAME_NS, T_world_cam, ahead)
        assert not motion.rests, f"frame {k}"


def test_a_camera_before_which_something_passes_rests_at_once():
    motion = CameraMotion(CAMERA)
    go(motion, [0.0, 0.3, 0.5, 0.6])
    assert not motion.rests
    motion.observe(4, 4 * FRAME_NS, at(0.65), POINTS, stands=True)
    assert motion.rests


def test_a_camera_that_moves_does_not_rest_where_the_map_gets_another_unit():
    """A quarter as large, the map has the camera pass where it was a second ago, in the unit of before."""
    motion = CameraMotion(CAMERA)
    for k in range(40):
        scale = 1.0 if k <= 12 else 0.25
        T = make_transform(np.eye(3), (0.1 * scale * k, 0.0, 0.0))
        motion.observe(k, k * FRAME_NS, T, scale * POINTS)
        assert not motion.rests, k
        if k == 12:
            motion.correct(make_transform(np.eye(3), (0.025 * k, 0.0, 0.0)), 0.25)


def test_a_camera_whose_image_stopped_at_once_may_have_gone_on_and_does_not_rest():
    motion = CameraMotion(CAMERA)
    go(motion, [*np.linspace(0.0, 2.0, 11), *[2.0] * 30])
    assert not motion.rests


def test_a_camera_of_which_frames_are_missing_may_have_gone_on_and_does_not_rest():
    motion = CameraMotion(CAMERA)
    go(motion, [5.5 + 0.01 * (-1) ** k for k in range(14)])
    for k in (12, 13, 14):
        motion.comes_after_gap(k, k * FRAME_NS)
    assert motion.rests
    motion.comes_after_gap(24, 24 * FRAME_NS)
    assert not motion.rests
