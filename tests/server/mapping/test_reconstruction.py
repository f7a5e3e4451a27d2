"""The whole core on rendered sequences of textured planes, without any data files."""

import cv2
import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import (
    align_umeyama,
    exp_so3,
    invert_transform,
    make_transform,
    rotation_angle_deg,
)
from semcast.common.phy.slots import BLOCK_PX
from semcast.server.mapping import reconstruction
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.bundle_process import ProcessBundle
from semcast.server.mapping.look_back import look_back
from semcast.server.mapping.map_builder import MapBuilder
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.relocalisation import Place, Relocaliser
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.state import DecodedFrame, TrackingState

CAMERA = Intrinsics(fx=260, fy=260, cx=159.5, cy=119.5, width=320, height=240)
FRAME_NS = 100_000_000
#: Centre, size and depth order of upright boards (far to near).
BOARDS = (
    (6.0, 0.0, 9.0, 40.0),
    (-2.2, 0.6, 6.0, 2.6),
    (2.0, -0.5, 5.0, 2.2),
    (0.3, 1.2, 4.0, 1.4),
    (-1.0, -1.1, 4.5, 1.2),
)


def board_texture(seed, size=512):
    rng = np.random.default_rng(seed)
    noise = np.zeros((size, size), np.float32)
    for sigma in (2.0, 6.0, 16.0):
        layer = cv2.GaussianBlur(rng.standard_normal((size, size)).astype(np.float32), None, sigma)
        noise += layer / layer.std()
    return np.clip(noise * 32 + 128, 0, 255).astype(np.uint8)


TEXTURES = [board_texture(k, 1536 if k == 0 else 256) for k in range(len(BOARDS))]


def render(T_world_cam):
    """Draw the boards from far to near by the homography of each."""
    T = invert_transform(T_world_cam)
    image = np.zeros(CAMERA.shape_hw, np.uint8)
    for texture, (x, y, z, size) in zip(TEXTURES, BOARDS, strict=True):
        scale = size / texture.shape[0]
        board = np.array([[scale, 0, x - size / 2], [0, scale, y - size / 2], [0, 0, z], [0, 0, 1]])
        H = CAMERA.K @ (T[:3] @ board)
        mask = cv2.warpPerspective(np.full_like(texture, 255), H, (CAMERA.width, CAMERA.height))
        drawn = cv2.warpPerspective(texture, H, (CAMERA.width, CAMERA.height), flags=cv2.INTER_AREA)
        image = np.where(mask == 255, drawn, image)
    return np.repeat(image[..., None], 3, axis=2)


def sideways(num=24):
    return [
        make_transform(exp_so3((0.0, -0.006 * k, 0.002 * k)), (0.08 * k, 0.03 * np.sin(k / 4), 0.03 * k))
        for k in range(num)
    ]


@pytest.fixture(scope="module")
def room():
    poses = sideways()
    return poses, [render(T) for T in poses]


def frame_of(frame_id, image, **maps):
    return DecodedFrame(frame_id, frame_id * FRAME_NS, image, **maps)


def make(bundle=None, **settings):
    return Reconstruction(
        CAMERA, ReconstructionSettings(**{"max_features": 250, **settings}), bundle or InlineBundle()
    )


def ate_percent(trajectory, truth):
    """RMS position error after Sim(3) in percent of the path."""
    ids = sorted(trajectory)
    ours = np.array([trajectory[k][:3, 3] for k in ids])
    theirs = np.array([truth[k][:3, 3] for k in ids])
    scale, R, t = align_umeyama(ours, theirs)
    error = np.linalg.norm(scale * ours @ R.T + t - theirs, axis=1)
    return 100 * np.sqrt((error**2).mean()) / np.linalg.norm(np.diff(theirs, axis=0), axis=1).sum()


def run(images, reconstruction, ids=None):
    results = [
        reconstruction.process(frame_of(k, image))
        for k, image in zip(range(len(images)) if ids is None else ids, images, strict=True)
    ]
    trajectory = reconstruction.final_trajectory()
    reconstruction.close()
    return results, trajectory


@pytest.mark.parametrize("mode", ["robust", "paper", "off"])
def test_a_clean_sequence_is_followed_within_one_percent(room, mode):
    poses, images = room
    reconstruction = make(confidence=mode)
    results, trajectory = run(images, reconstruction)
    assert sorted(trajectory) == list(range(len(images)))
    assert ate_percent(trajectory, poses) < 1.0
    assert results[-1].state is TrackingState.TRACKING
    assert results[-1].covariance is not None
    assert np.linalg.eigvalsh(results[-1].covariance).min() > 0
    assert {k for r in results for k, *_ in r.backfilled} | {
        r.frame_id for r in results if r.T_world_cam is not None
    } == set(trajectory)
    ids, xyz, rgb, confidence = reconstruction.landmarks()
    assert len(ids) == len(xyz) == len(rgb) == len(confidence) > 150
    seen, frames, xy = reconstruction.observations()
    assert set(seen.tolist()) <= set(ids.tolist())
    error = reprojection(trajectory, xyz[np.searchsorted(ids, seen)], frames, xy)
    assert np.median(error) < 0.7


def reprojection(trajectory, points, frames, xy):
    T = np.array([invert_transform(trajectory[k]) for k in frames.tolist()])
    cam = np.einsum("mij,mj->mi", T[:, :3, :3], points) + T[:, :3, 3]
    return np.linalg.norm(CAMERA.project(cam) - xy, axis=1)


def test_a_pose_is_told_before_the_map_is_extended_with_its_frame(room):
    _, images = room
    reconstruction = make()
    early, keyframes_known = {}, {}

    def tell(found):
        early[found.frame_id] = found
        seen = reconstruction.observations()[1]
        keyframes_known[found.frame_id] = found.frame_id in seen

    results = [reconstruction.process(frame_of(k, image), tell) for k, image in enumerate(images)]
    located = [r for r in results if r.state is TrackingState.TRACKING and not r.backfilled]
    assert sorted(early) == [r.frame_id for r in located]
    assert not any(keyframes_known.values())
    assert any(r.is_keyframe for r in located)
    for after in located:
        before = early[after.frame_id]
        assert (before.is_keyframe, before.submap) == (after.is_keyframe, after.submap)
        assert "map" not in before.stage_ms
        moved = np.linalg.norm(before.T_world_cam[:3, 3] - after.T_world_cam[:3, 3])
        assert moved < 0.01
        assert after.is_keyframe or moved < 1e-12


def test_the_same_input_gives_the_same_bits(room):
    _, images = room
    runs = [run(images[:12], make(seed=3))[1] for _ in range(2)]
    assert runs[0].keys() == runs[1].keys()
    assert all(np.array_equal(runs[0][k], runs[1][k]) for k in runs[0])


def test_lossless_process_gives_what_inline_gives(room):
    _, images = room
    inline = run(images[:12], make())[1]
    process = run(images[:12], make(ProcessBundle(lossless=True)))[1]
    assert all(np.array_equal(inline[k], process[k]) for k in inline)


def test_live_process_follows_too(room):
    poses, images = room
    _, trajectory = run(images, make(ProcessBundle()))
    assert len(trajectory) == len(images)
    assert ate_percent(trajectory, poses) < 2.0


def test_lost_slots_cost_little(room):
    poses, images = room
    rng = np.random.default_rng(0)
    reconstruction = make()
    for k, image in enumerate(images):
        snr = np.where(rng.random(CAMERA.height // BLOCK_PX) < 0.2, -20.0, 15.0).astype(np.float32)
        damaged = image.copy()
        lost = np.repeat(snr < 0, BLOCK_PX)
        damaged[lost] = 128
        confidence = np.where(lost, 0.02, 0.9)[:, None] * np.ones((1, CAMERA.width))
        reconstruction.process(
            frame_of(k, damaged, slot_snr_db=snr, confidence=confidence.astype(np.float32))
        )
    trajectory = reconstruction.final_trajectory()
    assert len(trajectory) >= len(images) - 1
    assert ate_percent(trajectory, poses) < 2.0


def test_missing_and_late_frames_are_expected(room):
    poses, images = room
    reconstruction = make()
    order = [0, 1, 2, 4, 3, 5, 8, 9, 9, 10, 13, 14, 15]
    results = [reconstruction.process(frame_of(k, images[k])) for k in order]
    assert results[4].T_world_cam is None
    assert np.allclose(results[8].T_world_cam, results[7].T_world_cam)
    trajectory = reconstruction.final_trajectory()
    assert sorted(trajectory) == sorted(set(order) - {3})
    assert ate_percent(trajectory, poses) < 1.5


def test_standing_still_waits_and_then_starts(room):
    poses, images = room
    sequence = [images[0]] * 6 + images[1:12] + [images[11]] * 5
    truth = [poses[0]] * 6 + poses[1:12] + [poses[11]] * 5
    results, trajectory = run(sequence, make())
    assert all(r.state is TrackingState.INITIALIZING for r in results[:6])
    assert sorted(trajectory) == list(range(len(sequence)))
    assert ate_percent(trajectory, truth) < 1.5
    assert not any(r.is_keyframe for r in results[-3:])


def test_turning_on_the_spot_starts_no_map():
    images = [render(make_transform(exp_so3((0, 0.01 * k, 0)), (0, 0, 0))) for k in range(10)]
    results, trajectory = run(images, make())
    assert all(r.state is TrackingState.INITIALIZING for r in results)
    assert trajectory == {}


def test_it_finds_back_when_the_view_returns(room):
    poses, images = room
    black = np.zeros_like(images[0])
    sequence = images[:14] + [black] * 10 + images[13:20]
    truth = poses[:14] + [poses[13]] * 10 + poses[13:20]
    results, trajectory = run(sequence, make())
    assert results[15].state is TrackingState.LOST
    assert results[15].T_world_cam is None
    back = next(k for k in range(24, len(results)) if results[k].T_world_cam is not None)
    assert back - 24 <= 2
    assert results[-1].map_epoch == 0
    assert len(trajectory) >= len(sequence) - 12
    assert ate_percent(trajectory, truth) < 1.5


def test_a_covered_lens_is_a_gap(room):
    _, images = room
    rng = np.random.default_rng(0)
    covered = [rng.normal(5, 2, images[0].shape).clip(0, 255).astype(np.uint8) for _ in range(6)]
    with_them, without = make(), make()
    seen = list(enumerate(images[:14] + covered + images[16:22]))
    results = [with_them.process(frame_of(k, image)) for k, image in seen]
    for k, image in seen[:14] + seen[20:]:
        other = without.process(frame_of(k, image))
        assert other.state is results[k].state
        np.testing.assert_array_equal(other.keypoints_xy, results[k].keypoints_xy)
    for result in results[14:20]:
        assert result.state is TrackingState.LOST
        assert (result.T_world_cam, result.num_tracked, len(result.keypoints_xy)) == (None, 0, 0)
    assert results[20].state is TrackingState.TRACKING
    one, other = with_them.final_trajectory(), without.final_trajectory()
    assert one.keys() == other.keys()
    np.testing.assert_array_equal(np.stack(list(one.values())), np.stack(list(other.values())))


def test_another_place_becomes_a_map_of_its_own(room):
    _, images = room
    other = [np.ascontiguousarray(np.rot90(image, 2)) for image in images]
    reconstruction = make(lost_after_frames=3)
    sequence = images[:8] + other[:8]
    results = [reconstruction.process(frame_of(k, image)) for k, image in enumerate(sequence)]
    assert results[-1].state is TrackingState.TRACKING
    assert (results[7].submap, results[-1].submap) == (0, 1)
    assert results[-1].map_epoch == 0
    assert len(reconstruction.final_trajectory()) >= len(sequence) - 4


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
    core = make(lost_after_frames=2)
    for k, T in enumerate(truth):
        result = core.process(frame_of(k, render(T)))
        if k == 7:
            speed_map_per_s = core._motion.speed_map_per_s
        if len(starts) == 2:
            break
    start, grown = ([keyframe.frame_id for keyframe in s.keyframes] for s in starts[1])
    assert result.submap == 1
    assert grown[0] < start[0], "the part has grown over frames in which the camera turned"
    trajectory = core.final_trajectory()
    way = np.linalg.norm(trajectory[start[-1]][:3, 3] - trajectory[start[0]][:3, 3])
    elapsed_s = (start[-1] - start[0]) * FRAME_NS * 1e-9
    assert way / elapsed_s == pytest.approx(speed_map_per_s, rel=0.1)


def test_a_new_map_joins_the_old_one_when_it_comes_into_view(caplog, monkeypatch):
    scales, covariances = [], []
    join, carried_over = MapBuilder.join, MapBuilder.pose_covariance
    monkeypatch.setattr(MapBuilder, "join", lambda *a: scales.append(join(*a)) or scales[-1])
    monkeypatch.setattr(
        MapBuilder, "pose_covariance", lambda *a: covariances.append(a[1]) or carried_over(*a)
    )
    # The camera jumps out of view of all it knows, begins a new map, and goes back.
    x = [0.12 * k for k in range(8)] + [13.0 - 0.3 * k for k in range(42)]
    truth = [make_transform(np.eye(3), (v, 0.05 * np.sin(v), 0.0)) for v in x]
    reconstruction = make(lost_after_frames=2)
    with caplog.at_level("INFO", logger="semcast.server.mapping.reconstruction"):
        for k, T in enumerate(truth):
            reconstruction.process(frame_of(k, render(T)), lambda _: None)
            if "submaps are joined" in caplog.text and len(scales) == 1:
                # Told before the join and after it, the latter in the unit of the older part.
                before, after = covariances[-2:]
                assert abs(np.log(scales[0])) > 0.5
                assert np.allclose(np.diag(after)[:3], np.diag(before)[:3], rtol=0.3)
                assert np.allclose(np.diag(after)[3:], scales[0] ** 2 * np.diag(before)[3:], rtol=0.3)
                scales.append(None)
    assert "a new map is begun" in caplog.text
    assert "submaps are joined" in caplog.text
    trajectory = reconstruction.final_trajectory()
    assert len(trajectory) >= len(x) - 3
    assert ate_percent(trajectory, truth) < 1.0


def test_a_join_leaves_the_older_part_where_it_is(caplog):
    # Back from a second part the camera is recognised in the first one, and comes into sight of the second.
    def at(x, k):
        turn = exp_so3((0.0, 0.004 * np.sin(k / 5), 0.0))
        return make_transform(turn, (x, 0.05 * np.sin(k / 4), 0.02 * np.sin(k / 7)))

    path = [at(0.08 * k, k) for k in range(25)] + [None] * 3 + [at(13.0 + 0.1 * k, k) for k in range(40)]
    path += [None] * 2 + [at(1.0 + 0.12 * k, k) for k in range(130)]
    blank = np.full((*CAMERA.shape_hw, 3), 90, np.uint8)
    reconstruction = make(lost_after_frames=3)
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


def turning_away():
    """Sideways, then a turn on the spot until all landmarks are out of view, then sideways again."""
    poses = [make_transform(np.eye(3), (0.12 * k, 0.02 * np.sin(k), 0.0)) for k in range(10)]
    position, yaw = poses[-1][:3, 3], 0.0
    for _ in range(34):
        yaw -= np.radians(2.0)
        poses.append(make_transform(exp_so3((0.0, yaw, 0.0)), position))
    for k in range(18):
        away = np.array([0.15 * (k + 1), 0.03 * np.sin(k), -0.05 * (k + 1)])
        poses.append(make_transform(exp_so3((0.0, yaw, 0.0)), position + away))
    return poses


def test_turning_costs_no_rotation_while_landmarks_run_out():
    truth = turning_away()[:42]
    reconstruction = make(lost_after_frames=4)
    results = [reconstruction.process(frame_of(k, render(T))) for k, T in enumerate(truth)]
    with_pose = [k for k, result in enumerate(results) if result.T_world_cam is not None and k >= 9]
    assert with_pose == list(range(9, 42))
    assert results[41].num_inliers < 15, "landmarks did run out on the way"
    for k in with_pose:
        turned = results[9].T_world_cam[:3, :3].T @ results[k].T_world_cam[:3, :3]
        assert rotation_angle_deg(turned.T @ truth[9][:3, :3].T @ truth[k][:3, :3]) < 0.5


def test_a_turn_that_leaves_all_landmarks_behind_is_part_of_the_map():
    truth = turning_away()
    reconstruction = make(lost_after_frames=4)
    results = [reconstruction.process(frame_of(k, render(T))) for k, T in enumerate(truth)]
    assert all(r.state is TrackingState.TRACKING for r in results[3:])
    assert results[-1].submap == 0
    assert ate_percent(reconstruction.final_trajectory(), truth) < 4.0


def test_a_part_begun_after_a_turn_is_not_taken_for_the_old_one(caplog, monkeypatch):
    # Many tracks survive the turn, but no landmark does, nor do points under small angles replace them.
    monkeypatch.setattr("semcast.server.mapping.map_builder._ENOUGH_SHARE", 0.0)
    truth = turning_away()
    reconstruction = make(lost_after_frames=4)
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


def test_a_place_without_a_pose_gives_nothing_up(room, monkeypatch):
    _, images = room
    reconstruction = make(lost_after_frames=2)
    other = [np.ascontiguousarray(np.rot90(image, 2)) for image in images]
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
    reconstruction = make(lost_after_frames=4)
    other = [np.ascontiguousarray(np.rot90(image, 2)) for image in images]
    posed = Reconstruction._pose_from

    def no_pose_in_the_second_part(self, *args, **how):
        return None if self._map.submap == 1 else posed(self, *args, **how)

    monkeypatch.setattr(Reconstruction, "_pose_from", no_pose_in_the_second_part)
    results = [reconstruction.process(frame_of(k, image)) for k, image in enumerate(images[:8] + other[:14])]
    begun = next(k for k, r in enumerate(results) if r.is_keyframe and r.submap == 1)
    assert [r.state for r in results[begun : begun + 4]] == [TrackingState.LOST] * 4
    assert results[begun + 4].state is TrackingState.INITIALIZING


def test_noise_of_every_kind_is_survived(room):
    _, images = room
    rng = np.random.default_rng(0)
    reconstruction = make(lost_after_frames=2)
    shape = CAMERA.shape_hw
    contents = [
        np.zeros((*shape, 3), np.uint8),
        np.full((*shape, 3), 255, np.uint8),
        rng.integers(0, 256, (*shape, 3), dtype=np.uint8),
        images[0],
        np.tile(np.arange(shape[1], dtype=np.uint8)[None, :, None], (shape[0], 1, 3)),
    ]
    odd = np.full(shape, np.nan, np.float32)
    for k in range(25):
        result = reconstruction.process(
            frame_of(
                k,
                contents[k % 5],
                confidence=odd if k % 2 else None,
                keypoint_confidence=odd if k % 3 else None,
                slot_snr_db=np.full(shape[0] // BLOCK_PX, (np.nan, -20.0, 10.0)[k % 3], np.float32),
            )
        )
        assert np.isfinite(result.keypoint_confidence).all()
    assert all(np.isfinite(T).all() for T in reconstruction.final_trajectory().values())


def test_map_updates_add_up_to_the_map(room):
    _, images = room
    reconstruction = make()
    known = {}
    for k, image in enumerate(images):
        reconstruction.process(frame_of(k, image))
        update = reconstruction.take_map_update()
        if update is not None:
            for i in update.removed.tolist():
                del known[i]
            known.update(zip(update.ids.tolist(), update.xyz, strict=True))
    reconstruction.final_trajectory()
    update = reconstruction.take_map_update()
    if update is not None:
        for i in update.removed.tolist():
            del known[i]
        known.update(zip(update.ids.tolist(), update.xyz, strict=True))
    ids, xyz, _, _ = reconstruction.landmarks()
    assert sorted(known) == ids.tolist()
    assert np.allclose(np.array([known[i] for i in ids.tolist()]), xyz)
    assert reconstruction.take_map_update() is None


def test_a_snapshot_is_gone_on_with(room):
    poses, images = room
    first = make()
    for k in range(14):
        first.process(frame_of(k, images[k]))
    before = first.final_trajectory()
    arrays = first.snapshot()
    assert all(isinstance(a, np.ndarray) and not a.dtype.hasobject for a in arrays.values())
    second = make()
    second.restore(arrays)
    assert all(np.array_equal(before[k], T) for k, T in second.final_trajectory().items())
    results = [second.process(frame_of(k, images[k])) for k in range(14, 20)]
    assert results[-1].state is TrackingState.TRACKING
    trajectory = second.final_trajectory()
    assert len(trajectory) >= 18
    assert ate_percent(trajectory, poses) < 1.5
    with pytest.raises(ValueError, match="counters"):
        make().restore({**arrays, "counters": np.zeros(2)})
    with pytest.raises(ValueError, match="must have 4 and 2 finite values"):
        make().restore({**arrays, "noise": np.array([np.nan, 1.0])})
    with pytest.raises(KeyError):
        make().restore({})


def test_reset_begins_anew(room):
    _, images = room
    reconstruction = make()
    for k in range(6):
        reconstruction.process(frame_of(k, images[k]))
    reconstruction.reset()
    assert reconstruction.final_trajectory() == {}
    results = [reconstruction.process(frame_of(k, images[k])) for k in range(6)]
    assert results[-1].state is TrackingState.TRACKING
    assert results[-1].map_epoch == 1


def test_the_map_stays_bounded_and_the_cost_flat(room):
    _, images = room
    reconstruction = make(max_landmarks=500, max_keyframes=20, max_features=200)
    order = list(range(24)) + list(range(22, 0, -1))
    for frame_id, k in enumerate(order):
        reconstruction.process(frame_of(frame_id, images[k]))
    assert len(reconstruction.landmarks()[0]) <= 500
    assert len(set(reconstruction.observations()[1].tolist())) <= 20
    assert len(reconstruction.final_trajectory()) == len(order)


def test_wrong_shapes_are_refused(room):
    _, images = room
    reconstruction = make()
    with pytest.raises(ValueError, match="image must have shape"):
        reconstruction.process(frame_of(0, images[0][:100]))
    with pytest.raises(ValueError, match="confidence must have shape"):
        reconstruction.process(frame_of(0, images[0], confidence=np.ones((5, 5), np.float32)))


def test_a_camera_with_distortion_is_refused():
    bent = Intrinsics(**{**vars(CAMERA), "distortion": (0.1, 0.0, 0.0, 0.0)})
    with pytest.raises(ValueError, match="without distortion"):
        Reconstruction(bent, ReconstructionSettings(), InlineBundle())
