"""Tracks from image to image, and their drift taken out."""

from dataclasses import replace

import numpy as np
import pytest
from shifted_texture import CAMERA, SHAPE, START_X, begin, mapped_wall, pose_at, sight_at

from semcast.server.geometry.grey import to_grey
from semcast.server.mapping.anchoring import anchor_tracks
from semcast.server.mapping.keyframe_images import ImagedMap, KeyframeImages, SeenFrom
from semcast.server.mapping.sight import Sight, usable_rows
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.tracker import expected_positions
from semcast.server.mapping.tracks import MAX_COAST, TrackTable


def test_usable_rows_follow_the_slots():
    frame = DecodedFrame(
        0, 0, np.zeros((40, 8, 3), np.uint8), slot_snr_db=np.array([5, -20, np.nan], np.float32)
    )
    rows = usable_rows(frame, 40)
    assert rows[:16].all()
    assert not rows[16:].any()
    assert usable_rows(DecodedFrame(0, 0, frame.image), 40).all()


def test_tracks_keep_their_ids_and_follow_the_image():
    tracks = begin()
    ids, xy = tracks.ids.copy(), tracks.xy.copy()
    tracks.follow(sight_at(26), tracks.xy)
    stayed = np.isin(ids, tracks.ids)
    assert stayed.mean() > 0.8
    assert np.median(np.abs(tracks.xy - (xy[stayed] - (6, 0)))) < 0.1
    assert np.allclose(np.median(tracks.velocity, axis=0), (-6, 0), atol=0.1)
    assert np.all((tracks.confidence > 0) & (tracks.confidence <= 1))
    tracks.keep(tracks.xy[:, 0] < 128)
    assert tracks.refill(sight_at(26)) > 0
    assert np.all(np.diff(tracks.ids) > 0)


def test_tracks_in_a_lost_slot_coast_and_come_back():
    tracks = begin()
    in_band = (tracks.xy[:, 1] > 66) & (tracks.xy[:, 1] < 90)
    band_ids = tracks.ids[in_band]
    assert len(band_ids) >= 5
    tracks.follow(sight_at(23, lost=(4, 5)), tracks.xy)
    coasting = tracks.ids[~tracks.visible]
    assert np.isin(band_ids, coasting).all()
    tracks.follow(sight_at(26), tracks.xy + tracks.velocity)
    assert np.isin(band_ids, tracks.ids[tracks.visible]).mean() > 0.6


def test_a_point_beside_a_lost_slot_is_seen():
    tracks = begin()
    beside = (np.abs(tracks.xy[:, 1] - 80) < 30) & ((tracks.xy[:, 1] < 62) | (tracks.xy[:, 1] > 97))
    ids, xy = tracks.ids[beside], tracks.xy[beside]
    nearest = np.minimum(np.abs(xy[:, 1] - 63), np.abs(xy[:, 1] - 96))
    assert (nearest < 7).sum() >= 5
    tracks.follow(sight_at(23, lost=(4, 5)), tracks.xy)
    seen = np.isin(ids, tracks.ids[tracks.visible])
    assert seen[nearest < 7].mean() > 0.5


def test_tracks_of_a_damaged_image_are_looked_for_where_their_neighbours_went():
    tracks = begin()
    ids, xy = tracks.ids.copy(), tracks.xy.copy()
    tracks.follow(sight_at(26, lost=(2, 5, 8)), tracks.xy + np.array([22.0, 0.0]))
    came = tracks.visible
    error_px = np.linalg.norm(tracks.xy[came] - (xy[np.searchsorted(ids, tracks.ids[came])] - (6, 0)), axis=1)
    assert (error_px < 1).sum() > 85  # 76 by the guess alone
    assert (error_px >= 1).sum() <= 2


def test_nothing_coasts_for_ever():
    tracks = begin()
    for k in range(MAX_COAST + 1):
        tracks.follow(sight_at(20, lost=range(12), frame_id=k), tracks.xy)
    assert len(tracks) == 0


def test_no_corner_is_taken_near_a_lost_slot():
    tracks = begin(lost=(5,))
    assert not np.any((tracks.xy[:, 1] > 80 - 6) & (tracks.xy[:, 1] < 96 + 6))


def test_an_image_of_fewer_rows_than_a_window_may_lose_some():
    noise = np.random.default_rng(0).integers(0, 256, (20, 200, 3), dtype=np.uint8)
    usable = np.arange(20) < 16
    sight = Sight(DecodedFrame(0, 0, noise), to_grey(noise), usable)
    tracks = TrackTable("robust", 50, 0)
    tracks.remember(sight)
    assert tracks.refill(sight) == 0  # each row is next to a lost one


def test_a_damaged_frame_makes_all_tracks_coast():
    tracks = begin()
    count = len(tracks)
    noise = np.random.default_rng(0).integers(0, 256, (*SHAPE, 3), dtype=np.uint8)
    frame = DecodedFrame(1, 1, noise)
    tracks.follow(Sight(frame, to_grey(noise), np.ones(SHAPE[0], bool)), tracks.xy)
    assert len(tracks) > 0.8 * count
    tracks.follow(sight_at(22), tracks.xy)
    assert tracks.visible.sum() > 0.6 * count


def test_low_confidence_in_the_maps_lowers_that_of_tracks():
    high, low = (
        begin(confidence=np.full(SHAPE, c, np.float32), keypoint_confidence=np.full(SHAPE, k, np.float32))
        for c, k in ((0.9, 0.9), (0.2, 0.3))
    )
    assert low.confidence.mean() < 0.6 * high.confidence.mean()


def test_a_track_keeps_a_part_of_the_doubt_of_the_images_it_came_through():
    doubtful = np.full(SHAPE, 0.5, np.float32)  # the displacement head expects 1 px
    certain = np.ones(SHAPE, np.float32)
    through, around = begin(), begin()
    for tracks, middle in ((through, doubtful), (around, certain)):
        for k, head in enumerate((certain, middle, certain)):
            tracks.follow(sight_at(21 + k, frame_id=1 + k, keypoint_confidence=head), tracks.xy - [1, 0])
    ids, row, other = np.intersect1d(through.ids, around.ids, return_indices=True)
    assert len(ids) > 50
    assert np.all(through.confidence[row] < around.confidence[other])
    assert np.allclose(through.drift_px2[row] - around.drift_px2[other], 0.2, atol=0.02)
    # A point that begins now has come through nothing.
    through.keep(through.ids < 40)
    through.refill(sight_at(23, frame_id=3))
    assert np.all(through.drift_px2[through.age == 1] == 0.0)


def test_nan_maps_give_finite_confidence():
    tracks = begin(
        confidence=np.full(SHAPE, np.nan, np.float32), keypoint_confidence=np.full(SHAPE, np.nan, np.float32)
    )
    assert np.isfinite(tracks.confidence).all()


def test_new_ids_are_higher_than_all_others():
    tracks = begin()
    old_ids, next_id, xy = tracks.ids, tracks.next_id, tracks.xy
    before, after = tracks.renew(old_ids[:3])
    assert np.array_equal(before, old_ids)
    assert np.array_equal(tracks.ids, after)
    assert np.array_equal(tracks.xy, xy)
    assert tracks.ids.min() >= next_id
    assert tracks.next_id > tracks.ids.max()


def test_ids_kept_elsewhere_become_new_with_those_of_tracks():
    tracks = begin()
    tracks.keep(tracks.ids >= 20)
    next_id, kept = tracks.next_id, np.array([7, 25])
    before, after = tracks.renew(kept)
    assert (np.diff(after) > 0).all()
    gone, alive = after[np.searchsorted(before, kept)]
    assert gone >= next_id
    assert gone not in tracks.ids
    assert alive in tracks.ids
    assert tracks.next_id > after.max()


def test_what_stands_in_the_image_goes_on_to_be_known_when_ids_are_renewed():
    tracks = begin()
    tracks.follow(sight_at(20), tracks.xy)
    tracks.renew(np.array([1, 5000]))
    stands = tracks.passing._now.ids
    assert len(stands) > 50
    assert np.isin(stands, tracks.ids).mean() > 0.9


def test_ids_stay_small_however_often_landmarks_of_long_ago_are_among_the_tracks():
    tracks = TrackTable("robust", 150, 0)
    tracks.next_id = 5000
    for _ in range(100):
        tracks.adopt(np.array([3, 4]), np.array([[9.0, 9.0], [50.0, 50.0]]), 0.5)
        tracks.renew(np.array([3, 4, 80]))
    assert tracks.next_id == 5000 + 100 * 3


def test_adopted_points_replace_all_tracks():
    tracks = begin()
    tracks.adopt(np.array([9, 4, 9]), np.array([[1.0, 1], [2, 2], [3, 3]]), 0.5)
    assert tracks.ids.tolist() == [4, 9]
    assert tracks.xy.tolist() == [[2, 2], [1, 1]]
    assert tracks.visible.all()
    assert tracks.velocity.tolist() == tracks.edge.tolist() == [[0, 0], [0, 0]]


@pytest.mark.parametrize("given_up", ["clear", "adopt"])
def test_tracks_that_were_given_up_are_not_brought_back_by_a_second_look(given_up):
    tracks, sight = begin(), sight_at(24)
    tracks.follow(sight, tracks.xy - (4, 0))
    if given_up == "clear":
        tracks.clear()
    else:
        tracks.adopt(np.array([7]), np.array([[30.0, 30.0]]), 0.5)
    ids = tracks.ids.copy()
    assert not tracks.follow_again(sight, lambda before: before.xy)
    assert not tracks.follow_jump(sight)
    np.testing.assert_array_equal(tracks.ids, ids)


def test_off_ignores_the_maps():
    tracks = TrackTable("off", 100, 0)
    sight = sight_at(20, confidence=np.full(SHAPE, 0.1, np.float32))
    tracks.remember(sight)
    tracks.refill(sight)
    assert np.all(tracks.confidence == 1.0)


@pytest.mark.parametrize("value", [0, 255])
def test_an_empty_image_has_no_tracks(value):
    image = np.full((*SHAPE, 3), value, np.uint8)
    sight = Sight(DecodedFrame(0, 0, image), to_grey(image), np.ones(SHAPE[0], bool))
    tracks = TrackTable("robust", 100, 0)
    tracks.remember(sight)
    assert tracks.refill(sight) == 0
    tracks.follow(sight, tracks.xy)
    assert len(tracks) == 0


def test_tracks_are_found_again_after_a_jump_beyond_the_pyramid():
    tracks = begin(x=20, y=10)
    ids, xy = tracks.ids.copy(), tracks.xy.copy()
    tracks.follow(sight_at(135, 75), tracks.xy, max_level=2)
    visible = tracks.visible
    assert visible.sum() > 25
    was = xy[np.searchsorted(ids, tracks.ids[visible])]
    error = np.linalg.norm(tracks.xy[visible] - (was - (115, 65)), axis=1)
    assert (error < 0.5).mean() > 0.95
    assert visible.all(), "what a jump does not find is gone, it does not coast"


def test_another_place_is_no_jump():
    tracks = begin()
    count = len(tracks)
    other = sight_at(20)
    frame = DecodedFrame(1, 10**8, np.ascontiguousarray(other.frame.image[:, ::-1]))
    tracks.follow(Sight(frame, to_grey(frame.image), other.usable), tracks.xy)
    assert len(tracks) > 0.9 * count
    assert tracks.visible.sum() < 0.2 * count


def test_a_second_look_starts_from_the_image_before():
    tracks = begin()
    ids, xy = tracks.ids.copy(), tracks.xy.copy()
    sight = sight_at(90)
    assert not TrackTable("robust", 150, 0).follow_jump(sight), "nothing was followed yet"
    tracks.follow(sight, tracks.xy - (70, 0))
    tracks.xy = tracks.xy + 11.0  # as if they had slipped
    assert tracks.follow_jump(sight)
    was = xy[np.searchsorted(ids, tracks.ids)]
    assert np.median(np.linalg.norm(tracks.xy - (was - (70, 0)), axis=1)) < 0.3
    before = tracks.xy.copy()
    assert not tracks.follow_jump(sight), "only one second look at an image"
    np.testing.assert_array_equal(tracks.xy, before)


def test_a_second_look_leaves_out_what_was_last_seen_in_an_image_that_is_kept_no_longer():
    tracks = begin()
    for k in range(MAX_COAST):
        tracks.follow(sight_at(23 + 3 * k, lost=(4, 5)), tracks.xy + tracks.velocity)
    assert (tracks.missed == MAX_COAST).sum() > 5
    sight = sight_at(23 + 3 * MAX_COAST)
    tracks.follow(sight, tracks.xy + tracks.velocity)
    assert tracks.follow_again(sight, lambda before: before.xy + before.velocity)
    assert tracks.visible.sum() > 50


def test_a_second_look_that_finds_less_changes_nothing():
    tracks = begin()
    lost = sight_at(24, lost=(0, 1, 2, 3, 4, 5))  # half of the image
    tracks.follow(lost, tracks.xy - (4, 0))
    coasting, visible = int((tracks.missed > 0).sum()), int(tracks.visible.sum())
    assert coasting > 20
    assert visible > 20
    before = {name: getattr(tracks, name).copy() for name in ("ids", "xy", "missed")}
    frame_ids = tracks.frame_ids
    assert not tracks.follow_jump(lost)
    assert tracks.frame_ids == frame_ids, "the image too is one that tracks are followed from"
    for name, values in before.items():
        np.testing.assert_array_equal(getattr(tracks, name), values)


@pytest.fixture
def mapped():
    return mapped_wall()


def test_a_track_without_a_landmark_is_expected_from_where_it_was_last_seen(mapped):
    world, _, tracks = mapped
    unknown = np.arange(len(tracks)) % 3 == 0
    world.remove_landmarks(unknown)
    where = tracks.xy - (24, 0)
    # The camera stood at 20, 26 and 34 and is at 44 now; some tracks were last seen from 20.
    seen_at = np.where(np.arange(len(tracks)) % 2, 20, 34)
    tracks.missed = np.where(seen_at == 20, 2, 0)
    tracks.xy = tracks.xy - np.stack([seen_at - 20, np.zeros(len(tracks))], axis=1)
    before = [pose_at(34), pose_at(26), pose_at(20)]
    expected = expected_positions(CAMERA, world, tracks, pose_at(44), before)
    assert np.abs(expected - where).max() < 1e-6
    stays = unknown & (tracks.missed == 2)
    expected = expected_positions(CAMERA, world, tracks, pose_at(44), [pose_at(34), pose_at(26), None])
    assert np.abs(expected - where)[~stays].max() < 1e-6
    np.testing.assert_array_equal(expected[stays], tracks.xy[stays])  # it did not move when last seen


def anchor(mapped, sight, x, submap=0):
    world, images, tracks = mapped
    return anchor_tracks(ImagedMap(CAMERA, world, images, submap), tracks, sight, pose_at(x))


def test_drift_is_taken_out_at_a_keyframe(mapped, rng):
    _, _, tracks = mapped
    true = {i: xy - (10, 0) for i, xy in zip(tracks.ids, tracks.xy, strict=True)}
    sight = sight_at(30, frame_id=1)
    tracks.follow(sight, tracks.xy - (10, 0))
    tracks.xy = tracks.xy + rng.normal(0, 0.7, tracks.xy.shape)
    tracks.drift_px2[:] = 0.5
    doubtful = tracks.confidence.copy()
    visible = int(tracks.visible.sum())
    assert anchor(mapped, sight, 30) > 0.9 * visible
    error = np.linalg.norm(tracks.xy - np.array([true[i] for i in tracks.ids]), axis=1)[tracks.visible]
    assert np.median(error) < 0.05
    settled = tracks.drift_px2 == 0.0
    assert settled.sum() > 0.9 * visible
    assert np.all(tracks.confidence[settled] >= doubtful[settled])


def noisy_keyframes(mapped, places, sd=18.0):
    """Keyframes at several places whose images have noise of their own; all see the tracks of the first."""
    world, _, tracks = mapped
    first = world.keyframes[0]
    rng, images = np.random.default_rng(5), KeyframeImages(10)
    for frame_id, x in enumerate(places):
        if frame_id:
            xy = first.xy - (x - START_X, 0)
            world.add_keyframe(replace(first, frame_id=frame_id, T_world_cam=pose_at(x), xy=xy))
        grey = sight_at(x).grey + rng.normal(0, sd, SHAPE)
        images.append(SeenFrom(frame_id, np.clip(grey, 0, 255).astype(np.uint8)))
    return world, images, tracks


def test_noise_of_older_keyframes_averages_out(mapped):
    error = []
    for places in ((20,), (20, 22, 24, 26, 28)):
        world, images, _ = noisy_keyframes(mapped, places)
        tracks = begin(START_X)
        sight = sight_at(30, frame_id=9)
        tracks.follow(sight, tracks.xy - (10, 0))
        true = world.keyframes[0].xy[np.searchsorted(world.keyframes[0].ids, tracks.ids)] - (10, 0)
        assert anchor((world, images, tracks), sight, 30) > 50
        error.append(np.median(np.linalg.norm(tracks.xy - true, axis=1)[tracks.visible]))
    assert error[1] < 0.7 * error[0]


def test_tracks_that_keyframes_disagree_about_are_trusted_less(mapped):
    trusted = []
    for sd in (2.0, 25.0):
        world, images, _ = noisy_keyframes(mapped, (20, 22, 24, 26, 28), sd)
        tracks = begin(START_X)
        sight = sight_at(30, frame_id=9)
        tracks.follow(sight, tracks.xy - (10, 0))
        assert anchor((world, images, tracks), sight, 30) > 50
        trusted.append(np.median(tracks.confidence[tracks.visible]))
        world.keyframes[1:] = []
    assert trusted[0] > 0.95
    assert trusted[1] < trusted[0] - 0.03


def test_tracks_without_a_landmark_are_aligned_by_the_depth_around_them(mapped):
    world, _, tracks = mapped
    new = np.arange(len(tracks)) % 3 == 0
    true = dict(zip(tracks.ids, tracks.xy - (10, 0), strict=True))
    new_ids = tracks.ids[new]
    world.remove_landmarks(new)
    sight = sight_at(30, frame_id=1)
    tracks.follow(sight, tracks.xy - (10, 0))
    tracks.xy = tracks.xy + 0.5
    anchor(mapped, sight, 30)
    mine = tracks.visible & np.isin(tracks.ids, new_ids)
    error = np.linalg.norm(tracks.xy - np.array([true[i] for i in tracks.ids]), axis=1)[mine]
    assert len(error) > 15
    assert np.median(error) < 0.05


def test_without_confidence_drift_is_taken_out_too(mapped):
    _, _, tracks = mapped
    tracks._mode = "off"
    sight = sight_at(24, frame_id=1)
    tracks.follow(sight, tracks.xy - (4, 0))
    assert anchor(mapped, sight, 24) > 50
    assert np.all(tracks.confidence[tracks.visible] == 1.0)


def test_a_track_that_fits_nowhere_stays_where_it_is(mapped):
    world, _, tracks = mapped
    sight = sight_at(30, frame_id=1)
    tracks.follow(sight, tracks.xy - (10, 0))
    followed = tracks.xy.copy()
    other = KeyframeImages(10)
    other.append(SeenFrom(0, np.random.default_rng(0).integers(0, 256, SHAPE).astype(np.uint8)))
    assert anchor((world, other, tracks), sight, 30) == 0
    np.testing.assert_array_equal(tracks.xy, followed)
    assert anchor(mapped, sight, 30, submap=1) == 0, "a keyframe of another submap has another world"
    np.testing.assert_array_equal(tracks.xy, followed)
    world.remove_landmarks(np.arange(len(world.landmarks)) >= 4)
    assert anchor(mapped, sight, 30) == 4, "too few depths to tell those of others"
