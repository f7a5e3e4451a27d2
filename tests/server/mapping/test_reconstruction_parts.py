"""A camera that loses its map: parts begun anew, joined again, and turns that leave all landmarks behind."""

import functools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from drawn_boards import CAMERA, FRAME_NS, ate_percent, board_texture, frame_of, make, render

import semcast.server.mapping.map_builder as map_builder
from semcast.common.geometry import (
    exp_so3,
    invert_transform,
    make_transform,
    rotation_angle_deg,
)
from semcast.server.mapping import reconstruction, settings
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.locator import Locator
from semcast.server.mapping.look_back import look_back
from semcast.server.mapping.map_builder import MapBuilder
from semcast.server.mapping.relocalisation import Place, Relocaliser
from semcast.server.mapping.start_geometry import MIN_POINTS
from semcast.server.mapping.state import TrackingState
from semcast.server.mapping.submap_placement import SubmapPlacement


def test_another_place_becomes_a_map_of_its_own(room):
    _, images = room
    other = [np.ascontiguousarray(image[:, ::-1]) for image in images]
    reconstruction = make(lost_after_s=0.15)
    sequence = images[:8] + other[:8]
    results = [reconstruction.process(frame_of(k, image)) for k, image in enumerate(sequence)]
    assert results[-1].state is TrackingState.TRACKING
    assert (results[7].submap, results[-1].submap) == (0, 1)
    assert results[-1].map_epoch == 0
    assert len(reconstruction.final_trajectory()) >= len(sequence) - 4


def test_a_frame_counts_towards_a_new_map_that_one_could_begin_with(room):
    """Few dots are as many as a start needs at least."""
    dots = np.full((*CAMERA.shape_hw, 3), 120, np.uint8)
    for k in range(41):
        cv2.circle(dots, (20 + 34 * (k % 9), 24 + 44 * (k // 9)), 3, (230, 230, 230), -1)
    dots = cv2.GaussianBlur(dots, None, 1.0)
    reconstruction = make(lost_after_s=0.45)
    for k, image in enumerate(room[1][:8]):
        reconstruction.process(frame_of(k, image))
    results = [reconstruction.process(frame_of(8 + k, dots)) for k in range(12)]
    assert all(MIN_POINTS <= r.num_tracked < 50 for r in results[-5:])
    assert results[0].state is TrackingState.LOST
    assert results[-1].state is TrackingState.INITIALIZING


def test_what_passes_before_a_camera_at_rest_begins_no_map():
    """A bus passes before a car that waits: the image is full of it for a second, then shows more."""
    x = [*np.linspace(0.0, 1.4, 15), *(1.6 - 0.2 * 0.6 ** np.arange(1, 35)), *np.linspace(1.7, 2.6, 10)]
    truth = [make_transform(np.eye(3), (v, 0.05 * np.sin(4 * v), 0.0)) for v in x]
    bus = board_texture(9, 1536)[300:540]
    core, results = make(), []
    for k, T in enumerate(truth):
        image = render(T)
        left = int(np.clip(320 - 60 * (k - 28), 0, 320))
        right = int(np.clip(320 - 60 * (k - 40), 0, 320))
        image[:, left:right] = bus[:, 25 * (k - 24) :][:, left:right, None] if left < right else 0
        results.append(core.process(frame_of(k, image)))
    assert all(r.T_world_cam is None for r in results[36:40]), "nothing but the bus is in sight"
    assert {r.submap for r in results} == {0}
    assert all(r.T_world_cam is not None for r in results[44:]), "as soon as some is seen again"
    assert ate_percent(core.final_trajectory(), truth) < 0.5


@pytest.mark.slow
def test_the_unit_of_a_new_part_is_told_by_its_start_alone(monkeypatch):
    """Before the start the camera only turned: over that time it was not as fast as before and after."""
    starts = []

    def noted(camera, start, *rest):
        starts.append((start, look_back(camera, start, *rest)))
        return starts[-1][1]

    monkeypatch.setattr(reconstruction, "look_back", noted)
    truth = [make_transform(np.eye(3), (0.12 * k, 0.05 * np.sin(k), 0.0)) for k in range(8)]
    truth += [make_transform(exp_so3((0.0, 0.03 * k, 0.0)), (13.0, 0.0, 0.0)) for k in range(30, 0, -1)]
    truth += [make_transform(np.eye(3), (13.0 - 0.15 * k, 0.05 * np.sin(k), 0.0)) for k in range(1, 26)]
    core = make(lost_after_s=0.05)
    for k, T in enumerate(truth):
        result = core.process(frame_of(k, render(T)))
        if k == 7:
            speed_map_per_s, _ = core._motion.speed_at(k * FRAME_NS)
        if len(starts) == 2:
            break
    start, grown = ([keyframe.frame_id for keyframe in s.keyframes] for s in starts[1])
    assert result.submap == 1
    assert grown[0] < start[0], "the part has grown over frames in which the camera turned"
    trajectory = core.final_trajectory()
    way = np.linalg.norm(trajectory[start[-1]][:3, 3] - trajectory[start[0]][:3, 3])
    elapsed_s = (start[-1] - start[0]) * FRAME_NS * 1e-9
    assert way / elapsed_s == pytest.approx(speed_map_per_s, rel=0.1)


class MovingBundle(InlineBundle):
    """Moves the newest keyframe when told to, at once or only when the result is waited for."""

    def __init__(self, *, is_late):
        super().__init__()
        self._is_late, self.moves = is_late, False

    def take(self, wait=False):
        if self.moves and self._is_late and not wait:
            return None
        result = super().take(wait)
        if result is None or not self.moves:
            return result
        self.moves, poses = False, result.T_world_cam.copy()
        poses[-1, :3, 3] += (0.02, 0.1, 0.0)
        return replace(result, T_world_cam=poses)


def test_a_new_part_is_placed_by_the_old_one_as_its_last_adjustment_leaves_it():
    """The camera jumps out of view while the adjustment that the last keyframe asked for is under way."""
    x = [0.12 * k for k in range(6)] + [13.0 - 0.3 * k for k in range(5)]
    images = [render(make_transform(np.eye(3), (v, 0.05 * np.sin(v), 0.0))) for v in x]

    def path(*, is_late):
        bundle = MovingBundle(is_late=is_late)
        core = make(bundle, lost_after_s=0.05)
        for k, image in enumerate(images):
            bundle.moves |= k == 6
            result = core.process(frame_of(k, image))
        assert (result.submap, bundle.moves) == (1, False)
        return core.final_trajectory()

    in_time, late = path(is_late=False), path(is_late=True)
    assert in_time.keys() == late.keys()
    for k in in_time:
        np.testing.assert_allclose(late[k], in_time[k], atol=1e-3)


def test_a_new_map_joins_the_old_one_when_it_comes_into_view(caplog, monkeypatch):
    scales, covariances, asked_at, results = [], [], [], []
    join, carried_over = MapBuilder.join, MapBuilder.pose_covariance

    def noted(builder, covariance, T_world_cam):
        covariances.append(covariance)
        asked_at.append(T_world_cam)
        return carried_over(builder, covariance, T_world_cam)

    monkeypatch.setattr(MapBuilder, "join", lambda *a: scales.append(join(*a)) or scales[-1])
    monkeypatch.setattr(MapBuilder, "pose_covariance", noted)
    # The camera jumps out of view of all it knows, begins a new map, and goes back.
    x = [0.12 * k for k in range(8)] + [13.0 - 0.3 * k for k in range(42)]
    truth = [make_transform(np.eye(3), (v, 0.05 * np.sin(v), 0.0)) for v in x]
    reconstruction = make(lost_after_s=0.05)
    with caplog.at_level("INFO", logger="semcast.server.mapping.reconstruction"):
        for k, T in enumerate(truth):
            results.append(reconstruction.process(frame_of(k, render(T)), lambda _: None))
            if "submaps are joined" in caplog.text and len(scales) == 1:
                # Told before the join and after it, the latter in the unit of the older part.
                before, after = covariances[-2:]
                assert abs(np.log(scales[0])) > 0.5
                assert np.allclose(np.diag(after)[:3], np.diag(before)[:3], rtol=0.3)
                assert np.allclose(np.diag(after)[3:], scales[0] ** 2 * np.diag(before)[3:], rtol=0.3)
                assert np.linalg.norm(asked_at[-1][:3, 3] - asked_at[-2][:3, 3]) > 1.0, "it was moved"
                assert np.array_equal(asked_at[-1], results[-1].T_world_cam), "what is told is of that pose"
                scales.append(None)
    assert "a new map is begun" in caplog.text
    assert "submaps are joined" in caplog.text
    assert None in scales, "what is told before and after the join was compared"
    guessed, known = (
        [np.sqrt(r.covariance[3:, 3:].trace()) for r in results[9:] if r.submap == part and r.num_inliers]
        for part in (1, 0)
    )
    assert guessed[-1] > 10.0 * max(known), "until then it was a guess"
    trajectory = reconstruction.final_trajectory()
    assert len(trajectory) >= len(x) - 3
    assert ate_percent(trajectory, truth) < 1.0


def test_parts_are_joined_by_where_the_camera_is_once_its_own_part_was_built_anew(room, monkeypatch):
    joined_at = []

    def put_straight(builder, image):
        newest = builder.world.keyframes[-1]
        step = make_transform(exp_so3((0.0, 0.002, 0.0)), (0.01, 0.0, 0.0))
        builder.world.move_keyframe(newest.frame_id, newest.T_world_cam @ step)
        return [newest]

    def join(builder, place, T_world_cam, tracks):
        joined_at.append((T_world_cam, builder.world.keyframes[-1].T_world_cam))

    monkeypatch.setattr(MapBuilder, "put_straight", put_straight)
    monkeypatch.setattr(MapBuilder, "other_submaps", lambda builder: {7})
    monkeypatch.setattr(MapBuilder, "recognise_other_submap", lambda builder, sight: object())
    monkeypatch.setattr(MapBuilder, "join", join)
    core = make()
    for k, image in enumerate(room[1]):
        core.process(frame_of(k, image))
    assert joined_at
    for asked, now in joined_at:
        np.testing.assert_array_equal(asked, now)


def test_a_place_where_the_camera_cannot_be_joins_nothing(caplog, monkeypatch):
    asked = []
    monkeypatch.setattr(map_builder, "may_join", lambda *a, **k: asked.append((*a, k)) or False)
    x = [0.12 * k for k in range(8)] + [13.0 - 0.3 * k for k in range(42)]
    reconstruction = make(lost_after_s=0.05)
    with caplog.at_level("INFO", logger="semcast.server.mapping.reconstruction"):
        for k, v in enumerate(x):
            reconstruction.process(frame_of(k, render(make_transform(np.eye(3), (v, 0.05 * np.sin(v), 0.0)))))
            if len(asked) == 2:
                break
    assert len(asked) == 2, "the first answer is none for ever"
    assert "submaps are joined" not in caplog.text
    for older, newer, scale, T_join, more in asked:
        assert older[-1].frame_id < newer[0].frame_id
        first = T_join[:3, :3] @ (scale * newer[0].T_world_cam[:3, 3]) + T_join[:3, 3]
        assert abs(first[0] / older[1].T_world_cam[0, 3] - 13.0 / x[older[1].frame_id]) < 5.0
        assert np.array_equal(more["posed_ids"], np.sort(more["posed_ids"]))
        assert more["depth"] > 0.0


@pytest.mark.slow
def test_a_join_leaves_the_older_part_where_it_is(caplog):
    # Back from a second part the camera is recognised in the first one, and comes into sight of the second.
    def at(x, k):
        turn = exp_so3((0.0, 0.004 * np.sin(k / 5), 0.0))
        return make_transform(turn, (x, 0.05 * np.sin(k / 4), 0.02 * np.sin(k / 7)))

    # It was away for longer than it could be told where it went.
    path = [at(0.08 * k, k) for k in range(25)] + [None] * 35 + [at(13.0 + 0.1 * k, k) for k in range(40)]
    path += [None] * 2 + [at(1.0 + 0.12 * k, k) for k in range(130)]
    blank = np.full((*CAMERA.shape_hw, 3), 90, np.uint8)
    reconstruction = make(lost_after_s=0.15)
    before, submaps = None, []
    with caplog.at_level("INFO", logger="semcast.server.mapping.reconstruction"):
        for k, T in enumerate(path):
            result = reconstruction.process(frame_of(k, blank if T is None else render(T)))
            if "submaps are joined" in caplog.text:
                break
            submaps.append(result.submap)
            before = reconstruction.final_trajectory()
    assert "submaps are joined" in caplog.text
    assert 1 in submaps
    assert submaps[-1] == 0
    after = reconstruction.final_trajectory()
    np.testing.assert_allclose(after[0], before[0], atol=1e-9)
    np.testing.assert_allclose(after[20], before[20], atol=0.02)
    assert {reconstruction._map.world.submap_of[k.frame_id] for k in reconstruction._map.world.keyframes} == {
        0
    }


def turning_away(arm=0.0):
    """Sideways, then a turn until all landmarks are out of view, then sideways again.

    It turns on the spot, or at the end of an arm, as in a hand.
    """
    poses = [make_transform(np.eye(3), (0.12 * k, 0.02 * np.sin(k), 0.0)) for k in range(10)]
    position, yaw = poses[-1][:3, 3] - (0.0, 0.0, arm), 0.0
    for _ in range(34):
        yaw -= np.radians(2.0)
        R = exp_so3((0.0, yaw, 0.0))
        poses.append(make_transform(R, position + R @ (0.0, 0.0, arm)))
    for k in range(18):
        away = np.array([0.15 * (k + 1), 0.03 * np.sin(k), -0.05 * (k + 1)])
        poses.append(make_transform(R, poses[43][:3, 3] + away))
    return poses


def test_turning_costs_no_rotation_while_landmarks_run_out():
    truth = turning_away()[:42]
    reconstruction = make(lost_after_s=0.25)
    results = [reconstruction.process(frame_of(k, render(T))) for k, T in enumerate(truth)]
    with_pose = [k for k, result in enumerate(results) if result.T_world_cam is not None and k >= 9]
    assert with_pose == list(range(9, 42))
    assert results[41].num_inliers < 15, "landmarks did run out on the way"
    for k in with_pose:
        turned = results[9].T_world_cam[:3, :3].T @ results[k].T_world_cam[:3, :3]
        assert rotation_angle_deg(turned.T @ truth[9][:3, :3].T @ truth[k][:3, :3]) < 0.5


def test_a_turn_that_leaves_all_landmarks_behind_is_part_of_the_map():
    truth = turning_away(arm=0.2)
    reconstruction = make(lost_after_s=0.25)
    results = [reconstruction.process(frame_of(k, render(T))) for k, T in enumerate(truth)]
    assert all(r.state is TrackingState.TRACKING for r in results[3:])
    assert results[-1].submap == 0
    assert ate_percent(reconstruction.final_trajectory(), truth) < 1.0


def test_a_part_between_two_views_of_the_old_one_is_put_between(caplog):
    """Who turns aside, goes on and turns back has lost the map twice; what is to the side looks otherwise."""
    on = make_transform(np.eye(3), (0.12, 0, 0))
    aside = make_transform(exp_so3((0, np.radians(18.0), 0)), np.zeros(3))
    truth = [np.eye(4)]
    for step in [on] * 12 + [aside] * 4 + [on] * 16 + [invert_transform(aside)] * 4 + [on] * 3:
        truth.append(truth[-1] @ step)
    T_side_world = make_transform(exp_so3((0, np.radians(-72.0), 0)), np.zeros(3))
    pixels = np.stack([*np.meshgrid(range(CAMERA.width), range(CAMERA.height))], axis=-1).reshape(-1, 2)
    seen = CAMERA.unproject(pixels.astype(float)).reshape(*CAMERA.shape_hw, 3)
    reconstruction, results = make(lost_after_s=0.15), []
    with caplog.at_level("INFO", logger="semcast.server.mapping.reconstruction"):
        for k, T in enumerate(truth):
            rays = seen @ T[:3, :3].T
            is_side = np.arctan2(rays[..., 0], rays[..., 2]) > np.radians(40.0)
            image = np.where(is_side[..., None], 255 - render(T_side_world @ T), render(T))
            results.append(reconstruction.process(frame_of(k, image)))
    assert "the newest one is put between" in caplog.text
    assert {r.submap for r in results[20:32]} == {1}
    assert {r.submap for r in results[-4:]} == {0}
    trajectory = reconstruction.final_trajectory()
    assert ate_percent(trajectory, truth) < 1.5
    way, true_way = (np.linalg.norm(T[32][:3, 3] - T[20][:3, 3]) for T in (trajectory, truth))
    unit = np.linalg.norm(trajectory[12][:3, 3] - trajectory[0][:3, 3]) / 1.44
    assert way / unit == pytest.approx(true_way, rel=0.1)


@pytest.mark.slow
def test_a_part_begun_after_a_turn_is_not_taken_for_the_old_one(caplog, monkeypatch):
    # Many tracks survive the turn, but no landmark does, nor do points under small angles replace them.
    monkeypatch.setattr("semcast.server.mapping.map_builder._ENOUGH_SHARE", 0.0)
    truth = turning_away()
    reconstruction = make(lost_after_s=0.25)
    with caplog.at_level("INFO", logger="semcast.server.mapping.reconstruction"):
        results = [reconstruction.process(frame_of(k, render(T))) for k, T in enumerate(truth)]
    assert "a new map is begun" in caplog.text
    assert results[-1].state is TrackingState.TRACKING
    assert results[-1].submap == 1
    assert "joined" not in caplog.text
    world = reconstruction._map.world
    for keyframe in world.keyframes:
        row = world.landmarks.rows(keyframe.ids)
        assert (world.landmarks.submap[row[row >= 0]] == keyframe.submap).all()


@functools.cache
def turn_in_bad_images(num_frames):
    """The camera turns by 56 degrees after nine steps; the true poses, and what it sees while it turns."""
    on, turning = (make_transform(exp_so3((0, np.radians(a), 0)), (0.12, 0, 0)) for a in (0.0, 3.5))
    truth = [np.eye(4)]
    for step in ([on] * 9 + [turning] * 16 + [on] * 16)[: num_frames - 1]:
        truth.append(truth[-1] @ step)
    return truth, [render(T) for T in truth]


def made_bad(image, rng):
    """Blurred, and noisier than what is left of its contrast."""
    noise = rng.normal(0.0, 30.0, (*CAMERA.shape_hw, 1))
    return np.clip(cv2.GaussianBlur(image, None, 10.0) + noise, 0, 255).astype(np.uint8)


@pytest.mark.slow
def test_a_part_after_a_turn_in_bad_images_begins_as_they_say_and_gets_its_unit_after_a_second(monkeypatch):
    """No point can be followed while the camera turns; a start makes the part too large."""
    lay, rng = SubmapPlacement.place, np.random.default_rng(0)

    def laid_too_large(placement, *how):
        place = lay(placement, *how)
        return place if placement._before is None else place._replace(scale=1.5 * place.scale)

    monkeypatch.setattr(SubmapPlacement, "place", laid_too_large)
    truth, images = turn_in_bad_images(42)
    core, results = make(lost_after_s=0.05), []
    for k, image in enumerate(images):
        results.append(core.process(frame_of(k, made_bad(image, rng) if 10 <= k < 26 else image)))
    assert all(r.T_world_cam is None for r in results[11:26])
    assert (results[9].submap, results[-1].submap, results[-1].state) == (0, 1, TrackingState.TRACKING)
    found = core.final_trajectory()
    turned, truly_turned = (T[5][:3, :3].T @ T[30][:3, :3] for T in (found, truth))
    assert rotation_angle_deg(turned.T @ truly_turned) < 16.0, "without a look at them half of it is missed"
    before, after = (np.linalg.norm(found[k + 6][:3, 3] - found[k][:3, 3]) for k in (2, 34))
    assert after == pytest.approx(before, rel=0.2)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (4, 10))])
def test_noise_tells_no_pose_and_begins_no_part(seed):
    core, rng = make(lost_after_s=0.05), np.random.default_rng(seed)
    for k, image in enumerate(turn_in_bad_images(26)[1]):
        result = core.process(frame_of(k, made_bad(image, rng) if k >= 10 else image))
        assert (result.T_world_cam is None) == (k < 2 or k >= 10), k


def test_a_place_without_a_pose_gives_nothing_up(room, monkeypatch):
    _, images = room
    monkeypatch.setattr(settings, "_LEAST_LOST_FRAMES", 2)  # with more, the start follows at once
    reconstruction = make(lost_after_s=0.05)
    other = [np.ascontiguousarray(image[:, ::-1]) for image in images]
    for k, image in enumerate(images[:8] + other[:2]):
        result = reconstruction.process(frame_of(k, image))
    assert result.state is TrackingState.INITIALIZING
    ids = reconstruction.landmarks()[0]
    rng = np.random.default_rng(0)
    nowhere = Place(np.eye(4), 3, ids[:60], rng.uniform(20, 200, (60, 2)), 0)
    monkeypatch.setattr(Relocaliser, "find", lambda *_, **__: nowhere)
    results = [reconstruction.process(frame_of(10 + k, other[2 + k])) for k in range(4)]
    assert results[-1].state is TrackingState.TRACKING
    assert [r.submap for r in results] == [1] * 4


def test_a_part_that_is_lost_as_it_begins_has_its_time_to_be_found_again(room, monkeypatch):
    _, images = room
    reconstruction = make(lost_after_s=0.25)
    other = [np.ascontiguousarray(image[:, ::-1]) for image in images]
    posed = Locator.pose

    def no_pose_in_the_second_part(self, *args, **how):
        return None if self._map.submap == 1 else posed(self, *args, **how)

    monkeypatch.setattr(Locator, "pose", no_pose_in_the_second_part)
    results = [reconstruction.process(frame_of(k, image)) for k, image in enumerate(images[:8] + other[:14])]
    begun = next(k for k, r in enumerate(results) if r.is_keyframe and r.submap == 1)
    assert [r.state for r in results[begun : begun + 4]] == [TrackingState.LOST] * 4
    assert results[begun + 4].state is TrackingState.INITIALIZING


def test_a_camera_that_was_turned_upside_down_is_found_again(room):
    poses, images = room
    reconstruction = make()
    upside_down = [np.ascontiguousarray(np.rot90(image, 2)) for image in images[8:16]]
    for k, image in enumerate(images[:8] + upside_down):
        result = reconstruction.process(frame_of(k, image))
    assert result.state is TrackingState.TRACKING
    assert result.submap == 0
    turned = reconstruction.final_trajectory()[7][:3, :3].T @ result.T_world_cam[:3, :3]
    rolled = poses[7][:3, :3].T @ poses[15][:3, :3] @ np.diag([-1.0, -1.0, 1.0])
    assert rotation_angle_deg(turned.T @ rolled) < 2.0
