"""Whether tracks contradict the newest keyframes of a map."""

import numpy as np
import pytest
from bent_map import CAMERA, FIRST_BENT, NUM_KEYFRAMES, bent_poses, make_map, true_poses

from semcast.server.mapping.contradiction import Contradiction
from semcast.server.mapping.world_map import WorldMap


def as_it_grows(world, watch=None):
    """Number of the keyframes at which the map is contradicted."""
    watch = watch or Contradiction(CAMERA, seed=0)
    grown, said = WorldMap(), []
    marks = world.landmarks
    grown.add_landmarks(marks.ids, marks.xyz, np.zeros((len(marks), 3), np.uint8), np.ones(len(marks)), 0, 0)
    for number, keyframe in enumerate(world.keyframes):
        grown.add_keyframe(keyframe)
        if watch.look(grown, 0):
            said.append(number)
    return said


def test_a_right_map_is_not_contradicted():
    for noise_px in (0.1, 0.4, 0.8):
        assert as_it_grows(make_map(true_poses(), noise_px=noise_px)) == []


def test_a_map_that_takes_a_way_for_a_turn_is_contradicted_within_five_keyframes():
    for seed in range(3):
        said = as_it_grows(make_map(bent_poses(), seed=seed))
        assert FIRST_BENT + 1 < said[0] <= FIRST_BENT + 4
        assert said == list(range(said[0], NUM_KEYFRAMES))


@pytest.mark.parametrize("movers_of_3", [1, 2])
def test_something_that_moves_by_itself_contradicts_nothing(movers_of_3):
    """Two of three tracks on it tell another motion than the map, but the landmarks do not."""
    assert as_it_grows(make_map(true_poses(), mover_px=4.0, movers_of_3=movers_of_3)) == []


def test_few_tracks_contradict_nothing():
    world = make_map(bent_poses())
    for keyframe in world.keyframes:
        keyframe.drop_observations(keyframe.ids % 8 > 0)
    assert as_it_grows(world) == []


def test_where_nothing_better_was_found_it_is_asked_again_later():
    world = make_map(bent_poses())
    first = as_it_grows(world)[0]
    watch = Contradiction(CAMERA, seed=0)
    short = make_map(bent_poses())
    short.keyframes = short.keyframes[: first + 1]
    assert as_it_grows(short, watch) == [first]
    watch.note(was_right=False)
    asked = [watch.look(world, 0) for _ in range(12)]
    assert asked == [False] * 8 + [True] * 4, "six keyframes without a look, and three that agree"
    watch.note(was_right=False)
    assert [watch.look(world, 0) for _ in range(15)] == [False] * 14 + [True], "twice as many"
    watch.note(was_right=True)
    assert [watch.look(world, 0) for _ in range(3)] == [False, False, True]
    for _ in range(2000):
        watch.note(was_right=False)
    assert sum(watch.look(world, 0) for _ in range(200)) > 1, "but not for ever"
