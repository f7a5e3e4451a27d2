"""A place is recognised by enough landmarks, and not by a chance find of a few."""

from dataclasses import replace

import numpy as np
import pytest
from textures import texture

from semcast.common.camera import Intrinsics
from semcast.server.geometry.corners import detect_corners
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.relocalisation import _NUM_COMPARED, Relocaliser, _likeliest
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.world_map import Keyframe, WorldMap

CAMERA = Intrinsics(fx=300.0, fy=300.0, cx=160.0, cy=120.0, width=320, height=240)
NOISE = NoiseModel(1.0, 0.0)


GREY = texture((240, 320), (1.5, 4.0, 9.0), 5)
SIGHT = Sight(DecodedFrame(1, 10**8, np.repeat(GREY[..., None], 3, axis=2)), GREY, np.ones(240, bool))


def wall(relocaliser, num_landmarks, looks_alike=lambda xy: np.ones(len(xy), bool)):
    """A map of one keyframe that sees landmarks on a wall at distance 1.

    Landmarks that don't look alike have descriptors of something else.
    """
    corners = detect_corners(GREY, 800, None, None, 40).astype(np.float64)
    ids = np.arange(len(corners))
    described, descriptors = relocaliser.describe(GREY, ids, corners)
    chosen = described[np.linspace(0, len(described) - 1, num_landmarks).astype(int)]
    chosen_descriptors = descriptors[np.isin(described, chosen)]
    other = ~looks_alike(corners[chosen])
    chosen_descriptors[other] = np.random.default_rng(1).integers(0, 256, (other.sum(), 32), np.uint8)
    world = WorldMap()
    world.add_keyframe(
        Keyframe(
            frame_id=0,
            t_source_ns=0,
            T_world_cam=np.eye(4),
            submap=0,
            ids=chosen,
            xy=corners[chosen],
            confidence=np.ones(num_landmarks),
            descriptor_ids=chosen,
            descriptors=chosen_descriptors,
        )
    )
    colour = np.zeros((num_landmarks, 3), np.uint8)
    world.add_landmarks(chosen, CAMERA.unproject(corners[chosen]), colour, np.ones(num_landmarks), 0, 0)
    return world


def test_a_place_is_recognised():
    relocaliser = Relocaliser(CAMERA, 0, 500)
    place = relocaliser.find(SIGHT, wall(relocaliser, 120), NOISE)
    assert place is not None
    assert len(place.ids) > 80
    np.testing.assert_allclose(place.T_world_cam, np.eye(4), atol=0.01)


@pytest.mark.parametrize(("max_features", "is_enough"), [(100, True), (500, False)])
def test_thirty_landmarks_are_enough_only_where_few_are_followed(max_features, is_enough):
    relocaliser = Relocaliser(CAMERA, 0, max_features)
    place = relocaliser.find(SIGHT, wall(relocaliser, 32), NOISE)
    assert (place is not None) is is_enough


@pytest.mark.parametrize(
    ("looks_alike", "is_place"),
    [
        (lambda xy: np.arange(len(xy)) % 5 == 0, True),
        (lambda xy: abs(xy[:, 0] - 160) < 32, False),
        (lambda xy: abs(xy[:, 0] - 160) < 96, True),
    ],
    ids=["a fifth of everything", "all of a house and nothing around it", "more than half"],
)
def test_a_house_like_another_is_no_place(looks_alike, is_place):
    relocaliser = Relocaliser(CAMERA, 0, 200)
    world = wall(relocaliser, 300, looks_alike)
    assert looks_alike(world.keyframes[0].xy).sum() > 30
    assert (relocaliser.find(SIGHT, world, NOISE) is not None) == is_place


def test_all_keyframes_have_their_turn_and_of_those_the_likeliest_is_looked_at(rng):
    """The place is the first of 91 keyframes: forty at a time, from the newest on, it is in the third."""
    relocaliser = Relocaliser(CAMERA, 0, 500)
    world = wall(relocaliser, 120)
    place = world.keyframes[0]
    for k in range(1, 91):
        world.add_keyframe(
            replace(
                place,
                frame_id=k,
                ids=place.ids + 1000 * k,
                descriptor_ids=place.ids + 1000 * k,
                descriptors=rng.integers(0, 256, place.descriptors.shape, dtype=np.uint8),
            )
        )
    found = [relocaliser.find(SIGHT, world, NOISE) for _ in range(3)]
    assert [place and place.keyframe_id for place in found] == [None, None, 0]


def test_a_likely_keyframe_is_told_by_as_many_descriptors_as_may_be_compared(rng):
    descriptors = rng.integers(0, 256, (_NUM_COMPARED, 32), np.uint8)
    known = Keyframe(0, 0, np.eye(4), 0, *(np.zeros(0) for _ in range(3)), descriptors=descriptors[1::2])
    assert _likeliest([known], descriptors) == [known]


def test_another_image_is_no_place():
    relocaliser = Relocaliser(CAMERA, 0, 100)
    world = wall(relocaliser, 120)
    other = np.ascontiguousarray(GREY[::-1, ::-1])
    sight = Sight(DecodedFrame(1, 10**8, np.repeat(other[..., None], 3, axis=2)), other, np.ones(240, bool))
    assert relocaliser.find(sight, world, NOISE) is None
