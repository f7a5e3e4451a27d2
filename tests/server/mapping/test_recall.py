"""Landmarks that lost their track are looked for again, in the keyframes that saw them last."""

from dataclasses import replace

import numpy as np
import pytest
from shifted_texture import CAMERA, mapped_wall, pose_at, sight_at

from semcast.server.geometry import klt
from semcast.server.geometry.brightness import with_brightness
from semcast.server.mapping.keyframe_images import ImagedMap, SeenFrom
from semcast.server.mapping.recall import recall_landmarks


@pytest.fixture
def mapped():
    return mapped_wall()


def recall(mapped, sight, x, reach_px=6.0, wanted=1000, submap=0):
    world, images, tracks = mapped
    imaged = ImagedMap(CAMERA, world, images, submap)
    found = recall_landmarks(imaged, tracks, sight, pose_at(x), reach_px=reach_px, wanted=wanted)
    assert np.isin(found, tracks.ids).all()
    return len(found)


def test_lost_landmarks_get_their_tracks_back(mapped):
    _, _, tracks = mapped
    ids, xy = tracks.ids.copy(), tracks.xy.copy()
    tracks.keep(np.arange(len(tracks)) % 4 == 0)
    kept = tracks.ids.copy()
    sight = sight_at(30, frame_id=1)
    tracks.follow(sight, tracks.xy - (10, 0))
    found = recall(mapped, sight, 30)
    assert found > 0.5 * (len(ids) - len(kept))
    assert np.all(np.diff(tracks.ids) > 0)
    back = ~np.isin(tracks.ids, kept)
    assert back.sum() == found
    where = xy[np.searchsorted(ids, tracks.ids[back])] - (10, 0)
    assert np.abs(tracks.xy[back] - where).max() < 1.0
    assert recall(mapped, sight, 30) == 0, "those found have a track now"


@pytest.mark.parametrize("gain", [0.6, 1.3])
def test_landmarks_are_found_in_another_light_at_once_where_tracks_tell_it(mapped, monkeypatch, gain):
    _, _, tracks = mapped
    search, searched = klt._search, []

    def counted(grey0, grey1, xy0, *how):
        searched.append(len(xy0))
        return search(grey0, grey1, xy0, *how)

    sight = sight_at(24, frame_id=1)
    sight = replace(sight, grey=with_brightness(sight.grey, gain, 0.0))
    tracks.follow(sight, tracks.xy - (4, 0))
    tracks.keep(np.arange(len(tracks)) % 2 == 0)
    assert len(tracks) > 40
    monkeypatch.setattr(klt, "_search", counted)
    found = recall(mapped, sight, 24)
    assert found > 0.7 * searched[0]
    assert len(searched) == 1


def test_where_no_track_is_left_the_lost_ones_tell_the_light_themselves(mapped):
    _, _, tracks = mapped
    count = len(tracks)
    tracks.keep(np.zeros(count, bool))
    sight = sight_at(24, frame_id=1)
    assert recall(mapped, replace(sight, grey=with_brightness(sight.grey, 0.6, 0.0)), 24) > 0.7 * count


def test_older_keyframes_are_not_looked_at_once_enough_is_found(mapped):
    world, images, tracks = mapped
    old = world.keyframes[0]
    half = np.arange(len(old.ids)) % 2 == 0
    newer = replace(old, frame_id=1)
    newer.drop_observations(~half)
    world.add_keyframe(newer)
    images.append(SeenFrom(1, images.newest(1)[0].grey))
    before = world.keyframes[-1].ids
    sight = sight_at(24, frame_id=2)
    tracks.keep(np.zeros(len(tracks), bool))
    in_newest = recall(mapped, sight, 24, wanted=1)
    assert in_newest > 20
    for share, only_newest in ((1.0, True), (0.6, False)):
        tracks.keep(np.zeros(len(tracks), bool))
        assert recall(mapped, sight, 24, wanted=round(in_newest / share)) >= in_newest
        assert np.isin(tracks.ids, before).all() == only_newest


def test_a_wrong_pose_finds_next_to_nothing(mapped):
    _, _, tracks = mapped
    count = len(tracks)
    tracks.keep(np.zeros(count, bool))
    sight = sight_at(30, frame_id=1)
    assert recall(mapped, sight, 75) < 0.05 * count


def test_nothing_is_found_where_nothing_arrived(mapped):
    world, _, tracks = mapped
    tracks.keep(np.zeros(len(tracks), bool))
    sight = sight_at(24, frame_id=1, lost=(3, 4, 5, 6))
    assert recall(mapped, sight, 24) > 0
    assert not np.any((tracks.xy[:, 1] > 48) & (tracks.xy[:, 1] < 112))
    tracks.keep(np.zeros(len(tracks), bool))
    world.landmarks.keep(np.zeros(len(world.landmarks), bool))
    assert recall(mapped, sight_at(24, frame_id=2), 24) == 0


def test_landmarks_of_another_submap_stay_where_they_are(mapped):
    _, _, tracks = mapped
    tracks.keep(np.zeros(len(tracks), bool))
    assert recall(mapped, sight_at(24, frame_id=1), 24, submap=1) == len(tracks) == 0
