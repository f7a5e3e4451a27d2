"""Tracks through changes of light: of exposure at once, little by little, and of those that coast."""

from dataclasses import replace

import numpy as np
import pytest
from shifted_texture import begin, sight_at

from semcast.server.geometry.brightness import brightness_change, with_brightness
from semcast.server.geometry.flicker import with_row_gains


def darker(sight, gain):
    """The same sight through a shorter exposure."""
    return replace(sight, grey=with_brightness(sight.grey, gain, 0.0))


@pytest.mark.parametrize(
    ("gains", "most_px"),
    [
        ([1.25], 0.18),
        ([0.7], 0.28),
        ([1.25, 0.7, 1.25], 0.18),
        (list(np.linspace(0.95, 0.5, 10)), 0.5),
        ([0.97, 1.2, 0.8, 1.3], 0.16),
    ],
)
def test_tracks_are_where_they_should_be_after_changes_of_light(gains, most_px):
    tracks = begin()
    first = darker(sight_at(20), 0.7)
    tracks.replace_newest(first)
    ids, xy = tracks.ids, tracks.xy
    for k, gain in enumerate(gains, 1):
        tracks.follow(darker(sight_at(20 + 3 * k), 0.7 * gain), tracks.xy + tracks.velocity)
    stays = xy[:, 0] > 3 * len(gains) + 20
    seen = stays & np.isin(ids, tracks.ids[tracks.visible])
    assert seen.sum() > 0.95 * stays.sum()
    off = tracks.xy[np.searchsorted(tracks.ids, ids[seen])] - (xy[seen] - (3 * len(gains), 0))
    assert np.median(np.linalg.norm(off, axis=1)) < most_px


def test_tracks_that_coast_are_followed_through_the_change_of_light_that_the_others_tell(monkeypatch):
    tracks, asked = begin(), []

    def counted(*images_and_points):
        asked.append(len(images_and_points[2]))
        return brightness_change(*images_and_points)

    monkeypatch.setattr("semcast.server.geometry.klt.brightness_change", counted)
    in_band = (tracks.xy[:, 1] > 70) & (tracks.xy[:, 1] < 88)
    band_ids, band_xy = tracks.ids[in_band], tracks.xy[in_band]
    assert 5 <= len(band_ids) < 20, "so few tell no change themselves"
    tracks.follow(darker(sight_at(23, lost=(4, 5)), 0.8), tracks.xy)
    asked.clear()
    tracks.follow(darker(sight_at(26), 0.5), tracks.xy + tracks.velocity)
    came = np.isin(band_ids, tracks.ids[tracks.visible])
    assert came.mean() > 0.6
    off = tracks.xy[np.searchsorted(tracks.ids, band_ids[came])] - (band_xy[came] - (6, 0))
    assert np.median(np.linalg.norm(off, axis=1)) < 0.3
    assert min(asked) > len(band_ids), "those are not asked"


@pytest.mark.parametrize("gain", [0.8, 0.5])
def test_a_few_tracks_that_are_left_do_not_tell_the_light_for_those_that_coast(gain):
    tracks = begin()
    ids, xy = tracks.ids, tracks.xy
    tracks.follow(sight_at(23, lost=range(1, 11)), tracks.xy)
    assert 0 < tracks.visible.sum() < 20 < (tracks.missed == 1).sum()
    tracks.follow(darker(sight_at(26), gain), tracks.xy + tracks.velocity)
    came = np.isin(ids, tracks.ids[tracks.visible])
    assert came.mean() > 0.9
    off = tracks.xy[np.searchsorted(tracks.ids, ids[came])] - (xy[came] - (6, 0))
    assert np.median(np.linalg.norm(off, axis=1)) < 0.25


def under_lamp(sight, depth, phase):
    """The same sight with bands of light across it, as a rolling shutter has it under a flickering lamp."""
    height = len(sight.grey)
    light = 1 - depth + depth * np.sin(2 * np.pi * 1.5 * np.arange(height) / height + phase)
    return replace(sight, grey=with_row_gains(sight.grey, light))


@pytest.mark.parametrize("depth", [0.1, 0.2])
def test_tracks_go_on_under_a_lamp_that_flickers(depth):
    tracks = begin()
    tracks.replace_newest(under_lamp(sight_at(20), depth, 0.0))
    ids, xy = tracks.ids, tracks.xy
    for k in range(1, 5):
        tracks.follow(under_lamp(sight_at(20 + 3 * k), depth, 2.0 * k), tracks.xy + tracks.velocity)
    stays = xy[:, 0] > 3 * 4 + 20
    seen = stays & np.isin(ids, tracks.ids[tracks.visible])
    assert seen.sum() > 0.95 * stays.sum()
    off = tracks.xy[np.searchsorted(tracks.ids, ids[seen])] - (xy[seen] - (12, 0))
    assert np.median(np.linalg.norm(off, axis=1)) < 0.12
