"""Where a camera is that was lost, told by what recognises its place and by where it can have got to."""

from dataclasses import replace

import numpy as np

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, make_transform
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.geometry.whereabouts import Whereabouts
from semcast.server.mapping.keyframe_images import ImagedMap, KeyframeImages
from semcast.server.mapping.recognition import Recogniser
from semcast.server.mapping.relocalisation import Place
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.world_map import Keyframe, WorldMap

CAMERA = Intrinsics(fx=500, fy=500, cx=320, cy=240, width=640, height=480)
IMAGE = np.full((480, 640, 3), 90, np.uint8)
NOISE = NoiseModel(0.7, 0.0)


class Recognises:
    """Takes each image for one place, and what it is asked to look at for the right one."""

    def __init__(self, T_world_cam):
        self.place = Place(T_world_cam, 0, np.arange(30), np.zeros((30, 2)), 0)
        self.looked_at = []

    def find(self, *_, is_possible=lambda place: True):
        return self.place if is_possible(self.place) else None

    def look(self, sight, world, images, noise, T_world_cam):
        self.looked_at.append(T_world_cam)
        return replace(self.place, T_world_cam=T_world_cam)


def test_the_next_one_of_a_row_tells_how_the_camera_turned_and_motion_where_it_is():
    world = WorldMap()
    world.add_keyframe(Keyframe(4, 4, np.eye(4), 0, np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0)))
    mapped = ImagedMap(CAMERA, world, KeyframeImages(3), 0)
    sight = Sight(DecodedFrame(20, 20, IMAGE), IMAGE[..., 0], np.ones(480, bool))
    there = Whereabouts(np.eye(4), np.array([0.0, 0.0, 1.0]), 0.5)
    turn = exp_so3((0.0, np.pi / 2, 0.0))
    bent = np.array([2 / np.pi, 0.0, 2 / np.pi])
    for x, is_there in ((2.0, False), (0.3, True)):
        both = Recognises(make_transform(turn, bent + np.array((x, 0.0, 0.0))))
        recogniser = Recogniser(both, both)
        place = recogniser.find(sight, mapped, NOISE, np.eye(4), there)
        assert (not both.looked_at) == is_there
        np.testing.assert_allclose(
            place.T_world_cam, make_transform(turn, bent + np.array((x * is_there, 0.0, 0.0)))
        )
    assert recogniser.find(sight, mapped, NOISE, None, None) is both.place, "anywhere"
