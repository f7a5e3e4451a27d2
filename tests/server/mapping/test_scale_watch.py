"""Whether a keyframe holds the scale of those before, and what is said where it hardly does."""

import logging

import numpy as np
import pytest
from cloud_of_points import CAMERA, NOISE, make_world, put_landmarks
from drawn_boards import frame_of, make, render

from semcast.common.geometry import angles_between_deg, make_transform
from semcast.server.mapping.scale_watch import ScaleWatch, handover_error


def world_with(num_landmarks, num_keyframes=4, off_px=0.0):
    """Tracks of which the first have landmarks; the others are off in the newest keyframe."""
    world, points, _ = make_world(num_keyframes=num_keyframes, noise_px=0.0)
    put_landmarks(world, points[:num_landmarks])
    off = np.random.default_rng(1).normal(0.0, off_px, (len(points) - num_landmarks, 2))
    world.keyframes[-1].xy[num_landmarks:] += off
    return world, points


def test_the_error_is_that_of_all_depths_together():
    world, points = world_with(30, num_keyframes=3)
    first, second = (k.T_world_cam[:3, 3] for k in world.keyframes[:2])
    angle = np.radians(angles_between_deg(points[:30] - first, points[:30] - second))
    depth_error = np.sqrt(2.0) * NOISE.sigma0_px / (CAMERA.fx * angle)
    expected = (depth_error**-2.0).sum() ** -0.5
    assert handover_error(world, CAMERA, NOISE) == pytest.approx(expected, rel=1e-6)


def test_tracks_off_their_epipolar_lines_make_it_worse():
    good, bad = (handover_error(world_with(30, off_px=off)[0], CAMERA, NOISE) for off in (0.0, 8.0))
    assert 5.0 * good < bad < 30.0 * good


def test_landmarks_of_the_newest_keyframe_do_not_hold_it():
    world, _ = world_with(30)
    world.landmarks.born[:15] = world.keyframes[-1].frame_id
    half, _ = world_with(30)
    half.remove_landmarks(np.arange(30) < 15)
    assert handover_error(world, CAMERA, NOISE) == pytest.approx(handover_error(half, CAMERA, NOISE))


def test_a_submap_begins_with_any_scale():
    assert handover_error(world_with(30, num_keyframes=2)[0], CAMERA, NOISE) is None


def test_without_older_landmarks_nothing_holds():
    assert handover_error(world_with(0)[0], CAMERA, NOISE) > 1.0


def warnings_of(caplog, worlds):
    watch = ScaleWatch(CAMERA)
    with caplog.at_level(logging.WARNING):
        for world in worlds:
            watch.look(world, NOISE)
    return [record.getMessage() for record in caplog.records]


def test_weakly_held_scale_is_told_once(caplog):
    weak = world_with(3, off_px=8.0)[0]
    (told,) = warnings_of(caplog, [weak] * 12)
    assert told.startswith(f"scale is weakly held since frame {weak.keyframes[-1].frame_id}:")


def test_nothing_is_told_where_scale_is_held_or_but_for_one_keyframe(caplog):
    held, weak = world_with(60)[0], world_with(3, off_px=8.0)[0]
    assert warnings_of(caplog, [held] * 6 + [weak] + [held] * 6) == []


def test_every_keyframe_of_a_path_is_looked_at(monkeypatch):
    looked_at = []
    monkeypatch.setattr(
        ScaleWatch, "look", lambda _, world, noise: looked_at.append(world.keyframes[-1].frame_id)
    )
    core = make()
    results = [
        core.process(frame_of(k, render(make_transform(np.eye(3), (0.12 * k, 0.05 * np.sin(k), 0.0)))))
        for k in range(9)
    ]
    made = [r.frame_id for r in results if r.is_keyframe]
    assert len(made) > 2
    assert looked_at == made[1:], "all but the one that began the map"
