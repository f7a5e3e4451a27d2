"""A plain texture before which a camera moves sideways, tracks that begin on it, and a map of it."""

import numpy as np
from textures import texture

from semcast.common.camera import Intrinsics
from semcast.common.geometry import make_transform
from semcast.server.geometry.grey import to_grey
from semcast.server.mapping.keyframe_images import KeyframeImages, SeenFrom
from semcast.server.mapping.sight import Sight, usable_rows
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.tracks import TrackTable
from semcast.server.mapping.world_map import Keyframe, WorldMap

SHAPE = (192, 256)


TEXTURE = texture((400, 500), (2, 5, 12), 3)


def sight_at(x, y=20, frame_id=0, lost=(), **changes):
    """The texture as a camera sees it that moved by x and y; slots in ``lost`` are grey."""
    image = np.repeat(TEXTURE[y : y + SHAPE[0], x : x + SHAPE[1], None], 3, axis=2).copy()
    snr = np.full(SHAPE[0] // 16, 20.0, np.float32)
    for slot in lost:
        image[16 * slot : 16 * slot + 16] = 128
        snr[slot] = -20
    frame = DecodedFrame(frame_id, frame_id * 10**8, image, slot_snr_db=snr, **changes)
    return Sight(frame, to_grey(image), usable_rows(frame, SHAPE[0]))


def begin(x=20, **changes):
    tracks = TrackTable("robust", 150, 0)
    sight = sight_at(x, **changes)
    tracks.remember(sight)
    tracks.refill(sight)
    return tracks


#: A wall at distance 1: moving by 1/200 moves the image by a pixel.
CAMERA = Intrinsics(fx=200.0, fy=200.0, cx=128.0, cy=96.0, width=SHAPE[1], height=SHAPE[0])
START_X = 20


def pose_at(x):
    return make_transform(np.eye(3), [(x - START_X) / 200.0, 0.0, 0.0])


def mapped_wall():
    """A keyframe whose tracks are all landmarks, its image, and the tracks."""
    tracks = begin(START_X)
    world = WorldMap()
    count = len(tracks)
    world.add_keyframe(
        Keyframe(
            frame_id=0,
            t_source_ns=0,
            T_world_cam=pose_at(START_X),
            submap=0,
            ids=tracks.ids.copy(),
            xy=tracks.xy.copy(),
            confidence=tracks.confidence.copy(),
        )
    )
    xyz = CAMERA.unproject(tracks.xy)
    world.add_landmarks(tracks.ids, xyz, np.zeros((count, 3), np.uint8), np.ones(count), 0, 0)
    images = KeyframeImages(10)
    images.append(SeenFrom(0, sight_at(START_X).grey))
    return world, images, tracks
