"""Textured planes seen from known places, with exact depth."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, make_transform
from semcast.server.dense.plane_sweep import Neighbour
from semcast.server.dense.view import view_of

CAMERA = Intrinsics(fx=140, fy=140, cx=79.5, cy=59.5, width=160, height=120)
_PER_UNIT = 60.0


@dataclass(frozen=True)
class Plane:
    """The plane ``normal @ p = offset``, seen where ``|x|`` and ``|y|`` of the point are within ``half``."""

    normal: tuple[float, float, float]
    offset: float
    texture: np.ndarray
    half: float = np.inf


def leaves(seed, contrast=45.0):
    """A ``(512, 512)`` texture with detail of several pixels."""
    noise = np.random.default_rng(seed).standard_normal((512, 512)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, None, 2.0)
    return 128 + contrast * smooth / smooth.std()


def seen(planes, T_world_cam):
    """Return grey levels and depth ``(H, W)`` of the nearest plane along each ray."""
    xs, ys = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = CAMERA.unproject(np.stack([xs.ravel(), ys.ravel()], axis=1)) @ T_world_cam[:3, :3].T
    centre = T_world_cam[:3, 3]
    depth, grey = np.full(len(rays), np.inf), np.full(len(rays), 128.0)
    for plane in planes:
        n = np.array(plane.normal)
        z = (plane.offset - n @ centre) / (rays @ n)
        points = centre + z[:, None] * rays
        hit = (z > 0) & (z < depth) & (np.abs(points[:, :2]) <= plane.half).all(axis=1)
        uv = (points[:, :2] * _PER_UNIT % 511).astype(np.float32)
        depth[hit] = z[hit]
        grey[hit] = cv2.remap(plane.texture, uv[:, :1], uv[:, 1:], cv2.INTER_LINEAR)[hit, 0]
    return grey.reshape(xs.shape), depth.reshape(xs.shape)


class Stand:
    """Views of planes from places along the world's x, the camera looking along z."""

    def __init__(self, planes, xs, noise_sd=1.5):
        rng = np.random.default_rng(3)
        self.poses = [make_transform(np.eye(3), (x, 0.0, 0.0)) for x in xs]
        drawn = [seen(planes, pose) for pose in self.poses]
        self.depths = [depth for _, depth in drawn]
        noisy = [grey + rng.normal(0, noise_sd, grey.shape) for grey, _ in drawn]
        images = [np.clip(np.rint(g), 0, 255).astype(np.uint8)[..., None].repeat(3, axis=2) for g in noisy]
        self.views = [view_of(k, image, None, CAMERA) for k, image in enumerate(images)]

    def T(self, to, of):
        """Return the transform between the frames of two cameras."""
        return invert_transform(self.poses[to]) @ self.poses[of]

    def neighbour(self, k, of):
        return Neighbour(self.views[k], self.T(k, of))


@pytest.fixture(scope="session")
def stand():
    return Stand


@pytest.fixture(scope="session")
def slant():
    """A wall that recedes to the right, 3 to 5 units away."""
    return Plane((-0.35, 0.0, 1.0), 4.0, leaves(1))


@pytest.fixture(scope="session")
def wall():
    return Plane((0.0, 0.0, 1.0), 4.0, leaves(1))


@pytest.fixture(scope="session")
def faint_wall():
    return Plane((0.0, 0.0, 1.0), 4.0, leaves(1, contrast=3.0))


@pytest.fixture(scope="session")
def plate():
    """A small square before the wall."""
    return Plane((0.0, 0.0, 1.0), 2.0, leaves(2), half=0.4)


@pytest.fixture(scope="session")
def plain_wall():
    return Plane((0.0, 0.0, 1.0), 4.0, np.full((512, 512), 150.0, np.float32))
