"""Something large that moves by itself: its tracks are many and last, and must not carry the camera along."""

import cv2
import numpy as np
import pytest
from textures import texture

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, invert_transform, make_transform
from semcast.common.trajectory import Trajectory
from semcast.common.trajectory_error import ate
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.keyframe_rule import median_flow_px
from semcast.server.mapping.new_landmarks import add_landmarks
from semcast.server.mapping.rays import rays_of
from semcast.server.mapping.reconstruction import Reconstruction, ReconstructionSettings
from semcast.server.mapping.refuted import on_something_large, with_neighbours
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.tracker import track_pose
from semcast.server.mapping.tracks import Seen
from semcast.server.mapping.world_map import Keyframe, WorldMap

CAMERA = Intrinsics(fx=260, fy=260, cx=159.5, cy=119.5, width=320, height=240)
WIDTH, HEIGHT = CAMERA.width, CAMERA.height
NOISE = NoiseModel(0.5, 0.0)
#: Frames, and that in which the thing comes.
NUM_FRAMES, CAME = 45, 15


WALL, THING = texture((700, 1800), (2, 6), 2, 40), texture((150, 1200), (2, 6), 3, 40)


def pose_at(k):
    """A walk along a corridor, looking to the right and to the left."""
    return make_transform(exp_so3(np.array([0.0, 0.4 * np.sin(k / 8), 0.0])), np.array([0.0, 0.0, 0.1 * k]))


def image_at(k, step_px):
    """What is seen of a corridor that is 4 m wide and ends at 14 m, behind a train from some frame on."""
    x, y = np.meshgrid(np.arange(WIDTH) - CAMERA.cx, np.arange(HEIGHT) - CAMERA.cy)
    T_world_cam = pose_at(k)
    ray = np.stack([x / CAMERA.fx, y / CAMERA.fy, np.ones_like(x)], axis=-1) @ T_world_cam[:3, :3].T
    z = T_world_cam[2, 3]
    to_side, to_end = 2.0 / np.maximum(np.abs(ray[..., 0]), 1e-9), (14.0 - z) / np.maximum(ray[..., 2], 1e-9)
    far = np.minimum(to_side, to_end)
    along = np.where(to_side < to_end, z + far * ray[..., 2], 16.0 + far * ray[..., 0])
    rows = 350.0 + 110.0 * far * ray[..., 1]
    image = cv2.remap(
        WALL,
        (110.0 * along).astype(np.float32),
        rows.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT,
    )
    if k >= CAME:
        image[60:200, 60:260] = THING[:140, step_px * (k - CAME) :][:, :200]
    return np.repeat(image[..., None], 3, axis=2)


@pytest.mark.parametrize("step_px", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_something_large_that_passes_through_does_not_take_the_camera_along(step_px):
    reconstruction = Reconstruction(CAMERA, ReconstructionSettings(max_features=250), InlineBundle())
    for k in range(NUM_FRAMES):
        reconstruction.process(DecodedFrame(k, k * 10**8, image_at(k, step_px)))
    found = reconstruction.final_trajectory()
    reconstruction.close()
    assert len(found) == NUM_FRAMES
    t_s = 0.1 * np.arange(NUM_FRAMES)
    truth = Trajectory(t_s, np.stack([pose_at(k) for k in range(NUM_FRAMES)]))
    absolute = ate(Trajectory(t_s, np.stack([found[k] for k in range(NUM_FRAMES)])), truth)
    assert absolute is not None
    assert absolute.percent < 0.5


def keyframe(frame_id, T_world_cam, ids, xy):
    return Keyframe(
        frame_id=frame_id,
        t_source_ns=frame_id * 10**8,
        T_world_cam=T_world_cam,
        submap=0,
        ids=ids,
        xy=xy,
        confidence=np.ones(len(ids)),
    )


def project(xyz, T_world_cam):
    T = invert_transform(T_world_cam)
    return CAMERA.project(xyz @ T[:3, :3].T + T[:3, 3])


NUM_MARKS, NUM_OTHERS = 80, 200
MOVED = make_transform(exp_so3(np.array([0.01, -0.02, 0.005])), [0.06, 0.01, 0.03])


def scene():
    """Landmarks all over the image of a keyframe at the origin, and tracks that have no depth yet."""
    rng = np.random.default_rng(0)
    count = NUM_MARKS + NUM_OTHERS
    xyz = CAMERA.unproject(rng.uniform((10, 10), (310, 230), (count, 2))) * rng.uniform(2.5, 6, (count, 1))
    world, ids = WorldMap(), np.arange(count)
    world.add_keyframe(keyframe(0, np.eye(4), ids, project(xyz, np.eye(4))))
    marks = slice(0, NUM_MARKS)
    rgb = np.zeros((NUM_MARKS, 3), np.uint8)
    world.add_landmarks(ids[marks], xyz[marks], rgb, np.ones(NUM_MARKS), 0, 0)
    return world, xyz, ids


def way_px(xyz, T_world_cam):
    """How far a pose puts landmarks from where they are seen."""
    off = project(xyz[:NUM_MARKS], T_world_cam) - project(xyz[:NUM_MARKS], MOVED)
    return float(np.median(np.linalg.norm(off, axis=1)))


def test_many_rays_that_move_alike_do_not_pull_a_pose_away_from_its_landmarks():
    world, xyz, ids = scene()
    xy = project(xyz, MOVED)
    xy[NUM_MARKS:] += (0.0, 1.5)
    seen = Seen(ids, xy, np.ones(len(ids)))
    pose = track_pose(CAMERA, world, NOISE, seen, MOVED, submap=0, seed=0)
    assert pose is not None
    assert way_px(xyz, pose.T_world_cam) < 0.2


def test_tracks_that_no_point_at_rest_explains_are_no_rays():
    world, xyz, ids = scene()
    xy = project(xyz, MOVED)
    moving = np.arange(len(ids)) >= NUM_MARKS + NUM_OTHERS // 2
    xy[moving] += (0.0, 12.0)
    world.add_keyframe(keyframe(1, MOVED, ids, xy))
    add_landmarks(world, CAMERA, NOISE, np.zeros((HEIGHT, WIDTH, 3), np.uint8), 10.0)
    assert np.array_equal(world.keyframes[-1].refuted, ids[moving])
    seen = Seen(ids, xy, np.ones(len(ids)))
    others = seen[ids >= NUM_MARKS]
    rays = rays_of(CAMERA, world, NOISE, others, submap=0)
    assert rays is not None
    at_rest = others.xy[~moving[NUM_MARKS:]]
    assert np.allclose(rays.observed.T + np.array([CAMERA.cx, CAMERA.cy]), at_rest)
    assert rays_of(CAMERA, world, NOISE, seen[moving], submap=0) is None


def lorry(num_refuted):
    """A keyframe with a dense block of tracks in its middle, all but every fourth of them refuted.

    Landmarks are to its right, young tracks in the block, among the landmarks and at the left edge.
    """
    block = np.stack(np.meshgrid(np.arange(100.0, 140, 4), np.arange(60.0, 120, 4)), axis=-1).reshape(-1, 2)
    right = np.stack(np.meshgrid(np.arange(220.0, 310, 10), np.arange(20.0, 230, 20)), axis=-1).reshape(-1, 2)
    left = np.column_stack([np.full(10, 5.0), np.arange(20.0, 220, 20)])
    xy = np.concatenate([block, right, left])
    ids = np.arange(len(xy)) + 1000
    young_block = np.arange(0, len(block), 4)
    refuted = np.setdiff1d(np.arange(len(block)), young_block)[:num_refuted]
    is_landmark = np.zeros(len(xy), bool)
    is_landmark[len(block) : len(block) + len(right)] = True
    is_landmark[len(block) : len(block) + len(right) : 5] = False
    seen = keyframe(0, np.eye(4), ids, xy)
    seen.refuted = ids[refuted]
    return seen, is_landmark, ids[young_block]


def test_young_tracks_among_refuted_ones_are_on_the_same_thing_and_those_elsewhere_are_not():
    seen, is_landmark, young = lorry(num_refuted=200)
    found = with_neighbours(seen, is_landmark, WIDTH)
    assert np.array_equal(found, np.union1d(seen.refuted, young))
    assert np.array_equal(with_neighbours(seen, np.zeros(len(is_landmark), bool), WIDTH), found)


@pytest.mark.parametrize(("num_refuted", "is_large"), [(29, False), (50, False), (60, True)])
def test_a_few_refuted_tracks_say_nothing_about_their_neighbours(num_refuted, is_large):
    seen, is_landmark, _ = lorry(num_refuted)
    assert len(seen.ids) == 259
    found = with_neighbours(seen, is_landmark, WIDTH)
    assert (len(found) > num_refuted) == is_large
    assert np.array_equal(on_something_large(seen), seen.refuted if is_large else [])


def test_what_stands_still_in_the_image_and_moves_by_itself_does_not_keep_keyframes_away():
    seen, is_landmark, _ = lorry(num_refuted=200)
    now = seen.xy + np.where(is_landmark[:, None], (20.0, 0.0), 0.0)
    assert median_flow_px(seen, seen.ids, now) == 20.0
    seen.refuted = seen.refuted[:29]
    assert median_flow_px(seen, seen.ids, now) == 0.0


def test_a_keyframe_that_saw_none_of_the_tracks_is_infinitely_far():
    seen, _, _ = lorry(num_refuted=0)
    assert median_flow_px(seen, seen.ids + 10_000, seen.xy) == np.inf


def test_a_young_track_on_something_large_becomes_no_landmark():
    world, xyz, ids = scene()
    block = np.stack(np.meshgrid(np.arange(140.0, 180, 4), np.arange(90.0, 150, 4)), axis=-1).reshape(-1, 2)
    moving = np.arange(len(ids)) >= len(ids) - len(block)
    world.keyframes[0].xy[moving] = block
    xyz[moving] = CAMERA.unproject(block) * 4.0
    xy = project(xyz, MOVED)
    # Every fifth of them moves as a point at rest would, by chance.
    refuted = moving & (ids % 5 > 0)
    xy[refuted] += (0.0, 12.0)
    world.add_keyframe(keyframe(1, MOVED, ids, xy))
    add_landmarks(world, CAMERA, NOISE, np.zeros((HEIGHT, WIDTH, 3), np.uint8), 0.2)
    assert np.isin(ids[refuted], world.keyframes[-1].refuted).all()
    is_landmark = world.landmarks.rows(ids) >= 0
    assert is_landmark[moving].sum() <= 4  # those beside a landmark that happens to be there
    assert is_landmark[NUM_MARKS:][~moving[NUM_MARKS:]].mean() > 0.9
