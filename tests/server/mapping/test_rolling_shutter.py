"""Images of a rolling shutter are put right by the movement of their points."""

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
from textures import layered_noise

from semcast.common.camera import Intrinsics
from semcast.server.geometry.grey import to_grey
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.rolling_shutter import ImageFlow, RollingShutter, RowTimes, _at_the_end
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.tracks import TrackTable

CAMERA = Intrinsics(fx=250.0, fy=250.0, cx=159.5, cy=119.5, width=320, height=240)
STEP_S = 1 / 30
READOUT_MS = 20.0


TEXTURE = np.clip(layered_noise((700, 1200), (2, 5, 12), 5) * 30 + 128, 0, 255)


def seen(offset_px_s, frame_id, readout_ms=READOUT_MS, readout_from="top", lost=()):
    """A far wall that moves over the image by so many pixels a second, ``(x, y)``."""
    y, x = np.mgrid[0.0:240, 0.0:320]
    along = {"top": y / 239, "bottom": 1 - y / 239, "left": x / 319, "right": 1 - x / 319}[readout_from] - 0.5
    t_s = frame_id * STEP_S + 1e-3 * readout_ms * along
    grey = cv2.remap(
        TEXTURE,
        (x - offset_px_s[0] * t_s + 400).astype(np.float32),
        (y - offset_px_s[1] * t_s + 200).astype(np.float32),
        cv2.INTER_LINEAR,
    )
    snr_db = np.full(15, 20.0, np.float32)
    for slot in lost:
        grey[16 * slot : 16 * slot + 16] = 128
        snr_db[slot] = -20.0
    image = np.repeat(np.rint(grey).astype(np.uint8)[..., None], 3, axis=2)
    t_ns = 10**9 + round(frame_id * STEP_S * 1e9)
    flat = np.full((240, 320), 0.5, np.float32)
    return DecodedFrame(frame_id, t_ns, image, flat, flat, snr_db)


def shutter_of(readout_ms, readout_from="top"):
    return RollingShutter(replace(CAMERA, readout_ms=readout_ms, readout_from=readout_from))


def run(shutter, offset_px_s, num_frames=4, **how):
    """Follow points through a few images; tracks, and where they are while the middle row is exposed."""
    tracks = TrackTable("robust", 200, 0)
    for frame_id in range(num_frames):
        frame = seen(offset_px_s, frame_id, **how)
        sight = shutter.see(frame)
        tracks.follow(sight, tracks.xy + tracks.velocity) if len(tracks) else tracks.remember(sight)
        sight, is_first = shutter.settle(frame, sight, tracks)
        assert is_first == (frame_id == 1 and not shutter.is_global)
        if frame_id <= 1:
            tracks.keep(np.zeros(len(tracks), bool)) if frame_id else None
            tracks.refill(sight)
            if frame_id == 1:
                start_xy, start_ids = tracks.xy.copy(), tracks.ids.copy()
    rows = np.isin(start_ids, tracks.ids)
    truth = start_xy[rows] + np.array(offset_px_s) * STEP_S * (num_frames - 2)
    return tracks.xy, truth, sight


@pytest.mark.parametrize("readout_from", ["top", "bottom", "left", "right"])
@pytest.mark.parametrize("offset_px_s", [(300.0, 0.0), (-120.0, 150.0), (0.0, -200.0)])
def test_an_image_is_put_right_to_that_of_a_global_shutter(offset_px_s, readout_from):
    _, _, sight = run(shutter_of(READOUT_MS, readout_from), offset_px_s, readout_from=readout_from)
    right = to_grey(seen(offset_px_s, 3, readout_ms=0.0).image).astype(float)[20:-20, 20:-20]
    rolled = to_grey(seen(offset_px_s, 3, readout_from=readout_from).image).astype(float)[20:-20, 20:-20]
    error, before = (np.abs(a - right).mean() for a in (sight.grey[20:-20, 20:-20].astype(float), rolled))
    assert error < 0.25 * before


def test_an_image_to_be_kept_is_put_right_like_that_of_its_tracks():
    shutter, offset_px_s = shutter_of(READOUT_MS), (300.0, 90.0)
    image = seen(offset_px_s, 3).image
    assert shutter.put_right(image) is image, "before anything is known of a movement"
    _, _, sight = run(shutter, offset_px_s)
    np.testing.assert_array_equal(shutter.put_right(image), sight.frame.image)
    assert np.abs(sight.frame.image.astype(float) - image).mean() > 3


def test_points_stay_where_the_scene_is():
    offset_px_s = (300.0, -60.0)
    xy, truth, _ = run(shutter_of(READOUT_MS), offset_px_s)
    assert len(xy) > 50
    assert np.abs(xy - truth).max() < 0.8
    assert np.median(np.linalg.norm(xy - truth, axis=1)) < 0.1


def test_a_point_is_shown_where_it_is_in_the_image_as_received():
    offset_px_s = (300.0, 90.0)
    shutter = shutter_of(READOUT_MS)
    xy, _, _ = run(shutter, offset_px_s)
    there = shutter.in_image(xy)
    late_s = 1e-3 * READOUT_MS * (there[:, 1] / 239 - 0.5)
    np.testing.assert_allclose(there - xy, late_s[:, None] * offset_px_s, atol=0.15)
    assert np.abs(there - xy).max() > 1.5


def test_a_point_that_flees_the_shutter_is_met_later_by_hand():
    # Rows are read at 12 000 px/s, and catch up with what moves down at 4 000 by 8 000: half as long again.
    camera = replace(CAMERA, readout_ms=1e3 * 239 / 12_000, readout_from="top")
    rows, flow = RowTimes(camera), ImageFlow(camera, np.array([0.0, 0, 0, 4000 / 250, 0, 0, 0, 0]))
    xy = np.array([[100.0, 119.5], [100.0, 131.5], [100.0, 107.5]])
    there = np.array([[100.0, 119.5], [100.0, 137.5], [100.0, 101.5]])
    np.testing.assert_allclose(rows.as_received(flow, xy), there)
    np.testing.assert_allclose(rows.put_right(flow, there), xy)


def test_images_without_confidence_are_put_right_too():
    shutter, tracks = shutter_of(READOUT_MS), TrackTable("robust", 200, 0)
    for frame_id in range(3):
        frame = replace(seen((300.0, 0.0), frame_id), confidence=None, keypoint_confidence=None)
        sight = shutter.see(frame)
        tracks.follow(sight, tracks.xy + tracks.velocity) if len(tracks) else tracks.remember(sight)
        sight, _ = shutter.settle(frame, sight, tracks)
        tracks.refill(sight)
    assert sight.frame is not frame
    assert sight.frame.confidence is None
    assert sight.frame.keypoint_confidence is None


def test_a_global_shutter_is_left_as_it_is():
    shutter = shutter_of(0.0)
    frame = seen((300.0, 0.0), 0)
    sight = shutter.see(frame)
    assert sight.frame is frame
    xy, _, sight = run(shutter, (300.0, 0.0), readout_ms=0.0)
    np.testing.assert_array_equal(sight.grey, to_grey(seen((300.0, 0.0), 3, readout_ms=0.0).image))
    np.testing.assert_array_equal(shutter.in_image(xy), xy)


def test_rows_that_did_not_arrive_go_with_the_image():
    offset_px_s = (0.0, 400.0)
    _, _, sight = run(shutter_of(READOUT_MS), offset_px_s, lost=(12,))
    # Row 200 is exposed 7 ms late: what is there belongs 2.7 rows further up.
    lost = np.flatnonzero(~sight.usable)
    assert lost[0] == pytest.approx(192 - 400 * 0.02 * (192 / 239 - 0.5), abs=1.1)
    assert lost[-1] == pytest.approx(207 - 400 * 0.02 * (207 / 239 - 0.5), abs=1.1)
    assert np.ptp(sight.grey[lost[1] : lost[-1]]) == 0


def test_that_images_before_were_not_right_is_said_once():
    shutter = shutter_of(READOUT_MS)
    run(shutter, (300.0, 0.0))
    said = []
    tracks = TrackTable("robust", 200, 0)
    for frame_id in range(60, 64):  # after two seconds the movement is unknown again
        frame = seen((30.0, 0.0), frame_id)
        sight = shutter.see(frame)
        tracks.follow(sight, tracks.xy) if len(tracks) else tracks.remember(sight)
        sight, is_first = shutter.settle(frame, sight, tracks)
        said.append(is_first)
        tracks.refill(sight)
    assert sight.frame is not frame
    assert not any(said)


def test_without_enough_points_or_after_a_gap_nothing_is_assumed():
    shutter = shutter_of(READOUT_MS)
    run(shutter, (300.0, 0.0))
    late = seen((300.0, 0.0), 60)
    assert shutter.see(late).frame is late
    sight, is_first = shutter.settle(late, shutter.see(late), TrackTable("robust", 200, 0))
    assert sight.frame is late
    assert not is_first


@pytest.mark.parametrize("since_ns", [1, 2_000_000], ids=["no time", "less than an image takes to be read"])
def test_images_too_near_in_time_tell_no_movement(since_ns):
    shutter, tracks, t_ns = shutter_of(READOUT_MS), TrackTable("robust", 200, 0), 0
    for frame_id in range(4):
        frame = seen((300.0, 0.0), frame_id)
        if frame_id == 3:
            frame = replace(frame, t_source_ns=t_ns + since_ns)
        t_ns = frame.t_source_ns
        sight = shutter.see(frame)
        tracks.follow(sight, tracks.xy + tracks.velocity) if len(tracks) else tracks.remember(sight)
        sight, _ = shutter.settle(frame, sight, tracks)
        tracks.refill(sight)
    assert sight.frame is frame, "as received"
    assert set(shutter.flows) == {0, 1, 2}


@pytest.mark.parametrize("num_missed", [0, 1])
def test_the_first_image_moved_as_the_two_after_it_tell_and_no_later_ones(num_missed):
    shutter, tracks = shutter_of(READOUT_MS), TrackTable("robust", 200, 0)
    for frame_id in range(num_missed + 4):
        frame = seen((60.0 * frame_id, 0.0), frame_id)
        sight = shutter.see(frame)
        tracks.follow(sight, tracks.xy + tracks.velocity) if len(tracks) else tracks.remember(sight)
        sight, _ = shutter.settle(frame, sight, tracks)
        if frame_id == 0 < num_missed:
            continue  # nothing is followed to the next one
        tracks.refill(sight)
    known = set(range(1 + num_missed, num_missed + 4))
    assert set(shutter.flows) == known | ({0} if num_missed == 0 else set())


def test_the_flow_of_a_turning_camera_is_exact_though_points_are_wrong(rng):
    turn = np.array([0.4, -0.7, 0.3])  # radians a second
    xy = rng.uniform((0, 0), (319, 239), (200, 2))
    x, y = ((xy - (CAMERA.cx, CAMERA.cy)) / (CAMERA.fx, CAMERA.fy)).T
    # Flow of a point at rest for a camera that turns (Longuet-Higgins and Prazdny 1980).
    u = x * y * turn[0] - (1 + x**2) * turn[1] + y * turn[2]
    v = (1 + y**2) * turn[0] - x * y * turn[1] - x * turn[2]
    truth = np.stack([CAMERA.fx * u, CAMERA.fy * v], axis=1)
    measured = truth.copy()
    measured[:40] += rng.normal(0, 200, (40, 2))
    flow = ImageFlow.fitted(CAMERA, xy, measured)
    np.testing.assert_allclose(flow.at(xy), truth, atol=0.02 * np.abs(truth).max())
    assert ImageFlow.fitted(CAMERA, xy[:29], truth[:29]) is None


def test_the_reconstruction_follows_points_in_images_put_right_and_shows_them_as_received():
    offset_px_s = (300.0, 0.0)
    found = {}
    rolling = replace(CAMERA, readout_ms=READOUT_MS)
    for readout_ms, camera, settings in (
        (0.0, CAMERA, ReconstructionSettings()),
        (0.0, rolling, ReconstructionSettings(readout_ms=0.0)),
        (READOUT_MS, rolling, ReconstructionSettings()),
        (READOUT_MS, CAMERA, ReconstructionSettings(readout_ms=READOUT_MS)),
    ):
        reconstruction = Reconstruction(camera, settings, InlineBundle())
        results = [reconstruction.process(seen(offset_px_s, frame_id)) for frame_id in range(3)]
        found[readout_ms] = results[-1].keypoints_xy.astype(float)
        tracked = reconstruction._tracks.seen().xy
        late_s = 1e-3 * readout_ms * (found[readout_ms][:, 1] / 239 - 0.5)
        np.testing.assert_allclose(found[readout_ms][:, 0] - tracked[:, 0], 300.0 * late_s, atol=0.2)
        reconstruction.close()
    assert all(len(xy) > 100 for xy in found.values())


def test_the_movement_at_an_image_is_where_the_trend_of_the_means_before_it_leads():
    since_s, rate = np.cumsum([0.0, 0.03, 0.04, 0.03]), np.polynomial.Polynomial([3.0, -20.0, 400.0])
    way = rate.integ()
    steps = [(b - a, np.array([(way(-a) - way(-b)) / (b - a), 1.0])) for a, b in pairwise(since_s)]
    np.testing.assert_allclose(_at_the_end(steps), [3.0, 1.0])
    np.testing.assert_allclose(_at_the_end(steps[:1]), steps[0][1])
