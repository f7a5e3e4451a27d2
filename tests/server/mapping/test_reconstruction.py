"""The whole core on rendered sequences of textured planes, without any data files."""

import numpy as np
import pytest
from drawn_boards import CAMERA, ate_percent, frame_of, make, render

from semcast.common.camera import Intrinsics
from semcast.common.geometry import (
    exp_so3,
    invert_transform,
    make_transform,
)
from semcast.common.phy.slots import BLOCK_PX
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.bundle_process import ProcessBundle
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.state import DecodedFrame, TrackingState


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
    seen, frames, xy = reconstruction.world.observations()
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
    early, keyframes_known, landmarks_told = {}, {}, {}

    def tell(found):
        early[found.frame_id] = found
        seen = reconstruction.world.observations()[1]
        keyframes_known[found.frame_id] = found.frame_id in seen
        landmarks_told[found.frame_id] = found.frame_id in reconstruction.world.landmarks.last_seen

    results = [reconstruction.process(frame_of(k, image), tell) for k, image in enumerate(images)]
    located = [r for r in results if r.state is TrackingState.TRACKING and not r.backfilled]
    assert sorted(early) == [r.frame_id for r in located]
    assert not any(keyframes_known.values())
    assert not any(landmarks_told.values()), "what landmarks were seen is noted when nobody waits"
    assert any(r.is_keyframe for r in located)
    for after in located:
        before = early[after.frame_id]
        assert (before.is_keyframe, before.submap) == (after.is_keyframe, after.submap)
        assert "map" not in before.stage_ms
        moved = np.linalg.norm(before.T_world_cam[:3, 3] - after.T_world_cam[:3, 3])
        assert moved < 0.01
        assert after.is_keyframe or moved < 1e-12


def test_an_adjustment_applied_before_the_next_frame_comes_changes_nothing_for_that_frame(room):
    _, images = room
    waiting, spared = make(), make()
    num_moved = 0
    for k, image in enumerate(images[:14]):
        one, other = (r.process(frame_of(k, image)) for r in (waiting, spared))
        np.testing.assert_array_equal(one.T_world_cam, other.T_world_cam)
        assert one.stage_ms.keys() == other.stage_ms.keys(), "what was done before counts for the frame"
        before = spared.world.trajectory()
        spared.collect()
        after = spared.world.trajectory()
        num_moved += any(not np.array_equal(before[i], after[i]) for i in before)
    assert num_moved
    ends = [r.final_trajectory() for r in (waiting, spared)]
    assert all(np.array_equal(ends[0][i], ends[1][i]) for i in ends[0])


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


@pytest.mark.parametrize("solver", ["dense", "gtsam"])
def test_windows_are_adjusted_by_the_solver_that_is_asked_for(room, monkeypatch, solver):
    _, images = room
    asked, submit = [], InlineBundle.submit
    monkeypatch.setattr(InlineBundle, "submit", lambda self, p: asked.append(p.solver) or submit(self, p))
    run(images[:12], make(bundle_solver=solver))
    assert len(asked) > 2
    assert set(asked) == {solver}


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


def test_times_that_hardly_go_on_cost_no_pose(room):
    poses, images = room
    reconstruction = make()
    for k, image in enumerate(images):  # two images each time, a nanosecond apart
        reconstruction.process(DecodedFrame(k, k // 2 * 200_000_000 + k % 2, image))
    trajectory = reconstruction.final_trajectory()
    assert sorted(trajectory) == list(range(len(images)))
    assert ate_percent(trajectory, poses) < 1.0


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
    assert all(r.T_world_cam is None for r in results[14:24])
    assert results[24].state is TrackingState.TRACKING
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
        assert result.state is TrackingState.TRACKING
        assert (result.T_world_cam, result.num_tracked, len(result.keypoints_xy)) == (None, 0, 0)
    assert results[20].state is TrackingState.TRACKING
    one, other = with_them.final_trajectory(), without.final_trajectory()
    assert one.keys() == other.keys()
    np.testing.assert_array_equal(np.stack(list(one.values())), np.stack(list(other.values())))


def test_noise_of_every_kind_is_survived(room):
    _, images = room
    rng = np.random.default_rng(0)
    reconstruction = make(lost_after_s=0.05)
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
        assert np.isfinite(result.keypoints_xy).all()
    assert reconstruction.final_trajectory() == {}, "nothing of it shows a movement"


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
    assert len(set(reconstruction.world.observations()[1].tolist())) <= 20
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
