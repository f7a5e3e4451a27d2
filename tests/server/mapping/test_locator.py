"""The pose of an image whose place was recognised."""

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, make_transform, transform_points
from semcast.server.geometry.pnp import refine_pose
from semcast.server.geometry.weighting import GATE_SIGMAS
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.camera_motion import CameraMotion
from semcast.server.mapping.locator import Locator
from semcast.server.mapping.map_builder import MapBuilder
from semcast.server.mapping.relocalisation import Place
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.tracks import TrackTable

CAMERA = Intrinsics(fx=500, fy=500, cx=320, cy=240, width=640, height=480)
#: The noise of tracks on images that came well: what is 1.9 pixels off is another point.
SETTINGS = ReconstructionSettings(sigma0_px=0.25)
#: Of a patch that is found, and by how much landmarks are off.
PATCH_SIGMA_PX, OFF_PX = 1.0, 1.9

FRAME_NS = 66_000_000


def walked(steps):
    """Pose after so many steps of 4 cm, swaying by a millimetre."""
    return make_transform(np.eye(3), (0.001 * np.sin(2.0 * steps), 0.0, 0.04 * steps))


class EverythingResembles(MapBuilder):
    """A map without images to compare with."""

    def resembles(self, *_):
        return True


def in_map_of(xyz):
    """Locator in a map of landmarks, its tracks and its motion."""
    num = len(xyz)
    builder = EverythingResembles(CAMERA, SETTINGS, InlineBundle(), lambda _: None)
    builder.world.add_landmarks(np.arange(num), xyz, np.zeros((num, 3), np.uint8), np.ones(num), 0, 0)
    motion, tracks = CameraMotion(CAMERA), TrackTable(SETTINGS.confidence, SETTINGS.max_features, seed=0)
    return Locator(CAMERA, SETTINGS, builder, tracks, motion), tracks, motion


def located(num, *, is_proved, off_px=OFF_PX):
    """Pose at a place where so many landmarks are off, each in another direction."""
    ids, xyz = np.arange(num), np.random.default_rng(0).uniform((-2, -1.5, 4), (2, 1.5, 8), (num, 3))
    locator, _, _ = in_map_of(xyz)
    angle = 2.4 * np.arange(num)
    xy = CAMERA.project(xyz) + off_px * np.column_stack([np.cos(angle), np.sin(angle)])
    sigma = np.full(num, PATCH_SIGMA_PX)
    proof = refine_pose(CAMERA, np.eye(4), xyz, xy, sigma, GATE_SIGMAS * sigma)
    assert proof.num_inliers == num
    return locator.pose_at(Place(np.eye(4), 0, ids, xy, 0, proof if is_proved else None))


def test_what_patches_prove_from_far_off_is_a_pose_where_tracks_would_be_nearer():
    pose = located(17, is_proved=True)
    assert np.array_equal(pose.ids, np.arange(17))
    assert pose.num_inliers == 17
    assert np.linalg.norm(pose.T_world_cam[:3, 3]) < 0.1
    assert pose.covariance is not None


@pytest.mark.parametrize(("num", "is_proved"), [(14, True), (17, False)])
def test_fewer_landmarks_or_descriptors_alone_are_none(num, is_proved):
    assert located(num, is_proved=is_proved) is None


def test_a_place_whose_landmarks_are_where_the_map_has_them_needs_no_proof():
    assert located(17, is_proved=False, off_px=0.3).num_inliers == 17


def tracked_after_a_walk(num, ahead):
    """Pose of a frame that sees so many landmarks from so many steps ahead of a camera that walked."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform((-2, -1.5, 8), (2, 1.5, 12), (num, 3))
    locator, tracks, motion = in_map_of(xyz)
    for k in range(30):
        motion.observe(k, k * FRAME_NS, walked(k), xyz)
    xy = CAMERA.project(transform_points(invert_transform(walked(29 + ahead)), xyz))
    tracks.adopt(np.arange(num), xy, 1.0)
    image = rng.integers(0, 255, (480, 640), np.uint8)
    frame = DecodedFrame(30, 30 * FRAME_NS, np.repeat(image[..., None], 3, axis=2))
    sight = Sight(frame, image, np.ones(480, bool))
    return locator.track(sight, walked(30)), tracks


@pytest.mark.parametrize("ahead", [0.45, 1.6])
def test_few_landmarks_do_not_make_a_walking_camera_jump(ahead):
    pose, tracks = tracked_after_a_walk(20, ahead)
    assert pose is None
    assert len(tracks) == 0, "nothing that led there is followed on"


def test_many_landmarks_may():
    pose, _ = tracked_after_a_walk(60, 1.6)
    assert np.isclose(pose.T_world_cam[2, 3], walked(30.6)[2, 3], atol=1e-3)


def test_few_landmarks_pose_a_camera_that_walks_on():
    pose, tracks = tracked_after_a_walk(20, 1.1)
    assert np.isclose(pose.T_world_cam[2, 3], walked(30.1)[2, 3], atol=1e-3)
    assert len(tracks) == 20
