"""The metre of a map that grows and moves, from a marker in its keyframes."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from drawn_markers import draw_marker

from semcast.common.camera import Intrinsics
from semcast.common.errors import tell_nobody
from semcast.common.geometry import exp_so3, invert_transform, make_transform, transform_points
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.state import DecodedFrame, FrameResult, TrackingState
from semcast.server.mapping.world_map import Keyframe
from semcast.server.marker_settings import MarkerSettings
from semcast.server.metres import Metres

CAMERA = Intrinsics(fx=420.0, fy=430.0, cx=310.0, cy=235.0, width=640, height=480)
#: Metres per unit of the map.
UNIT_M = 0.2
SIDE_M = 0.3
#: In the map: faces the cameras, its z points back to them.
T_MAP_MARKER = make_transform(exp_so3((0.2, 0.1, 0.3)) @ np.diag([1.0, -1.0, -1.0]), (0.1, 0.2, 6.0))
ELSEWHERE = make_transform(T_MAP_MARKER[:3, :3], T_MAP_MARKER[:3, 3] + (-1.9, 0.0, 0.5))


def T_world_cam_of(k):
    return make_transform(exp_so3((0.0, -0.05 * (k % 10), 0.02)), (0.3 * (k % 10), 0.1 * (k % 3), 0.0))


class Run:
    """A map of keyframes without landmarks, and what follows it."""

    def __init__(self, on_give_up=tell_nobody, **marker):
        self.reconstruction = Reconstruction(CAMERA, ReconstructionSettings(), InlineBundle())
        self.world = self.reconstruction.world
        settings = MarkerSettings(**{"side_m": SIDE_M, **marker})
        self.metres = Metres(settings, CAMERA, self.reconstruction, on_give_up)

    def show(self, k, markers=((7, T_MAP_MARKER),), part=0):
        """Make a keyframe that shows markers; what is told of its frame afterwards."""
        noise = np.random.default_rng(k).normal(120, 12, (CAMERA.height, CAMERA.width, 3))
        image = np.clip(noise, 0, 255).astype(np.uint8)
        T_world_cam = T_world_cam_of(k)
        for number, T_map_marker in markers:
            T_cam_marker = invert_transform(T_world_cam) @ T_map_marker
            image = draw_marker(image, CAMERA, T_cam_marker, SIDE_M / UNIT_M, number)
        self.world.add_keyframe(
            Keyframe(
                frame_id=k, t_source_ns=k, T_world_cam=T_world_cam, submap=part,
                ids=np.zeros(0, np.int64), xy=np.zeros((0, 2)), confidence=np.zeros(0),
            )
        )  # fmt: skip
        result = result_of(k, part)
        frame = DecodedFrame(frame_id=k, t_source_ns=k, image=image)
        self.update = self.metres.follow(self.reconstruction.take_map_update(), frame, result)
        return self.metres.of(result)

    def follow(self):
        """Let the metre follow what was done to the map."""
        self.update = self.metres.follow(self.reconstruction.take_map_update())

    def centres_m(self, placement):
        """Return where cameras are in the frame of the marker."""
        return placement.points(np.array([T[:3, 3] for T in self.world.poses.values()]))


def result_of(k, part=0):
    return FrameResult(
        frame_id=k, t_source_ns=k, state=TrackingState.TRACKING, T_world_cam=T_world_cam_of(k), num_tracked=0,
        num_inliers=0, reprojection_error_px=None, covariance=None, is_keyframe=True, map_epoch=0,
        submap=part, keypoints_xy=np.zeros((0, 2), np.float32), keypoint_inlier=np.zeros(0, bool),
    )  # fmt: skip


def expected_centres_m(T_map_marker=T_MAP_MARKER, num=6):
    T_marker_cam = invert_transform(T_map_marker) @ np.array([T_world_cam_of(k) for k in range(num)])
    return UNIT_M * T_marker_cam[:, :3, 3]


def test_the_unit_is_known_with_the_third_keyframe_and_better_with_more():
    run = Run()
    assert run.show(0) is None
    assert run.show(1) is None
    sigmas = []
    for k in range(2, 6):
        placement = run.show(k)
        sigmas.append(placement.relative_sigma)
        assert abs(placement.scale / UNIT_M - 1.0) < 2.0 * placement.relative_sigma
        assert run.update.marker.words == placement.words, "the viewer has it with the map"
    assert sigmas[-1] < 0.6 * sigmas[0]
    np.testing.assert_allclose(run.centres_m(placement), expected_centres_m(), atol=0.005)
    square = 0.5 * SIDE_M / UNIT_M * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    expected = transform_points(T_MAP_MARKER, square)
    np.testing.assert_allclose(run.update.marker.corners_map, expected, atol=0.02)


def test_a_keyframe_without_the_marker_and_a_frame_that_is_none_leave_the_unit_as_it_is():
    run = Run()
    placement = [run.show(k) for k in range(3)][-1]
    assert run.show(3, markers=()) is placement
    assert run.metres.follow(None) is None
    assert run.metres.of(result_of(4)) is placement


def test_metres_stay_what_they_are_when_the_map_is_moved_and_scaled():
    run = Run()
    before = [run.show(k) for k in range(6)][-1]
    T_new_old = make_transform(exp_so3((0.3, -0.2, 1.0)), (4.0, -2.0, 1.0))
    run.world.transform_submap(0, 0, 2.5, T_new_old)
    run.follow()
    after = run.metres.of(result_of(5))
    assert after.scale == pytest.approx(before.scale / 2.5, rel=1e-6)
    np.testing.assert_allclose(run.centres_m(after), expected_centres_m(), atol=0.005)


def test_a_pose_of_a_map_that_was_adjusted_since_the_frame_before_goes_to_metres_from_where_it_is_now():
    run = Run()
    before = [run.show(k) for k in range(6)][-1]
    run.world.transform_submap(0, 0, 2.5, make_transform(exp_so3((0.3, -0.2, 1.0)), (4.0, -2.0, 1.0)))
    now = run.metres.of(result_of(6))
    assert now.scale == pytest.approx(before.scale / 2.5, rel=1e-6)
    np.testing.assert_allclose(run.centres_m(now), expected_centres_m(), atol=0.005)
    run.follow()
    assert run.metres.of(result_of(6)) is now, "what has not moved is not solved again"


def test_a_frame_without_a_pose_has_no_way_to_metres():
    run = Run()
    for k in range(3):
        run.show(k)
    assert run.metres.of(replace(result_of(3), T_world_cam=None)) is None


def test_the_unit_follows_a_map_that_a_loop_or_an_adjustment_bends():
    run = Run()
    before = [run.show(k) for k in range(6)][-1]
    ids = np.arange(6)
    poses = np.array([T_world_cam_of(k) for k in ids])
    poses[:, :3, 3] *= 1.1
    run.world.bend(ids, poses, np.full(6, 1.1))
    run.follow()
    # Larger by a tenth around the first camera, and the marker with it.
    assert run.metres.of(result_of(5)).scale == pytest.approx(before.scale / 1.1, rel=1e-3)


def test_each_part_has_its_own_unit_until_they_are_joined():
    run = Run()
    for k in range(4):
        run.show(k)
    assert run.show(10, markers=(), part=1) is None, "this part has not seen the marker"
    seen = [run.show(k, part=1) for k in (11, 12, 13, 14)]
    assert seen[-1].num_images == 4
    run.world.transform_submap(1, 0, 1.0, np.eye(4))
    run.follow()
    assert run.metres.of(result_of(14, part=0)).num_images == 8
    assert run.metres.of(result_of(14, part=1)) is None


def test_the_unit_of_a_part_is_told_also_where_one_before_had_its_number(caplog):
    run = Run()
    with caplog.at_level(logging.INFO, "semcast.server.metres"):
        for first in (10, 20):
            for k in range(first, first + 3):
                run.show(k, part=1)
            run.world.transform_submap(1, 0, 1.0, np.eye(4))
            run.follow()
    assert sum(r.message.endswith("(part 1)") for r in caplog.records) == 2


def test_a_marker_that_is_not_the_one_costs_nothing_where_its_keyframes_move():
    run = Run(marker_id=7)
    placement = [run.show(k) for k in range(3)][-1]
    run.show(3, markers=((3, ELSEWHERE),))
    run.world.move_keyframe(3, T_world_cam_of(4))
    run.follow()
    assert run.metres.of(result_of(4)) is placement


def test_a_part_that_is_joined_before_it_saw_the_marker_has_the_unit_of_the_other():
    run = Run()
    for k in range(4):
        run.show(k)
    run.show(11, markers=(), part=1)
    run.world.transform_submap(1, 0, 3.0, np.eye(4))
    run.follow()
    assert run.metres.of(result_of(11, part=0)).num_images == 4


def test_the_frame_does_not_go_over_to_another_marker_that_is_seen_more_often():
    run = Run()
    for k in range(3):
        run.show(k)
    for k in range(3, 9):
        placement = run.show(k, markers=((3, ELSEWHERE),))
    assert placement.marker_id == 7
    named = Run(marker_id=3)
    for k in range(9):
        placement = named.show(
            k, markers=((7, T_MAP_MARKER), (3, ELSEWHERE)) if k > 4 else ((7, T_MAP_MARKER),)
        )
    assert (placement.marker_id, placement.num_images) == (3, 4)


def test_a_new_map_has_a_unit_of_its_own_and_the_same_marker():
    run = Run()
    for k in range(3):
        run.show(k)
    run.reconstruction.reset()
    run.metres.reset()
    assert run.metres.of(result_of(3)) is None
    run.world = run.reconstruction.world
    for k in range(3):
        placement = run.show(k, markers=((3, ELSEWHERE), (7, T_MAP_MARKER)))
    assert placement.marker_id == 7


def test_a_restarted_server_knows_the_unit_at_once():
    run = Run()
    placement = [run.show(k) for k in range(4)][-1]
    again = Run()
    again.reconstruction.restore(run.reconstruction.snapshot())
    again.metres.restore({**run.reconstruction.snapshot(), **run.metres.arrays()})
    assert again.metres.of(result_of(4)).scale == pytest.approx(placement.scale)
    again.metres.restore(run.reconstruction.snapshot())  # of a server that looked for none


def test_a_restarted_server_stays_with_its_marker_and_does_not_know_those_of_another_family():
    run = Run()
    for k in range(3):
        run.show(k)
    for k in range(3, 9):
        run.show(k, markers=((3, ELSEWHERE),))
    kept = {**run.reconstruction.snapshot(), **run.metres.arrays()}
    for given, marker_id in (({}, 7), ({"marker_id": 3}, 3), ({"dictionary": "4x4_50"}, None)):
        again = Run(**given)
        again.reconstruction.restore(kept)
        again.metres.restore(kept)
        found = again.metres.of(result_of(9))
        assert (None if found is None else found.marker_id) == marker_id


def test_a_marker_in_sight_for_hours_costs_no_more_than_one_in_sight_for_minutes(monkeypatch):
    monkeypatch.setattr("semcast.server.metres._MAX_SIGHTINGS", 5)
    run = Run()
    numbers = [p.num_images for p in (run.show(k) for k in range(9)) if p is not None]
    assert max(numbers) == 5
    assert run.metres.arrays()["marker.ids"][-1].tolist() == [7, 8]


def test_what_is_known_is_told_at_first_when_much_better_and_at_the_end(caplog):
    run = Run()
    with caplog.at_level(logging.INFO, "semcast.server.metres"):
        for k in range(3):
            run.show(k)
        first = [r.message for r in caplog.records]
        for k in range(3, 9):
            run.show(k)
        between = len(caplog.records)
        run.metres.tell()
    assert first[0].startswith("marker 7: 3 images, ")
    assert "1 unit of the map is 0.2" in first[0]
    assert 1 < between < 6
    assert caplog.records[-1].message.startswith("marker 7: 9 images, ")
    run.metres.tell()
    assert len(caplog.records) == between + 1, "nothing is said twice"
    (told,) = run.metres.summary()
    assert (told["part"], told["marker_id"], told["num_keyframes"]) == (0, 7, 9)
    assert told["m_per_unit"] == pytest.approx(UNIT_M, rel=0.01)


@pytest.mark.parametrize(
    ("markers", "num", "what"),
    [
        ((), 4, "marker of any number of apriltag_36h11 must be in 3 images or more, got none of 4"),
        (((7, T_MAP_MARKER),), 2, "marker 7 must be seen alike in 3 images or more, got 2 of 2"),
        (((7, T_MAP_MARKER), (7, ELSEWHERE)), 4, "got none of 4; 7 is there twice in 4"),
    ],
)
def test_why_the_metre_is_not_known_is_one_line_at_the_end(caplog, markers, num, what):
    run = Run()
    for k in range(num):
        run.show(k, markers)
    run.metres.tell()
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert record.message.startswith("the metre is not known: ")
    assert what in record.message
    assert run.metres.summary() == []


def test_a_named_marker_that_is_not_there_is_told_with_those_that_are(caplog):
    run = Run(marker_id=5)
    for k in range(3):
        run.show(k)
    run.metres.tell()
    assert "marker 5 of apriltag_36h11 must be in 3 images or more, got none of 3; found: 7" in caplog.text


def test_nothing_is_looked_for_or_said_where_no_marker_is_asked_for(caplog):
    run = Run(side_m=None)
    assert [run.show(k) for k in range(4)] == [None] * 4
    run.metres.tell()
    assert run.metres.summary() is None
    assert not caplog.records


def test_a_failure_ends_the_search_and_not_the_stream(caplog, monkeypatch):
    told = []
    run = Run(on_give_up=told.append)
    for k in range(3):
        run.show(k)

    def fail(*_):
        raise ArithmeticError("no such luck")

    monkeypatch.setattr("semcast.server.export.markers.Sightings.look", fail)
    assert run.show(3) is None
    assert run.update.marker is None
    assert run.show(4) is None
    run.metres.tell()
    assert [r.message for r in caplog.records if r.levelno >= logging.WARNING] == [
        "the marker is no longer looked for",
        "the metre is not known: no such luck",
    ]
    assert told == ["the marker is no longer looked for: no such luck"]


@pytest.mark.parametrize(
    ("given", "what"),
    [
        ({"side_m": 0.0}, "marker_m must be above 0 and finite, got 0"),
        ({"side_m": float("nan")}, "marker_m must be above 0"),
        ({"side_m": 0.2, "dictionary": "qr"}, "marker_dictionary must be one of .*4x4_50.*, got 'qr'"),
        ({"marker_id": 3}, "marker_id needs marker_m, got 3 without"),
        ({"dictionary": "4x4_50"}, "marker_dictionary needs marker_m, got '4x4_50' without"),
    ],
)
def test_settings_that_make_no_sense_are_refused(given, what):
    with pytest.raises(ValueError, match=what):
        MarkerSettings(**given)
