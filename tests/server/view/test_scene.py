"""The scene hands out exactly what a viewer has not seen."""

from dataclasses import replace

import numpy as np
import pytest

from semcast.common.geometry import exp_se3, exp_so3, make_transform
from semcast.common.trajectory import Trajectory
from semcast.server.mapping.state import Marker
from semcast.server.view.frame_view import MISSING, FrameView
from semcast.server.view.landmark_table import CHUNK_LANDMARKS, LandmarkTable
from semcast.server.view.path_table import SEGMENT_POSES
from semcast.server.view.picture import compress_picture, confidence_colours
from semcast.server.view.scene import Cursor, Scene, align_poses
from semcast.server.view.spectator import Spectator, look_at


def view(frame_id, T=None, backfilled=(), **scalars):
    return FrameView(
        frame_id=frame_id,
        t_source_ns=frame_id * 100_000_000,
        T_world_cam=T,
        state="tracking" if T is not None else "lost",
        scalars=scalars,
        image=np.full((16, 16, 3), 7, np.uint8),
        confidence=np.full((16, 16), 0.5, np.float32),
        keypoints_xy=np.zeros((3, 2), np.float32),
        keypoint_inlier=np.array([True, False, True]),
        backfilled=backfilled,
    )


def at(x):
    return make_transform(np.eye(3), (float(x), 0.0, 0.0))


def points(ids):
    ids = np.asarray(ids, np.int64)
    xyz = np.stack([ids, ids, ids], axis=1).astype(float)
    return ids, xyz, np.full((len(ids), 3), 9, np.uint8), np.full(len(ids), 0.5, np.float32)


NONE = np.zeros(0, np.int64)


def test_a_second_look_without_news_is_empty():
    scene, cursor = Scene(), Cursor()
    scene.add_frame(view(0, at(0)))
    scene.add_landmarks(*points([1, 2]), NONE)
    assert not scene.changes_since(cursor).empty
    assert scene.changes_since(cursor).empty


def test_only_the_newest_segment_is_sent_again():
    scene, cursor = Scene(), Cursor()
    for k in range(2 * SEGMENT_POSES):
        scene.add_frame(view(k, at(k)))
    assert set(scene.changes_since(cursor).segments) == {0, 1}
    scene.add_frame(view(2 * SEGMENT_POSES, at(2 * SEGMENT_POSES)))
    changes = scene.changes_since(cursor)
    assert set(changes.segments) == {2}
    # It joins the segment before, so the drawn line has no gap.
    assert changes.segments[2][0][:, 0].tolist() == [2 * SEGMENT_POSES - 1, 2 * SEGMENT_POSES]


def test_a_late_viewer_gets_everything():
    scene, early = Scene(), Cursor()
    for k in range(5):
        scene.add_frame(view(k, at(k), **{"link/psnr_db": float(k)}))
        scene.changes_since(early)
    changes = scene.changes_since(Cursor())
    assert [row.scalars["link/psnr_db"] for row in changes.rows] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert changes.segments[0][0][:, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_frames_move_with_the_keyframe_they_hang_on():
    scene, cursor = Scene(), Cursor()
    scene.set_keyframes(np.array([0]), at(0)[None])
    scene.add_frame(view(0, at(0)))
    scene.add_frame(view(1, at(1)))
    scene.set_keyframes(np.array([2]), at(2)[None])
    scene.add_frame(view(2, at(2)))
    scene.changes_since(cursor)
    turned = make_transform(exp_so3([0.0, 0.0, np.pi / 2]), (0.0, 5.0, 0.0))
    scene.set_keyframes(np.array([0]), turned[None])
    expected = [[0.0, 5.0, 0.0], [0.0, 6.0, 0.0], [2.0, 0.0, 0.0]]
    np.testing.assert_allclose(scene.poses()[:, :3, 3], expected, atol=1e-12)
    np.testing.assert_allclose(scene.changes_since(cursor).segments[0][0], expected, atol=1e-6)


def test_frames_that_moved_otherwise_are_set_anew():
    scene, cursor = Scene(), Cursor()
    scene.set_keyframes(np.array([0]), at(0)[None])
    for k in range(3):
        scene.add_frame(view(k, at(k)))
    scene.changes_since(cursor)
    # The map grew three times as large: a keyframe's pose alone does not say so.
    scene.set_keyframes(np.array([0]), at(0)[None])
    scene.move_frames(np.array([0, 1, 2, 7]), np.stack([at(0), at(3), at(6), at(9)]))
    np.testing.assert_allclose(scene.poses()[:, 0, 3], [0.0, 3.0, 6.0], atol=1e-12)
    np.testing.assert_allclose(scene.changes_since(cursor).segments[0][0][:, 0], [0.0, 3.0, 6.0], atol=1e-6)


def test_frames_posed_later_take_their_place_in_the_line():
    scene = Scene()
    scene.add_frame(view(0))
    scene.add_frame(view(1))
    scene.add_frame(view(2, at(2), backfilled=((0, 0, at(0)), (1, 1, at(1)))))
    assert scene.poses()[:, 0, 3].tolist() == [0.0, 1.0, 2.0]


def test_the_line_of_frames_that_come_together_is_cut_where_the_camera_was_lost():
    scene = Scene()
    together = view(9, at(9), backfilled=tuple((k, k, at(k)) for k in (0, 1, 2, 5, 6)))
    scene.add_frame(replace(together, after_gaps=frozenset({5})))
    lines = scene.changes_since(Cursor()).segments[0]
    assert [line[:, 0].tolist() for line in lines] == [[0.0, 1.0, 2.0], [5.0, 6.0, 9.0]]


def test_earlier_frames_that_became_keyframes_of_a_start_move_by_themselves():
    scene = Scene()
    scene.add_frame(view(0))
    scene.add_frame(view(1))
    scene.set_keyframes(np.array([0, 2]), np.stack([at(0), at(2)]))
    scene.add_frame(view(2, at(2), backfilled=((0, 0, at(0)), (1, 1, at(1)))))
    scene.set_keyframes(np.array([0]), at(-1)[None])
    assert scene.poses()[:, 0, 3].tolist() == [-1.0, 1.0, 2.0]


def test_frames_before_a_start_move_with_the_keyframe_after_them():
    scene = Scene()
    scene.set_keyframes(np.array([0, 3, 6]), np.stack([at(0), at(3), at(6)]))
    scene.add_frame(view(6, at(6), backfilled=tuple((k, k, at(k)) for k in (1, 2, 4))))
    scene.set_keyframes(np.array([3]), at(13)[None])
    assert scene.poses()[:, 0, 3].tolist() == [11.0, 12.0, 4.0, 6.0]


def test_the_line_is_cut_where_tracking_was_lost():
    scene = Scene()
    for k in (0, 1):
        scene.add_frame(view(k, at(k)))
    scene.add_frame(view(2))
    for k in (3, 4):
        scene.add_frame(view(k, at(k)))
    strips = scene.changes_since(Cursor()).segments[0]
    assert [strip[:, 0].tolist() for strip in strips] == [[0.0, 1.0], [3.0, 4.0]]


def test_a_frame_that_never_came_cuts_no_line_and_shows_its_counts():
    scene = Scene()
    scene.add_frame(view(0, at(0)))
    scene.add_frame(replace(view(1), state=MISSING, scalars={"drops/all": 1.0}))
    scene.add_frame(view(2, at(2)))
    changes = scene.changes_since(Cursor())
    assert [strip[:, 0].tolist() for strip in changes.segments[0]] == [[0.0, 2.0]]
    assert [row.scalars for row in changes.rows] == [{}, {"drops/all": 1.0}, {}]


def test_a_new_map_clears_the_old_one_and_keeps_the_plots():
    scene, cursor = Scene(), Cursor()
    scene.add_frame(view(0, at(0), **{"link/psnr_db": 1.0}))
    scene.add_landmarks(*points([1]), NONE)
    scene.changes_since(cursor)
    scene.start_new_map()
    scene.add_frame(view(1, at(7), **{"link/psnr_db": 2.0}))
    changes = scene.changes_since(cursor)
    assert changes.cleared
    assert changes.chunks == []
    assert len(scene.changes_since(Cursor()).rows) == 2


def test_only_touched_chunks_are_sent_and_removed_landmarks_are_gone():
    table = LandmarkTable()
    table.update(*points(np.arange(2 * CHUNK_LANDMARKS)))
    before = list(table.chunk_versions)
    table.update(*points([CHUNK_LANDMARKS + 1]))
    assert [a == b for a, b in zip(before, table.chunk_versions, strict=True)] == [True, False]
    table.remove(np.array([0, 99_999]))
    assert len(table) == 2 * CHUNK_LANDMARKS - 1
    assert table.chunk(0)[0][:, 0].min() == 1.0


def test_a_table_is_as_long_as_what_it_shows():
    table, shown = LandmarkTable(), 2 * CHUNK_LANDMARKS
    for k in range(40):
        table.update(*points(np.arange(500 * k, 500 * k + 500)))
        table.remove(np.arange(500 * k + 500 - shown - 500, 500 * k + 500 - shown))
    assert len(table) == shown
    assert len(table._ids) <= 2 * shown
    assert len(table.chunk_versions) <= 2 * shown // CHUNK_LANDMARKS + 1
    xyz = np.concatenate([table.chunk(k)[0] for k in range(len(table.chunk_versions))])
    assert xyz[:, 0].tolist() == list(range(500 * 40 - shown, 500 * 40))


def test_chunks_that_moved_or_became_empty_are_drawn_again():
    table = LandmarkTable()
    table.update(*points(np.arange(3 * CHUNK_LANDMARKS)))
    seen = {k: (version, table.chunk(k)[0]) for k, version in enumerate(table.chunk_versions)}
    table.remove(np.arange(2 * CHUNK_LANDMARKS + 10))
    for k, version in enumerate(table.chunk_versions):
        if version != seen[k][0]:
            seen[k] = (version, table.chunk(k)[0])
    drawn = np.concatenate([xyz for _, xyz in seen.values()])
    assert drawn[:, 0].tolist() == list(range(2 * CHUNK_LANDMARKS + 10, 3 * CHUNK_LANDMARKS))


def test_landmarks_in_any_order_land_at_their_own_coordinates():
    table, rng = LandmarkTable(), np.random.default_rng(0)
    ids = rng.permutation(3000)
    for part in np.array_split(ids, 7):
        table.update(*points(part))
    xyz = np.concatenate([table.chunk(k)[0] for k in range(len(table.chunk_versions))])
    assert xyz[:, 0].tolist() == sorted(ids.tolist())


def test_all_behind_a_landmark_that_comes_in_between_is_drawn_again():
    table = LandmarkTable()
    table.update(*points(np.arange(3 * CHUNK_LANDMARKS)))
    before = list(table.chunk_versions)
    table.remove(np.array([CHUNK_LANDMARKS]))
    table.update(*points([CHUNK_LANDMARKS, 4 * CHUNK_LANDMARKS]))
    assert [now != then for now, then in zip(table.chunk_versions, before, strict=False)] == [
        False,
        True,
        False,
    ], "it has its old place"
    before = list(table.chunk_versions)
    table.update(*points([-1, 5 * CHUNK_LANDMARKS]))
    assert all(now > then for now, then in zip(table.chunk_versions, before, strict=True))


def test_the_truth_is_fitted_to_the_map_even_on_a_straight_line():
    truth = Trajectory(np.arange(6) * 0.1, np.array([at(k) for k in range(6)]))
    R, t = exp_so3([0.2, 0.1, -0.4]), np.array([3.0, 2.0, 1.0])
    scene = Scene(truth)
    for k in range(6):
        T = make_transform(R, 0.5 * R @ truth.positions[k] + t)
        scene.add_frame(view(k, T))
    scene.align_truth()
    cursor = Cursor()
    aligned = scene.changes_since(cursor).truth
    np.testing.assert_allclose(aligned, 0.5 * truth.positions @ R.T + t, atol=1e-6)
    assert scene.changes_since(cursor).truth is None, "it is sent once"


@pytest.mark.parametrize("rate_hz", [10, 25, 4])
def test_the_truth_of_a_folder_that_is_played_at_another_rate_is_that_of_its_frames(rate_hz):
    bend = [make_transform(exp_so3([0.0, 0.2 * k, 0.0]), (k, 0.1 * k * k, 0.0)) for k in range(12)]
    own_ns = np.arange(12) * 100_000_000
    truth = Trajectory(own_ns * 1e-9, np.array(bend))
    scene = Scene(truth, own_ns)
    for k in range(12):
        scene.add_frame(replace(view(k, bend[k]), t_source_ns=k * 10**9 // rate_hz))
    for k in range(12, 18):  # the folder again, backwards
        scene.add_frame(replace(view(k, bend[22 - k]), t_source_ns=k * 10**9 // rate_hz))
    scene.align_truth()
    np.testing.assert_allclose(scene.changes_since(Cursor()).truth, truth.positions, atol=1e-5)


def test_cameras_that_stand_or_move_against_each_other_have_no_fit():
    forth, back = np.array([at(k) for k in range(4)]), np.array([at(-k) for k in range(4)])
    assert align_poses(forth, back) is None
    assert align_poses(forth[:1], forth[:1]) is None
    assert align_poses(np.array([at(0)] * 4), forth) is None


def test_the_frustum_follows_the_size_of_the_scene_in_steps():
    scene, cursor = Scene(), Cursor()
    scene.add_frame(view(0, at(0)))
    ids, _, rgb, confidence = points([1])
    scene.add_landmarks(ids, np.array([[0.0, 0.0, 10.0]]), rgb, confidence, NONE)
    assert scene.changes_since(cursor).frustum_size == pytest.approx(1.5)
    scene.add_landmarks(ids, np.array([[0.0, 0.0, 11.0]]), rgb, confidence, NONE)
    assert scene.changes_since(cursor).frustum_size is None
    scene.add_landmarks(ids, np.array([[0.0, 0.0, 100.0]]), rgb, confidence, NONE)
    assert scene.changes_since(cursor).frustum_size == pytest.approx(15.0)


def test_the_spectator_looks_at_the_camera_from_behind_and_settles():
    spectator, T = Spectator(), exp_se3([0.3, 0.2, -0.5, 1.0, 2.0, 3.0])
    for _ in range(200):
        T_world_eye = spectator.follow(T, 4.0)
    np.testing.assert_allclose(T_world_eye[:3, :3] @ T_world_eye[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T_world_eye[:3, :3]) == pytest.approx(1.0)
    in_eye = np.linalg.inv(T_world_eye) @ T
    assert in_eye[2, 3] > 0
    assert abs(in_eye[0, 3]) < in_eye[2, 3]
    in_camera = (np.linalg.inv(T) @ T_world_eye)[:3, 3]
    assert (in_camera < 0.0).all(), "to the left, above and behind"
    jumped = spectator.follow(make_transform(T[:3, :3], T[:3, 3] + [100.0, 0.0, 0.0]), 4.0)
    assert 10.0 < np.linalg.norm(jumped[:3, 3] - T_world_eye[:3, 3]) < 20.0


def test_looking_straight_down_is_still_a_rotation():
    T = look_at(np.zeros(3), np.array([0.0, 1.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_pictures_are_jpeg_and_bad_confidence_is_shown_as_none():
    picture = compress_picture(view(0), 80)
    assert picture.image_jpeg[:2] == picture.confidence_jpeg[:2] == b"\xff\xd8"
    assert picture.keypoint_inlier.tolist() == [True, False, True]
    colours = confidence_colours(np.array([[0.0, 1.0], [2.0, np.nan]], np.float32))
    assert colours[0].tolist() == [[165, 30, 75], [40, 200, 220]]
    assert colours[1].tolist() == [[40, 200, 220], [165, 30, 75]]
    with pytest.raises(ValueError, match="must have an image"):
        compress_picture(view(0).without_image(), 80)


def test_frames_whose_pose_is_taken_back_leave_the_path():
    scene, cursor = Scene(), Cursor()
    scene.set_keyframes(np.array([0]), at(0)[None])
    num = SEGMENT_POSES + 4
    for k in range(num):
        scene.add_frame(view(k, at(k)))
    scene.changes_since(cursor)
    scene.withdraw_frames(np.array([3, num - 1, 500]))
    np.testing.assert_array_equal(scene.poses()[:, 0, 3], np.delete(np.arange(num), [3, num - 1]))
    segments = scene.changes_since(cursor).segments
    assert 3.0 not in np.concatenate(segments[0])[:, 0]
    assert segments[1][0][-1, 0] == num - 2
    scene.withdraw_frames(np.arange(SEGMENT_POSES, num))
    assert scene.changes_since(cursor).segments[1] == [], "a viewer has to be told that nothing is left"


def test_a_gap_stays_when_the_frame_after_it_is_taken_back():
    scene = Scene()
    for k, T in enumerate((at(0), at(1), None, at(9), at(10), at(11))):
        scene.add_frame(view(k, T))
    scene.withdraw_frames(np.array([3]))
    (strips,) = scene.changes_since(Cursor()).segments.values()
    assert [strip[:, 0].tolist() for strip in strips] == [[0.0, 1.0], [10.0, 11.0]]


def test_frames_posed_together_after_a_gap_are_one_line_that_begins_after_it():
    scene = Scene()
    for k, T in enumerate((at(0), at(1), None, None, None, None)):
        scene.add_frame(view(k, T))
    # A later part of the map begins: frames of before it are told again, those that waited follow.
    scene.add_frame(view(6, at(6), backfilled=tuple((k, k, at(k)) for k in (1, 3, 4, 5))))
    scene.add_frame(view(7, at(7)))
    (strips,) = scene.changes_since(Cursor()).segments.values()
    assert [strip[:, 0].tolist() for strip in strips] == [[0.0, 1.0], [3.0, 4.0, 5.0, 6.0, 7.0]]


def test_the_marker_is_shown_once_where_it_is_and_taken_away_where_it_tells_nothing_any_more():
    marker = Marker(np.array([[0.0, 0, 5], [1, 0, 5], [1, 1, 5], [0, 1, 5]]), "marker 7")
    scene, cursor = Scene(), Cursor()
    scene.set_marker(marker)
    assert scene.changes_since(cursor).marker is marker
    scene.set_marker(marker)
    assert scene.changes_since(cursor).empty
    scene.set_marker(None)
    assert len(scene.changes_since(cursor).marker.corners_map) == 0
    scene.start_new_map()
    assert scene.changes_since(cursor).marker is None
    assert scene.changes_since(Cursor()).marker is None
