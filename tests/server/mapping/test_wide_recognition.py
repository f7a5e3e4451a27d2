"""A camera that went on for most of a second is found again by what looks as it did."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from semcast.common.geometry import (
    exp_so3,
    invert_transform,
    make_transform,
    rotation_angle_deg,
    transform_points,
)
from semcast.common.sequence import open_sequence
from semcast.evaluation.scenes.orbit import Orbit
from semcast.evaluation.scenes.render import frame_of
from semcast.server.geometry.grey import to_grey
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.keyframe_images import KeyframeImages
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.wide_recognition import WideRecogniser, _newest_views
from semcast.server.mapping.world_map import WorldMap

NUM_MAPPED = 14
#: Of the still life that is drawn.
SEED = 0
NOISE = NoiseModel(0.7, 0.0)


@pytest.fixture(scope="module")
def mapped(orbit_folder):
    """A still life and its map, made of the first frames; the camera turns by 3.5 degrees a frame."""
    sequence = open_sequence(orbit_folder)
    reconstruction = Reconstruction(sequence.intrinsics, ReconstructionSettings(), InlineBundle())
    for k in range(NUM_MAPPED):
        reconstruction.process(DecodedFrame(k, int(sequence.times_ns[k]), sequence.image(k)))
    yield sequence, reconstruction
    reconstruction.close()


def sight_of(image, frame_id, num_lost_rows=0):
    usable = np.arange(len(image)) >= num_lost_rows
    return Sight(DecodedFrame(frame_id, frame_id * 10**8, image), to_grey(image), usable)


def find(mapped, sight, recogniser=None):
    sequence, reconstruction = mapped
    recogniser = recogniser or WideRecogniser(sequence.intrinsics, seed=0)
    return recogniser.find(sight, reconstruction.world, reconstruction._map.images, NOISE)


@pytest.mark.parametrize("num_lost_rows", [pytest.param(0, marks=pytest.mark.slow), 160])
def test_the_place_is_found_from_20_degrees_on(mapped, num_lost_rows):
    sequence, reconstruction = mapped
    k = NUM_MAPPED + 5
    image = sequence.image(k).copy()
    image[:num_lost_rows] = 128
    place = find(mapped, sight_of(image, k, num_lost_rows))
    assert place is not None
    world, camera = reconstruction.world, sequence.intrinsics
    seen_from = next(n for n in world.keyframes if n.frame_id == place.keyframe_id)
    truth = sequence.groundtruth().T_world_cam
    ours = seen_from.T_world_cam[:3, :3].T @ place.T_world_cam[:3, :3]
    true = truth[place.keyframe_id][:3, :3].T @ truth[k][:3, :3]
    assert rotation_angle_deg(true) > 17.0
    assert rotation_angle_deg(ours.T @ true) < 1.0
    assert len(np.unique(place.ids)) == len(place.ids) > 20
    assert place.proof.num_inliers == len(place.proof.residual_px) == len(place.ids)
    assert place.xy[:, 1].min() > num_lost_rows
    T = invert_transform(place.T_world_cam)
    xyz = world.landmarks.xyz[world.landmarks.rows(place.ids)] @ T[:3, :3].T + T[:3, 3]
    assert np.median(np.linalg.norm(camera.project(xyz) - place.xy, axis=1)) < 1.5


class _Moved(Orbit):
    """The still life from nearer or further away."""

    def __init__(self, further_m: float) -> None:
        super().__init__(SEED, "normal")
        self._further_m = further_m

    def T_world_cam(self, t_s: float) -> np.ndarray:
        T_world_cam = super().T_world_cam(t_s)
        T_world_cam[:3, 3] -= self._further_m * T_world_cam[:3, 2]
        return T_world_cam


@pytest.mark.parametrize("further_m", [-0.6, 2.4])
def test_the_place_is_found_from_where_things_are_twice_as_large_or_half_as_large(mapped, further_m):
    k = NUM_MAPPED + 1
    sequence, reconstruction = mapped
    image = frame_of(_Moved(further_m), 0.1 * k, 1.5, np.random.default_rng(0))
    place = find(mapped, sight_of(image, k))
    assert place is not None
    assert len(place.ids) > 20
    world, camera = reconstruction.world, sequence.intrinsics
    seen_from, truth = world.keyframe(place.keyframe_id), sequence.groundtruth().T_world_cam
    ours = seen_from.T_world_cam[:3, :3].T @ place.T_world_cam[:3, :3]
    assert rotation_angle_deg(ours.T @ truth[place.keyframe_id][:3, :3].T @ truth[k][:3, :3]) < 1.0
    T_cam_world, landmarks = invert_transform(place.T_world_cam), world.landmarks
    points = transform_points(T_cam_world, landmarks.xyz[landmarks.rows(place.ids)])
    before = transform_points(
        invert_transform(seen_from.T_world_cam), landmarks.xyz[landmarks.rows(seen_from.ids)]
    )
    times = np.median(points[:, 2]) / np.median(before[:, 2])
    assert times < 0.65 if further_m < 0.0 else times > 2.0
    assert np.median(np.linalg.norm(camera.project(points) - place.xy, axis=1)) < 1.5


def test_landmarks_that_only_other_keyframes_saw_are_found_too(mapped):
    sequence, reconstruction = mapped
    k = NUM_MAPPED + 5
    place = find(mapped, sight_of(sequence.image(k), k))
    recognised = reconstruction.world.keyframe(place.keyframe_id)
    elsewhere = ~np.isin(place.ids, recognised.ids)
    assert elsewhere.sum() >= 5
    T_cam_world, camera = invert_transform(place.T_world_cam), sequence.intrinsics
    landmarks = reconstruction.world.landmarks
    xyz = transform_points(T_cam_world, landmarks.xyz[landmarks.rows(place.ids[elsewhere])])
    assert np.linalg.norm(camera.project(xyz) - place.xy[elsewhere], axis=1).max() < 3.0


def thinned(world, num_each):
    """The same map with so many landmarks for each keyframe, others for each."""
    world = deepcopy(world)
    for k, keyframe in enumerate(world.keyframes):
        known = np.flatnonzero(world.landmarks.rows(keyframe.ids) >= 0)
        rows = known[k :: len(known) // num_each][:num_each]
        for name in ("ids", "xy", "confidence", "edge"):
            setattr(keyframe, name, getattr(keyframe, name)[rows])
    return world


@pytest.mark.parametrize("further", [1, 2])
def test_the_place_is_found_by_a_few_matches_with_each_of_several_keyframes(mapped, further):
    """Where those of no single one are enough."""
    sequence, reconstruction = mapped
    k = NUM_MAPPED + further
    world, images = thinned(reconstruction.world, 14), reconstruction._map.images
    sight = sight_of(sequence.image(k), k)
    place = WideRecogniser(sequence.intrinsics, seed=0).find(sight, world, images, NOISE)
    true = find(mapped, sight).T_world_cam
    assert rotation_angle_deg(place.T_world_cam[:3, :3].T @ true[:3, :3]) < 0.5
    for image in images.newest(5):
        alone = KeyframeImages(3)
        alone.append(image)
        assert WideRecogniser(sequence.intrinsics, seed=0).find(sight, world, alone, NOISE) is None


def test_what_several_keyframes_match_in_one_spot_is_no_rough_pose(mapped):
    """All of it may be one wrong match."""
    sequence, reconstruction = mapped
    world, images = reconstruction.world, reconstruction._map.images
    newest = world.keyframes[-1]
    image, spot = sequence.image(newest.frame_id), np.full_like(sequence.image(0), 90)
    recogniser, views = WideRecogniser(sequence.intrinsics, seed=0), _newest_views(world, images)
    spot[310:350, 290:330] = image[310:350, 290:330]
    for shown, is_found in ((image, True), (spot, False)):
        found = recogniser._search(sight_of(shown, NUM_MAPPED), views, NOISE, None)
        assert (found is not None) == is_found


def test_another_place_is_not_taken_for_it(mapped):
    image = mapped[0].image(NUM_MAPPED)
    for other in (image[:, ::-1].copy(), np.random.default_rng(0).permutation(image), image // 255 + 90):
        assert find(mapped, sight_of(other, NUM_MAPPED)) is None


def test_what_is_not_found_in_eight_frames_is_not_looked_for_any_more(mapped):
    sequence, _ = mapped
    recogniser = WideRecogniser(sequence.intrinsics, seed=0)
    nothing = sight_of(np.full_like(sequence.image(0), 90), NUM_MAPPED)
    seen = sight_of(sequence.image(NUM_MAPPED), NUM_MAPPED)
    for _ in range(7):
        assert find(mapped, nothing, recogniser) is None
    assert find(mapped, seen, recogniser) is not None
    assert find(mapped, seen, recogniser) is None


def test_a_keyframe_whose_landmarks_are_all_gone_is_no_place(mapped):
    sequence, reconstruction = mapped
    world, images = WorldMap(), reconstruction._map.images
    for known in reconstruction.world.keyframes:
        world.add_keyframe(replace(known))
    sight = sight_of(sequence.image(NUM_MAPPED), NUM_MAPPED)
    recogniser = WideRecogniser(sequence.intrinsics, seed=0)
    assert recogniser.find(sight, world, images, NOISE, world.keyframes[-1].T_world_cam) is None


def look(mapped, sight, T_world_cam):
    sequence, reconstruction = mapped
    recogniser = WideRecogniser(sequence.intrinsics, seed=0)
    return recogniser.look(sight, reconstruction.world, reconstruction._map.images, NOISE, T_world_cam)


def test_a_pose_that_is_nearly_right_is_proved_by_how_things_look_there_and_another_is_not(mapped):
    """A degree off it is put right; one that looks at something else is refused."""
    sequence, _ = mapped
    k = NUM_MAPPED + 3
    sight = sight_of(sequence.image(k), k)
    true = find(mapped, sight).T_world_cam
    for turn_rad in ((0.0, 0.02, 0.0), (0.01, 0.01, 0.01)):
        place = look(mapped, sight, true @ make_transform(exp_so3(turn_rad), np.zeros(3)))
        assert place is not None
        assert len(place.ids) > 100
        assert rotation_angle_deg(place.T_world_cam[:3, :3].T @ true[:3, :3]) < 0.2
    assert look(mapped, sight, true @ make_transform(exp_so3((0.0, 0.2, 0.0)), np.zeros(3))) is None
