"""Steps of the camera beyond what tracks are followed over: what descriptors find, and what rests on it."""

from dataclasses import replace

import cv2
import numpy as np
from drawn_boards import ate_percent
from test_tracks import SHAPE, begin, sight_at

from semcast.evaluation.scenes.orbit import Orbit
from semcast.evaluation.scenes.render import frame_of
from semcast.server.geometry.grey import to_grey
from semcast.server.geometry.wide_search import WideFeatures
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.state import DecodedFrame


def turned_sight(deg):
    """What ``begin`` saw, with the camera turned about its view."""
    to_turned = cv2.getRotationMatrix2D((SHAPE[1] / 2, SHAPE[0] / 2), deg, 1.0)
    image = cv2.warpAffine(sight_at(20).frame.image, to_turned, SHAPE[::-1])
    frame = DecodedFrame(1, 10**8, image)
    return Sight(frame, to_grey(image), np.ones(SHAPE[0], bool)), to_turned


def test_tracks_are_found_again_after_a_turn_of_the_image():
    tracks = begin()
    ids, xy = tracks.ids.copy(), tracks.xy.copy()
    sight, to_turned = turned_sight(30)
    tracks.follow(sight, tracks.xy)
    assert tracks.visible.sum() > 60
    was = xy[np.searchsorted(ids, tracks.ids[tracks.visible])]
    true = was @ to_turned[:, :2].T + to_turned[:, 2]
    assert (np.linalg.norm(tracks.xy[tracks.visible] - true, axis=1) < 0.5).mean() > 0.95


def test_many_tracks_that_descriptors_refute_do_not_outvote_fewer_that_they_find():
    tracks = begin(x=20, y=10)
    xy = dict(zip(tracks.ids.tolist(), tracks.xy, strict=True))
    tracks.follow(sight_at(20, 10), tracks.xy)
    count = int(tracks.visible.sum())
    assert tracks.follow_jump(sight_at(135, 75)), "as if all had been found where they were"
    assert tracks.visible.sum() < count
    moved = tracks.xy - [xy[k] for k in tracks.ids.tolist()]
    assert (np.linalg.norm(moved + np.array([115, 65]), axis=1) < 0.5).mean() > 0.95


def test_features_of_an_image_are_looked_for_once_however_often_the_camera_jumps(monkeypatch):
    find, num_found = WideFeatures.of, []
    monkeypatch.setattr(
        WideFeatures, "of", staticmethod(lambda *given, **how: num_found.append(1) or find(*given, **how))
    )
    tracks = begin()
    for k, x in enumerate((110, 20, 110), 1):
        tracks.follow(sight_at(x, frame_id=k), tracks.xy)
        assert len(num_found) == 1 + k, "a small image has no finer ones either"
        assert tracks.visible.sum() > 25
        assert tracks.refill(sight_at(x)) >= 0


def test_features_are_not_those_of_an_image_that_was_brought_to_another_light(monkeypatch):
    tracks = begin()
    find, seen = WideFeatures.of, []
    monkeypatch.setattr(
        WideFeatures, "of", staticmethod(lambda grey, *rest: seen.append(grey) or find(grey, *rest))
    )
    first = sight_at(20)
    tracks.remember(first)
    darker = (0.6 * first.grey).astype(np.uint8)
    tracks.replace_newest(replace(first, grey=darker))
    tracks.follow(
        replace(sight_at(110, frame_id=1), grey=(0.6 * sight_at(110).grey).astype(np.uint8)), tracks.xy
    )
    assert any(grey is darker for grey in seen)


def test_a_camera_that_goes_round_in_steps_of_twenty_degrees_is_followed():
    scene = Orbit(3, "normal")
    poses = [scene.T_world_cam(0.6 * k) for k in range(8)]
    reconstruction = Reconstruction(scene.camera, ReconstructionSettings(), InlineBundle())
    for k in range(len(poses)):
        image = frame_of(scene, 0.6 * k, 1.5, np.random.default_rng(k))
        reconstruction.process(DecodedFrame(k, k * 600_000_000, image))
    trajectory = reconstruction.final_trajectory()
    reconstruction.close()
    assert sorted(trajectory) == list(range(len(poses)))
    assert ate_percent(trajectory, poses) < 1.0
