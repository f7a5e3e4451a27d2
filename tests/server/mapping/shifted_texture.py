"""A plain texture before which a camera moves sideways, and tracks that begin on it."""

import cv2
import numpy as np

from semcast.server.geometry.features import to_grey
from semcast.server.mapping.sight import Sight, usable_rows
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.tracks import TrackTable

SHAPE = (192, 256)


def big_texture():
    rng = np.random.default_rng(3)
    noise = sum(
        layer / layer.std()
        for layer in (
            cv2.GaussianBlur(rng.standard_normal((400, 500)).astype(np.float32), None, s) for s in (2, 5, 12)
        )
    )
    return np.clip(noise * 30 + 128, 0, 255).astype(np.uint8)


TEXTURE = big_texture()


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
