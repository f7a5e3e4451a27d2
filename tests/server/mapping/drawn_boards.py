"""Upright boards with textures, drawn for a camera that moves before them, and their reconstruction."""

import functools

import cv2
import numpy as np
from textures import texture

from semcast.common.camera import Intrinsics
from semcast.common.geometry import align_umeyama, exp_so3, invert_transform, make_transform
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.state import DecodedFrame

CAMERA = Intrinsics(fx=260, fy=260, cx=159.5, cy=119.5, width=320, height=240)
FRAME_NS = 100_000_000
#: Centre, size and depth order of upright boards (far to near).
BOARDS = (
    (6.0, 0.0, 9.0, 40.0),
    (-2.2, 0.6, 6.0, 2.6),
    (2.0, -0.5, 5.0, 2.2),
    (0.3, 1.2, 4.0, 1.4),
    (-1.0, -1.1, 4.5, 1.2),
)


def board_texture(seed, side):
    return texture((side, side), (2.0, 6.0, 16.0), seed, 32)


@functools.cache
def textures():
    """Texture and mask of each board, made when the first picture is drawn: every process imports this."""
    drawn = [board_texture(k, 1536 if k == 0 else 256) for k in range(len(BOARDS))]
    return [(grey, np.full_like(grey, 255)) for grey in drawn]


def render(T_world_cam, corner_xy=(0, 0), size_wh=(CAMERA.width, CAMERA.height)):
    """Draw the boards, or a part of the image, from far to near by the homography of each."""
    T = invert_transform(T_world_cam)
    image = np.zeros(size_wh[::-1], np.uint8)
    K = CAMERA.K - np.outer((*corner_xy, 0), (0, 0, 1))
    for (grey, whole), (x, y, z, size) in zip(textures(), BOARDS, strict=True):
        scale = size / grey.shape[0]
        board = np.array([[scale, 0, x - size / 2], [0, scale, y - size / 2], [0, 0, z], [0, 0, 1]])
        H = K @ (T[:3] @ board)
        mask = cv2.warpPerspective(whole, H, size_wh)
        drawn = cv2.warpPerspective(grey, H, size_wh, flags=cv2.INTER_AREA)
        image = np.where(mask == 255, drawn, image)
    return np.repeat(image[..., None], 3, axis=2)


def sideways(num=24):
    return [
        make_transform(exp_so3((0.0, -0.006 * k, 0.002 * k)), (0.08 * k, 0.03 * np.sin(k / 4), 0.03 * k))
        for k in range(num)
    ]


def frame_of(frame_id, image, **maps):
    return DecodedFrame(frame_id, frame_id * FRAME_NS, image, **maps)


def make(bundle=None, **settings):
    return Reconstruction(
        CAMERA, ReconstructionSettings(**{"max_features": 250, **settings}), bundle or InlineBundle()
    )


def ate_percent(trajectory, truth):
    """RMS position error after Sim(3) in percent of the path."""
    ids = sorted(trajectory)
    ours = np.array([trajectory[k][:3, 3] for k in ids])
    theirs = np.array([truth[k][:3, 3] for k in ids])
    scale, R, t = align_umeyama(ours, theirs)
    error = np.linalg.norm(scale * ours @ R.T + t - theirs, axis=1)
    return 100 * np.sqrt((error**2).mean()) / np.linalg.norm(np.diff(theirs, axis=0), axis=1).sum()
