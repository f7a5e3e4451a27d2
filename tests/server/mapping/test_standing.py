"""What stands in the image while the scene moves: it moves with the camera."""

import cv2
import numpy as np
import pytest
from drawn_boards import ate_percent, frame_of, make, render, sideways
from textures import texture

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, make_transform
from semcast.server.geometry.grey import to_grey
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.reconstruction import Reconstruction, ReconstructionSettings
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.standing import is_fixed, least_motion_px, may_be_fixed, scene_motion_px, stood
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.tracks import TrackTable

CAMERA = Intrinsics(fx=260, fy=260, cx=159.5, cy=119.5, width=320, height=240)
WIDTH, HEIGHT = CAMERA.width, CAMERA.height
#: The bonnet begins at this row.
BONNET_Y = 170


SCENE, BONNET = texture((HEIGHT, 1200), (2, 6), 0, 40), texture((HEIGHT, WIDTH), (2, 6), 1, 40)


def sight_at(x, frame_id, bonnet_x=0):
    """The scene behind a bonnet, seen by a camera that went to x."""
    image = SCENE[:, x : x + WIDTH].copy()
    image[BONNET_Y:] = np.roll(BONNET, -bonnet_x, axis=1)[BONNET_Y:]
    image = np.repeat(image[..., None], 3, axis=2)
    frame = DecodedFrame(frame_id, frame_id * 10**8, image)
    return Sight(frame, to_grey(image), np.ones(HEIGHT, bool))


def on_bonnet(tracks):
    return tracks.xy[:, 1] > BONNET_Y - 8


def follow(tracks, xs, **changes):
    for k, x in enumerate(xs):
        sight = sight_at(x, k, **changes)
        if len(tracks):
            tracks.follow(sight, tracks.xy + tracks.velocity)
        else:
            tracks.remember(sight)
        tracks.refill(sight)


def test_the_motion_of_the_scene_is_that_of_most_of_the_area_not_of_most_tracks():
    crowd = np.column_stack((np.linspace(10, 600, 400), np.full(400, 460.0)))
    few = np.stack(np.meshgrid(np.arange(20, 640, 60.0), np.arange(20, 400, 60.0)), axis=-1).reshape(-1, 2)
    xy = np.concatenate([crowd, few])
    motion = np.concatenate([np.zeros(400), np.full(len(few), 7.0)])
    assert scene_motion_px(xy, motion, 640) == 7.0
    assert scene_motion_px(xy, 7.0 - motion, 640) == 0.0, "something that drives past a camera at rest"
    assert scene_motion_px(xy, np.full(len(xy), 0.2), 640) == 0.0, "noise"
    assert scene_motion_px(np.zeros((0, 2)), np.zeros(0), 640) == 0.0


def test_on_a_turntable_the_scene_is_what_moves():
    xy = np.stack(np.meshgrid(np.arange(20, 640, 60.0), np.arange(20, 400, 60.0)), axis=-1).reshape(-1, 2)
    motion = np.where(np.hypot(*(xy - (320, 200)).T) < 130, 3.0, 0.2)
    assert scene_motion_px(xy, motion, 640) == 0.0
    noise = np.full(len(xy), 0.1)
    assert scene_motion_px(xy, motion, 640, noise) == 3.0
    assert scene_motion_px(xy, np.where(motion == 3.0, 3.0, 0.9), 640, 5 * noise) == 3.0, "the rest is noise"
    slipped = np.where(np.arange(len(xy)) < 5, 3.0, 0.2)
    assert scene_motion_px(xy, slipped, 640, noise) == 0.0


def test_the_motion_of_a_cell_is_the_median_of_its_tracks():
    xy = np.full((5, 2), 30.0)
    assert scene_motion_px(xy, np.array([9.0, 1.0, 4.0, 3.0, 2.0]), 640) == 3.0
    assert scene_motion_px(xy[:4], np.array([9.0, 1.0, 3.0, 2.0]), 640) == 2.0, "the lower one of both"


def test_what_stands_may_move_by_a_share_of_the_width_and_by_its_noise():
    assert least_motion_px(640, 0.0) == 1.0
    assert least_motion_px(2000, 0.0) == pytest.approx(3.0)
    np.testing.assert_allclose(least_motion_px(640, np.array([0.1, 1.0])), (1.0, 2.0 * np.sqrt(2.0)))
    many, sd_px = np.full((20, 2), 30.0), np.ones(20)
    assert scene_motion_px(many, np.full(20, 2.8), 640, sd_px) == 0.0, "on a turntable that is noise"
    assert scene_motion_px(many, np.full(20, 2.9), 640, sd_px) == 2.9


def test_a_track_that_moves_begins_anew():
    anchor, widths = np.zeros((2, 2)), np.full(2, 0.5)
    xy = np.array([(0.5, 0.5), (4.0, 0.0)])
    anchor, widths = stood(xy, anchor, widths, 32.0, 320)
    assert np.array_equal(anchor, [(0.0, 0.0), (4.0, 0.0)])
    assert np.allclose(widths, (0.6, 0.0))
    assert is_fixed(widths).tolist() == [True, False]


def test_a_track_stands_as_long_as_its_noise_explains_what_it_moved():
    xy = np.array([(2.5, 0.0), (2.5, 0.0), (6.0, 0.0)])
    sd_px = np.array([0.2, 1.0, 1.0])
    _, widths = stood(xy, np.zeros((3, 2)), np.zeros(3), 32.0, 320, sd_px)
    assert np.allclose(widths, (0.0, 0.1, 0.0))


def test_many_tracks_that_stand_are_suspect_until_they_are_known_to_be_fixed():
    widths = np.zeros(100)
    widths[:30] = 0.02
    assert np.array_equal(np.flatnonzero(may_be_fixed(widths)), np.arange(30))
    widths[:10] = 0.2
    assert np.array_equal(np.flatnonzero(may_be_fixed(widths)), np.arange(10, 30))
    widths[:25] = 0.0
    assert not may_be_fixed(widths).any(), "a few are far away, or ahead"
    assert not may_be_fixed(np.zeros(0)).any()


def test_tracks_on_a_bonnet_take_no_room_from_those_of_the_scene():
    tracks = TrackTable("robust", 200, 0)
    follow(tracks, range(0, 240, 8))
    assert tracks.fixed.sum() > 20
    assert on_bonnet(tracks)[tracks.fixed].all()
    assert (tracks.visible & ~on_bonnet(tracks)).sum() > 130
    assert not np.isin(tracks.ids[tracks.fixed], tracks.seen().ids).any()


def test_a_camera_at_rest_makes_nothing_fixed():
    tracks = TrackTable("robust", 200, 0)
    follow(tracks, [40] * 30)
    assert not tracks.fixed.any()


def test_what_moves_after_all_is_of_the_scene_again():
    tracks = TrackTable("robust", 200, 0)
    follow(tracks, range(0, 160, 8))
    fixed = tracks.ids[tracks.fixed]
    assert len(fixed)
    tracks.follow(sight_at(160, 20, bonnet_x=3), tracks.xy + tracks.velocity)
    moved = np.isin(tracks.ids, fixed)
    assert moved.sum() > 0.8 * len(fixed)
    assert not tracks.fixed[moved].any()


def test_tracks_that_agree_with_the_pose_are_vouched_for():
    tracks = TrackTable("robust", 200, 0)
    follow(tracks, range(0, 160, 8))
    some = tracks.ids[tracks.fixed][:5]
    tracks.vouch(some)
    assert not tracks.fixed[np.isin(tracks.ids, some)].any()
    assert tracks.fixed.any()


def test_a_track_that_is_hidden_does_not_stand():
    """Rows do not arrive for three frames of fast motion: tracks there are found again behind the gap."""
    tracks = TrackTable("robust", 200, 0)
    for k in range(9):
        sight = sight_at(16 * k, k)
        if 5 <= k < 8:
            sight.usable[60:140] = False
            sight.grey[60:140] = 128
        if len(tracks):
            tracks.follow(sight, tracks.xy + tracks.velocity * (tracks.missed + 1)[:, None])
        else:
            tracks.remember(sight)
        if k < 5:
            tracks.refill(sight)
        if k == 4:
            hidden = tracks.ids[(tracks.xy[:, 0] > 90) & (np.abs(tracks.xy[:, 1] - 100) < 20)]
    assert len(hidden) > 10
    assert np.isin(hidden, tracks.ids[tracks.visible]).mean() > 0.9


WALL = texture((700, 1800), (2, 6), 2, 40)
#: Of a bonnet that has most of all tracks to itself: taken for the scene, it lets no map begin.
LARGE_BONNET_Y = 136


def corridor(z):
    """The image of a camera at depth z of a corridor that is 4 m wide and ends at 12 m, behind a bonnet."""
    x, y = np.meshgrid(np.arange(WIDTH) - CAMERA.cx, np.arange(HEIGHT) - CAMERA.cy)
    depth = np.minimum(2.0 * CAMERA.fx / np.abs(x), 12.0 - z)
    along = np.where(depth < 12.0 - z, depth + z, 14.0 + x / CAMERA.fx * depth)
    rows = 350.0 + 110.0 * y / CAMERA.fy * depth
    image = cv2.remap(WALL, (110.0 * along).astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR)
    image[LARGE_BONNET_Y:] = BONNET[LARGE_BONNET_Y:]
    return np.repeat(image[..., None], 3, axis=2)


def test_a_drive_behind_a_bonnet_is_followed_as_one_without():
    settings = ReconstructionSettings(max_features=350)
    reconstruction = Reconstruction(CAMERA, settings, InlineBundle())
    for k in range(40):
        reconstruction.process(DecodedFrame(k, k * 10**8, corridor(0.2 * k)))
    trajectory = reconstruction.final_trajectory()
    reconstruction.close()
    assert len(trajectory) == 40
    t = np.array([trajectory[k][:3, 3] for k in range(40)])
    steps = np.linalg.norm(np.diff(t, axis=0), axis=1)
    assert steps.std() < 0.1 * steps.mean(), "it drove at one speed"
    way = t[-1] - t[0]
    assert np.abs(np.cross(t - t[0], way / np.linalg.norm(way))).max() < 0.02 * np.linalg.norm(way)


def test_a_map_that_begins_behind_a_bonnet_does_not_rest_on_it():
    """A hand that turns: taken for what is far away, a bonnet would let the camera seem not to turn."""
    path = [
        make_transform(exp_so3((0.0, 0.05 * np.sin(k / 5), 0.0)), (0.02 * k, 0.006 * k, 0.0))
        for k in range(30)
    ]
    reconstruction = make()
    for k, T_world_cam in enumerate(path):
        image = render(T_world_cam)
        image[BONNET_Y:] = BONNET[BONNET_Y:, :, None]
        reconstruction.process(frame_of(k, image))
    trajectory = reconstruction.final_trajectory()
    reconstruction.close()
    assert len(trajectory) == 30
    assert ate_percent(trajectory, path) < 1.0


@pytest.mark.parametrize("turntable", [False, True])
def test_what_turns_before_a_camera_at_rest_is_reconstructed_if_that_is_said(turntable):
    """Less than half of the image moves, as of a thing on a turntable before a wall with a pattern."""
    path = sideways()
    reconstruction = make(turntable=turntable)
    for k, T_world_cam in enumerate(path):
        image = np.repeat(BONNET[..., None], 3, axis=2)
        image[40:200, 75:245] = render(T_world_cam)[40:200, 75:245]
        reconstruction.process(frame_of(k, image))
    trajectory = reconstruction.final_trajectory()
    reconstruction.close()
    assert len(trajectory) == (len(path) if turntable else 0)
    if turntable:
        assert ate_percent(trajectory, path) < 1.0
