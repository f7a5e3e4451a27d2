"""What the map asks of bundle adjustment, and what it tells about a pose."""

from dataclasses import replace

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, invert_transform, make_transform, transform_points
from semcast.server.mapping.bridging import Bridge
from semcast.server.mapping.bundle import optimise
from semcast.server.mapping.guessed_place import GuessedPlace
from semcast.server.mapping.kept_frames import Observed
from semcast.server.mapping.map_builder import MapBuilder
from semcast.server.mapping.map_update import update_of
from semcast.server.mapping.relocalisation import Place
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.start_geometry import Start
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.world_map import Keyframe

CAMERA = Intrinsics(fx=500, fy=500, cx=320, cy=240, width=640, height=480)
IMAGE = np.full((480, 640, 3), 90, np.uint8)
AT_ORIGIN = Bridge(np.eye(4), 1.0, None)


class Asked:
    """Keeps what it is asked; answers with the adjustment."""

    def __init__(self):
        self.problems = []

    @property
    def busy(self):
        return False

    def submit(self, problem):
        self.problems.append(problem)
        return True

    def take(self, wait=False):
        return optimise(self.problems[-1]) if self.problems else None

    def close(self):
        pass


class NewestFrame:
    """The tracks of a frame."""

    def __init__(self, ids, xy):
        self.ids, self.xy = ids, xy.copy()
        self.visible = np.ones(len(ids), bool)
        self.suspect = np.zeros(len(ids), bool)
        self.confidence = np.full(len(ids), 0.8)
        self.edge = np.tile([0.3, -0.4], (len(ids), 1))

    def settle_at(self, rows, xy, scatter_px2):
        assert np.isnan(scatter_px2).all()
        self.xy[rows] = xy


@pytest.fixture
def builder():
    return MapBuilder(CAMERA, ReconstructionSettings(), Asked(), on_moved=print)


def add_part(builder, submap, num_keyframes, first_id, seed=0):
    """Keyframes that go sideways, 10 cm each, and the points they see."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform((-2, -1.5, 5), (4, 1.5, 10), (80, 3))
    ids = 1000 * submap + np.arange(80)
    for k in range(num_keyframes):
        builder.world.add_keyframe(keyframe(first_id + k, submap, ids, pose(0.1 * k), xyz))
    builder.world.add_landmarks(ids, xyz, np.zeros((80, 3), np.uint8), np.ones(80), submap, first_id)
    return ids, xyz


def pose(x, angle=0.0):
    return make_transform(exp_so3((0.0, angle, 0.0)), (x, 0.01 * np.sin(9 * x), 0.0))


def seen(xyz, T_world_cam):
    return CAMERA.project(transform_points(invert_transform(T_world_cam), xyz))


def keyframe(frame_id, submap, ids, T_world_cam, xyz):
    return Keyframe(
        frame_id=frame_id,
        t_source_ns=frame_id,
        T_world_cam=T_world_cam,
        submap=submap,
        ids=ids,
        xy=seen(xyz, T_world_cam),
        confidence=np.full(len(ids), 0.8),
    )


def observed(keyframes):
    """Frames they were made from, with a grey level for each id."""
    return [
        Observed(
            k.frame_id,
            k.t_source_ns,
            k.ids,
            k.xy,
            k.confidence,
            np.repeat(k.ids[:, None] % 256, 3, axis=1).astype(np.uint8),
            IMAGE[..., 0],
        )
        for k in keyframes
    ]


def test_coming_back_to_an_old_part_keeps_its_scale(builder):
    ids, xyz = add_part(builder, 0, 20, 0)
    add_part(builder, 1, 12, 100, seed=1)
    builder.enter(0)
    first_of_window = builder.world.keyframes[11].T_world_cam
    truth = first_of_window @ make_transform(np.eye(3), (0.02, 0.0, 0.0))
    wrong = truth @ make_transform(np.eye(3), (0.01, 0.0, 0.0))
    sight = Sight(DecodedFrame(200, 200, IMAGE), IMAGE[..., 0], np.ones(480, bool))
    before = builder.world.landmarks.xyz[builder.world.landmarks.rows(ids)].copy()
    builder.make_keyframe(sight, NewestFrame(ids, seen(xyz, truth)), wrong)
    builder.collect(wait=True)
    after = builder.world.landmarks.xyz[builder.world.landmarks.rows(ids)]
    np.testing.assert_allclose(after, before, atol=0.02)
    np.testing.assert_allclose(builder.world.poses[200], truth, atol=1e-3)


def test_a_young_map_keeps_its_scale_when_the_camera_comes_back_to_its_beginning(builder):
    ids, xyz = add_part(builder, 0, 4, 0)
    truth = pose(0.003)
    sight = Sight(DecodedFrame(9, 9, IMAGE), IMAGE[..., 0], np.ones(480, bool))
    builder.make_keyframe(sight, NewestFrame(ids, seen(xyz, truth)), pose(0.013))
    builder.collect(wait=True)
    after = builder.world.landmarks.xyz[builder.world.landmarks.rows(ids)]
    assert np.median(after[:, 2] / xyz[:, 2]) == pytest.approx(1.0, abs=0.01)


def test_covariance_is_carried_from_the_adjusted_keyframe_along_the_way_to_the_frame(builder):
    add_part(builder, 0, 6, 0)
    builder._adjuster.submit(builder.world, 0)
    builder.collect(wait=True)
    here = builder.world.poses[5]
    nothing = np.zeros((6, 6))
    at_keyframe = builder.pose_covariance(nothing, here)
    along = builder.pose_covariance(nothing, here @ make_transform(np.eye(3), (0.0, 0.0, 30.0)))
    # Turning by a small angle about x or y moves what is 30 units ahead by 30 times the angle.
    lever = at_keyframe[3:5, 3:5].trace() + 900.0 * at_keyframe[:2, :2].trace()
    cross = 60.0 * (at_keyframe[1, 3] - at_keyframe[0, 4])
    assert along[3:5, 3:5].trace() == pytest.approx(lever + cross, rel=1e-6)
    assert lever > 5.0 * at_keyframe[3:5, 3:5].trace()


def test_covariance_of_another_part_is_not_carried_over(builder):
    add_part(builder, 0, 6, 0)
    builder._adjuster.submit(builder.world, 0)
    builder.collect(wait=True)
    own = 1e-6 * np.eye(6)
    assert builder.pose_covariance(own, builder.world.poses[5]).trace() > own.trace()
    builder.begin_submap()
    np.testing.assert_array_equal(builder.pose_covariance(own, np.eye(4)), own)


def begin_part(builder, first_id, place):
    """A start that becomes a part of its own; its newest pose."""
    builder.begin_submap()
    xyz = np.random.default_rng(7).uniform((-0.5, -0.4, 0.8), (0.5, 0.4, 1.4), (160, 3))
    ids = 5000 + np.arange(160)
    views = [keyframe(first_id + k, builder.submap, ids, pose(0.05 * k), xyz) for k in range(5)]
    sight = Sight(DecodedFrame(views[-1].frame_id, 0, IMAGE), IMAGE[..., 0], np.ones(480, bool))
    start = Start(views, ids, xyz, np.ones(160))
    builder.take_start(start, sight, NewestFrame(ids, views[-1].xy), place, observed(views))
    return builder.world.poses[first_id + 4]


def test_a_part_whose_place_was_guessed_says_so_until_it_is_joined(builder):
    add_part(builder, 0, 6, 0)
    guess, own = np.diag([0.01, 0.01, 0.01, 0.2, 0.2, 0.2, 0.04]), 1e-6 * np.eye(6)
    T_newest = begin_part(builder, 40, AT_ORIGIN._replace(covariance=guess))
    found = builder.pose_covariance(own, T_newest)
    # The lever is 0.2 long, to the right of the first camera.
    np.testing.assert_allclose(np.diag(found)[:3], 0.01, rtol=0.01)
    np.testing.assert_allclose(np.diag(found)[3:], [0.2 + 0.04 * 0.04, *[0.2 + 0.04 * 0.01] * 2], rtol=0.01)
    part = builder.submap
    builder.enter(0)
    assert builder.pose_covariance(own, T_newest).max() < 1e-4, "the older part is where it is"
    builder.enter(part)
    builder.world.transform_submap(part, 0, 1.0, np.eye(4))
    builder.enter(0)
    assert builder.world.guesses == {}
    assert builder.pose_covariance(own, T_newest).max() < 1e-4


def test_poses_of_a_part_that_may_be_anywhere_have_no_covariance(builder):
    add_part(builder, 0, 6, 0)
    T_newest = begin_part(builder, 40, AT_ORIGIN)
    assert builder.pose_covariance(np.eye(6), T_newest) is None


def test_the_first_part_is_no_guess(builder):
    T_newest = begin_part(builder, 40, AT_ORIGIN)
    assert builder.world.guesses == {}
    assert builder.pose_covariance(1e-6 * np.eye(6), T_newest) is not None


def test_a_part_that_is_placed_again_is_worth_what_that_is(builder):
    add_part(builder, 0, 6, 0)
    begin_part(builder, 40, AT_ORIGIN._replace(covariance=np.eye(7)))
    better = GuessedPlace(40, 0.1 * np.eye(7))

    class Placed:
        def place_again(self, world, submap):
            assert (world, submap) == (builder.world, 1)
            return 2.0, pose(0.3), better

    builder._on_moved = lambda _: None
    assert builder.place_again(Placed()) == 2.0
    assert builder.world.guesses == {1: better}


def test_parts_that_begin_and_are_lost_again_keep_the_map_within_its_size():
    builder = MapBuilder(
        CAMERA, ReconstructionSettings(max_landmarks=500, max_keyframes=20), Asked(), on_moved=print
    )
    rng = np.random.default_rng(0)
    xyz = rng.uniform((-0.5, -0.4, 0.8), (0.5, 0.4, 1.4), (150, 3))
    for part in range(10):
        builder.begin_submap()
        ids = 1000 * part + np.arange(150)
        views = [keyframe(10 * part + k, part, ids, pose(0.05 * k), xyz) for k in range(5)]
        frame = DecodedFrame(views[-1].frame_id, 0, IMAGE)
        sight = Sight(frame, IMAGE[..., 0], np.ones(480, bool))
        start = Start(views, ids, xyz, np.ones(150))
        builder.take_start(start, sight, NewestFrame(ids, views[-1].xy), AT_ORIGIN, observed(views))
        assert len(builder.world.landmarks) <= 500
        assert len(builder.world.keyframes) <= 20
        assert {k.frame_id for k in views} <= {k.frame_id for k in builder.world.keyframes}


def test_landmarks_of_a_start_belong_to_the_last_keyframe_that_saw_them(builder, rng):
    xyz = rng.uniform((-0.5, -0.4, 0.8), (0.5, 0.4, 1.4), (160, 3))
    ids = np.arange(160)
    views = [keyframe(k, 0, ids, pose(0.05 * k), xyz) for k in range(5)]
    for k in views[2:]:  # a camera that turned saw the first of them no more
        k.drop_observations(k.ids < 60)
    frame = DecodedFrame(4, 0, IMAGE)
    sight = Sight(frame, IMAGE[..., 0], np.ones(480, bool))
    start = Start(views, ids, xyz, np.ones(160))
    tracks = NewestFrame(views[-1].ids, views[-1].xy)
    builder.take_start(start, sight, tracks, AT_ORIGIN, observed(views))
    marks = builder.world.landmarks
    assert set(marks.born[marks.ids < 60].tolist()) == {1}
    assert set(marks.born[marks.ids >= 60].tolist()) == {4}
    assert marks.rgb[:, 0].tolist() == marks.ids.tolist()


def test_a_start_leaves_its_images_and_the_tracks_where_it_has_them(builder, rng):
    xyz = rng.uniform((-0.5, -0.4, 0.8), (0.5, 0.4, 1.4), (160, 3))
    views = [keyframe(k, 0, np.arange(160), pose(0.05 * k), xyz) for k in range(5)]
    history = [*observed(views)[:3], replace(observed(views)[3], grey=None), observed(views)[4]]
    other = replace(history[0], frame_id=77)
    tracks = NewestFrame(np.arange(10, 200), np.zeros((190, 2)))
    sight = Sight(DecodedFrame(4, 0, IMAGE), IMAGE[..., 0], np.ones(480, bool))
    start = Start(views, np.arange(160), xyz, np.ones(160))
    builder.take_start(start, sight, tracks, AT_ORIGIN, [other, *history])
    assert [image.frame_id for image in builder.images] == [0, 1, 2, 4]
    np.testing.assert_array_equal(tracks.xy[:150], views[4].xy[10:])
    np.testing.assert_array_equal(tracks.xy[150:], 0.0)


def test_an_update_after_a_join_has_the_poses_of_all_frames(builder):
    add_part(builder, 0, 4, 0)
    add_part(builder, 1, 4, 40, seed=1)
    for k in (3, 2, 1, 0, 43, 41):
        builder.world.add_frame(50 + k, k, pose(0.01 * k, angle=0.3))
    builder.world.take_changes()
    builder.world.transform_submap(1, 0, 1.5, pose(2.0, angle=0.1))
    update = update_of(builder.world, builder.world.take_changes(), 0)
    assert update.frame_ids.tolist() == [0, 1, 2, 3, 40, 41, 42, 43, 50, 51, 52, 53, 91, 93]
    for frame_id, T_world_cam in zip(update.frame_ids.tolist(), update.frame_poses, strict=True):
        np.testing.assert_allclose(T_world_cam, builder.world.pose_of_frame(frame_id), atol=1e-12)
    for known in builder.world.keyframes:
        assert known.T_world_cam is builder.world.poses[known.frame_id]


@pytest.mark.parametrize(("away", "may"), [(1.2, True), (3.5, False)])
def test_how_far_a_part_may_begin_from_the_older_one_is_told_in_units_of_that(builder, away, may):
    """A camera that stood can be off by a share of the scene's depth, in whatever unit the newer part is."""
    ids, xyz = add_part(builder, 0, 4, 0)
    for k in range(4):
        builder.world.move_keyframe(k, np.eye(4))
    there, unit = make_transform(np.eye(3), (away, 0.0, 0.0)), 4.0
    builder.enter(1)
    mine = 1000 + ids
    xyz_mine = transform_points(invert_transform(there), xyz) / unit
    for k in range(40, 43):
        builder.world.add_keyframe(keyframe(k, 1, mine, np.eye(4), xyz_mine))
    builder.world.add_landmarks(mine, xyz_mine, np.zeros((80, 3), np.uint8), np.ones(80), 1, 40)
    place = Place(there, 3, ids, seen(xyz, there), 0)
    scale = builder.join(place, np.eye(4), NewestFrame(mine, seen(xyz_mine, np.eye(4))))
    assert (scale == pytest.approx(unit)) if may else (scale is None)


def test_a_keyframe_keeps_no_track_that_may_stand_with_the_camera(builder):
    ids, xyz = add_part(builder, 0, 4, 0)
    sight = Sight(DecodedFrame(9, 9, IMAGE), IMAGE[..., 0], np.ones(480, bool))
    newest = NewestFrame(ids, seen(xyz, pose(0.4)))
    newest.suspect[:20] = True
    builder.make_keyframe(sight, newest, pose(0.4))
    keyframe = builder.world.keyframes[-1]
    assert np.array_equal(keyframe.ids, ids[20:])
    assert np.array_equal(keyframe.edge, newest.edge[20:])


def test_a_camera_found_back_far_in_the_past_is_held_by_the_keyframes_there(builder):
    # 80 keyframes of another place lie between, and no image of the first ones is left to find a revisit in.
    ids, xyz = add_part(builder, 0, 5, 0)
    elsewhere = xyz + np.array([50.0, 0.0, 0.0])
    for k in range(80):
        builder.world.add_keyframe(keyframe(10 + k, 0, 500 + np.arange(80), pose(50 + 0.1 * k), elsewhere))
    grey = np.zeros((80, 3), np.uint8)
    builder.world.add_landmarks(500 + np.arange(80), elsewhere, grey, np.ones(80), 0, 10)
    builder.go_on_from(Place(pose(0.2), 2, ids, seen(xyz, pose(0.2)), 0))
    for frame_id, x in ((200, 0.25), (201, 0.35), (202, 0.45)):
        sight = Sight(DecodedFrame(frame_id, frame_id, IMAGE), IMAGE[..., 0], np.ones(480, bool))
        off = pose(x) @ make_transform(np.eye(3), (0.0, 0.02, 0.05))
        builder.make_keyframe(sight, NewestFrame(ids, seen(xyz, pose(x))), off)
        builder.collect(wait=True)
        np.testing.assert_allclose(builder.world.poses[frame_id], pose(x), atol=1e-3)
    assert builder.world.revisits == {200: 2}


def test_a_camera_found_back_in_the_newest_keyframes_needs_no_tie(builder):
    ids, xyz = add_part(builder, 0, 8, 0)
    builder.go_on_from(Place(pose(0.5), 5, ids, seen(xyz, pose(0.5)), 0))
    sight = Sight(DecodedFrame(20, 20, IMAGE), IMAGE[..., 0], np.ones(480, bool))
    builder.make_keyframe(sight, NewestFrame(ids, seen(xyz, pose(0.55))), pose(0.55))
    assert builder.world.revisits == {}
