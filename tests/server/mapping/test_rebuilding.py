"""The newest keyframes of a map that went wrong, built anew."""

import logging

import numpy as np
import pytest
from bent_map import CAMERA, FIRST_BENT, NUM_KEYFRAMES, bent_poses, make_map, true_poses
from drawn_boards import ate_percent, frame_of, make, render, sideways

from semcast.common.geometry import invert_transform, make_transform, rotation_angle_deg
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping import rebuilding, reconstruction
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.contradiction import Contradiction
from semcast.server.mapping.keyframe_images import ImagedMap, KeyframeImages
from semcast.server.mapping.map_builder import MapBuilder
from semcast.server.mapping.rebuilding import bring_in, put_straight, rebuild
from semcast.server.mapping.settings import ReconstructionSettings

NOISE = NoiseModel(0.3, 0.0)


def rebuilt(world, submap=0):
    return rebuild(ImagedMap(CAMERA, world, KeyframeImages(3), submap), NOISE, ReconstructionSettings())


def errors(poses):
    """Largest distance and turn between ``poses`` by frame id and the truth."""
    truth = true_poses()
    off = [invert_transform(truth[k // 2]) @ T for k, T in poses.items()]
    return max(np.linalg.norm(T[:3, 3]) for T in off), max(rotation_angle_deg(T[:3, :3]) for T in off)


@pytest.mark.parametrize("seed", range(3))
def test_a_path_that_was_taken_for_a_turn_is_put_right(seed):
    world = make_map(bent_poses(), seed=seed)
    away, turned_deg = errors(world.poses)
    assert away > 0.3
    assert turned_deg > 10.0
    bring_in(world, rebuilt(world), 0)
    away, turned_deg = errors(world.poses)
    assert away < 0.02
    assert turned_deg < 0.5


def test_a_right_map_stays():
    assert rebuilt(make_map(true_poses())) is None


def test_the_unit_is_that_of_landmarks_the_first_keyframes_saw():
    world = make_map(bent_poses())
    found = rebuilt(world)
    since = min(found.T_world_cam)
    assert since < 2 * FIRST_BENT
    for keyframe in world.keyframes:
        T = keyframe.T_world_cam
        world.move_keyframe(keyframe.frame_id, make_transform(T[:3, :3], 3.0 * T[:3, 3]))
    world.move_landmarks(world.landmarks.ids.copy(), 3.0 * world.landmarks.xyz)
    in_larger_unit = rebuilt(world)
    for frame_id, T in in_larger_unit.T_world_cam.items():
        np.testing.assert_allclose(T[:3, 3], 3.0 * found.T_world_cam[frame_id][:3, 3], atol=0.02)


def test_landmarks_move_or_go_and_frames_take_over_the_scale():
    world = make_map(bent_poses())
    newest_id = world.keyframes[-1].frame_id
    world.frames[newest_id + 1] = (newest_id, make_transform(np.eye(3), (0.01, 0.0, 0.0)))
    truth = world.landmarks.xyz.copy()
    is_seen_late = truth[:, 0] > 1.6
    world.move_landmarks(world.landmarks.ids[is_seen_late], truth[is_seen_late] + 0.5)
    old, young, elsewhere = 5001, 5002, 5003
    xyz, rgb = np.ones((2, 3)), np.zeros((2, 3), np.uint8)
    world.add_landmarks(np.array([old, young]), xyz, rgb, np.ones(2), 0, np.array([-2, 2 * FIRST_BENT]))
    world.add_landmarks(np.array([elsewhere]), xyz[:1], rgb[:1], np.ones(1), 1, 2 * FIRST_BENT)
    found = rebuilt(world)
    bring_in(world, found, 0)
    assert old in world.landmarks.ids, "that of an older keyframe stays"
    assert young not in world.landmarks.ids
    assert elsewhere in world.landmarks.ids, "that of another part stays"
    known = found.ids[np.isin(found.ids, world.landmarks.ids)]
    off = np.linalg.norm(world.landmarks.xyz_of(known) - truth[known // 2], axis=1)
    assert np.percentile(off, 90) < 0.05
    step = np.linalg.norm(world.frames[newest_id + 1][1][:3, 3])
    assert step == pytest.approx(0.01 / 0.4, rel=0.2), "in a unit that is so many times as large"


def test_keyframes_that_share_too_little_are_left_alone():
    world = make_map(bent_poses())
    for number, keyframe in enumerate(world.keyframes):
        keyframe.drop_observations(keyframe.ids % NUM_KEYFRAMES != number)
    assert rebuilt(world) is None


def test_a_running_reconstruction_goes_on_from_what_was_built_anew(monkeypatch, caplog):
    asked = []

    def look(self, world, submap):
        asked.append(world.keyframes[-1].frame_id)
        return len(asked) % 2 == 0

    monkeypatch.setattr(Contradiction, "look", look)
    monkeypatch.setattr(rebuilding, "_CLEAR_RATIO", 0.0)  # what is found takes the place of a right map
    truth, core = sideways(40), make()
    with caplog.at_level(logging.INFO, logger=reconstruction.logger.name):
        results = [core.process(frame_of(k, render(T))) for k, T in enumerate(truth)]
    told = [r.getMessage() for r in caplog.records if r.name == reconstruction.logger.name]
    rebuilt_at = asked[1::2]
    assert len(rebuilt_at) >= 2
    for frame_id in rebuilt_at:
        assert any(text.startswith(f"frame {frame_id}: the map went wrong since frame") for text in told)
    assert all(r.T_world_cam is not None for r in results[rebuilt_at[0] :])
    at_once = {r.frame_id: r.T_world_cam for r in results if r.T_world_cam is not None}
    assert ate_percent(at_once, truth) < 1.0
    assert ate_percent(core.final_trajectory(), truth) < 0.5


def test_frames_stay_near_keyframes_where_the_map_took_the_whole_way_for_a_turn():
    poses = bent_poses()
    rng = np.random.default_rng(0)
    for T in poses[FIRST_BENT:]:
        T[:3, 3] = poses[FIRST_BENT - 1][:3, 3] + 1e-5 * rng.standard_normal(3)
    world = make_map(poses)
    middle_id = 2 * (FIRST_BENT + 3)
    world.frames[middle_id + 1] = (middle_id, make_transform(np.eye(3), (0.002, 0.0, 0.0)))
    bring_in(world, rebuilt(world), 0)
    assert errors(world.poses)[0] < 0.05
    step = np.linalg.norm(world.frames[middle_id + 1][1][:3, 3])
    assert step == pytest.approx(0.002), "how short ways change is chance"


def test_keyframes_that_were_thinned_out_go_with_those_before_them():
    world = make_map(bent_poses())
    thinned_ids = [2 * (NUM_KEYFRAMES - 2), 2 * (NUM_KEYFRAMES - 4)]
    world.keyframes = [k for k in world.keyframes if k.frame_id not in thinned_ids]
    before = {k: world.poses[k] for k in thinned_ids}
    world.take_changes()
    bring_in(world, rebuilt(world), 0)
    assert set(thinned_ids) < set(world.take_changes().keyframes.tolist())
    for frame_id, T_world_cam in before.items():
        assert errors({frame_id: T_world_cam})[0] > 0.25
        away, turned_deg = errors({frame_id: world.poses[frame_id]})
        assert away < 0.03
        assert turned_deg < 2.5


class Says(Contradiction):
    """Is asked once, and told what came of it."""

    def __init__(self, says):
        super().__init__(CAMERA, seed=0)
        self._says_so, self.noted = says, []

    def look(self, world, submap):
        return self._says_so

    def note(self, *, was_right):
        self.noted.append(was_right)


@pytest.mark.parametrize(
    ("says", "poses", "noted"),
    [(False, bent_poses, []), (True, true_poses, [False]), (True, bent_poses, [True])],
)
def test_the_adjustment_under_way_is_waited_for_where_the_map_may_be_wrong(says, poses, noted):
    world, contradiction, settled = make_map(poses()), Says(says), []
    mapped = ImagedMap(CAMERA, world, KeyframeImages(3), 0)

    def settle():
        settled.append({k: T.copy() for k, T in world.poses.items()})

    before = {k: T.copy() for k, T in world.poses.items()}
    moved = put_straight(contradiction, mapped, NOISE, ReconstructionSettings(), settle=settle)
    assert contradiction.noted == noted
    assert len(settled) == says
    for poses_then in settled:
        np.testing.assert_equal(poses_then, before)
    assert bool(moved) == (noted == [True])
    if not moved:
        np.testing.assert_equal(world.poses, before)


def test_a_growing_map_is_put_right_as_soon_as_it_is_contradicted():
    whole = make_map(bent_poses())
    marks, image = whole.landmarks, np.zeros((*CAMERA.shape_hw, 3), np.uint8)
    settings = ReconstructionSettings(sigma0_px=0.3)
    builder = MapBuilder(CAMERA, settings, InlineBundle(), on_moved=lambda scale: None)
    world, builder.num_inliers_at_keyframe = builder.world, 5000
    world.add_landmarks(marks.ids, marks.xyz, np.zeros((len(marks), 3), np.uint8), marks.confidence, 0, 0)
    for keyframe in whole.keyframes:
        world.add_keyframe(keyframe)
        moved = builder.put_straight(image)
        if moved:
            break
    assert FIRST_BENT + 1 < len(world.keyframes) <= FIRST_BENT + 5
    assert moved == world.keyframes[-len(moved) :]
    assert moved[0].frame_id < 2 * FIRST_BENT
    away, turned_deg = errors(world.poses)
    assert away < 0.02
    assert turned_deg < 0.5
    assert world.drift.of(moved[-1].frame_id) is not None, "it was adjusted"
    num_seen = int((world.landmarks.rows(moved[-1].ids) >= 0).sum())
    assert num_seen > int(np.isin(moved[-1].ids, marks.ids).sum()), "tracks are landmarks as well"
    assert builder.num_inliers_at_keyframe == pytest.approx(num_seen, rel=0.05)
