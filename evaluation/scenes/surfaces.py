"""Textured rectangles and the picture a pinhole camera has of them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.evaluation.scenes.textures import Texture

Array = NDArray[np.float64]

#: Nothing nearer than this is drawn, in metres.
NEAR_M = 0.05
#: Nothing farther than one over this is drawn, per metre.
_LEAST_INVERSE_DEPTH = np.float32(1e-4)
#: Places of a texture that are looked up in one row.
_ROW = 128
#: Brightness of a box's four sides, top and bottom.
_BOX_LIGHTS = (0.75, 0.9, 1.0, 0.82, 1.1, 0.5)


@dataclass(frozen=True, eq=False)
class Surface:
    """A textured rectangle, seen from both sides.

    Attributes:
        corner_m: ``(3,)`` world position of texture coordinate (0, 0).
        edge_u_m: ``(3,)`` from there along the texture's rows.
        edge_v_m: ``(3,)`` from there along its columns, perpendicular to ``edge_u_m``.
        texture: What is painted on it.
        repeats: How often the texture fits along each edge.
        light: Factor on the texture's brightness.
    """

    corner_m: Array
    edge_u_m: Array
    edge_v_m: Array
    texture: Texture
    repeats: tuple[float, float] = (1.0, 1.0)
    light: float = 1.0

    @cached_property
    def spans_m(self) -> Array:
        """``(3, 3)`` with edges and corner as columns: times ``(u, v, 1)``, a point of the rectangle."""
        return np.column_stack([self.edge_u_m, self.edge_v_m, self.corner_m])


def box(
    centre_m: Sequence[float],
    size_m: Sequence[float],
    yaw_rad: float,
    textures: Sequence[Texture],
) -> list[Surface]:
    """Return the six sides of a box that stands upright.

    Args:
        centre_m: Its middle in the world, z up.
        size_m: Length, width and height.
        yaw_rad: Turn about the vertical.
        textures: Used in turn for the four sides, top and bottom.
    """
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    along = np.array([cos, sin, 0.0]) * size_m[0] / 2
    across = np.array([-sin, cos, 0.0]) * size_m[1] / 2
    up = np.array([0.0, 0.0, size_m[2] / 2])
    middle = np.asarray(centre_m, np.float64)
    sides = [
        (middle - along + across + up, 2 * along, -2 * up),
        (middle + along + across + up, -2 * across, -2 * up),
        (middle + along - across + up, -2 * along, -2 * up),
        (middle - along - across + up, 2 * across, -2 * up),
        (middle - along - across + up, 2 * along, 2 * across),
        (middle - along - across - up, 2 * along, 2 * across),
    ]
    return [
        Surface(corner, edge_u, edge_v, textures[i % len(textures)], light=_BOX_LIGHTS[i])
        for i, (corner, edge_u, edge_v) in enumerate(sides)
    ]


def draw(
    surfaces: Sequence[Surface], camera: Intrinsics, T_world_cam: Array, background: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return what the camera sees, each pixel one sample at its centre.

    Args:
        surfaces: What is in the scene; the nearest hides the others.
        camera: Pinhole, distortion ignored.
        T_world_cam: ``(4, 4)`` pose, camera axes x right, y down, z forward.
        background: ``(H, W, 3)`` seen where no surface is.

    Returns:
        ``(H, W, 3)`` in grey levels 0..255.
    """
    image = background.copy()
    nearest = np.full((camera.height, camera.width), _LEAST_INVERSE_DEPTH, np.float32)
    for surface, G, window in _seen(surfaces, camera, T_world_cam):
        _paint(image, nearest, surface, G, window)
    return image


def exact_depth(surfaces: Sequence[Surface], camera: Intrinsics, T_world_cam: Array) -> NDArray[np.float32]:
    """Return how far along its view the camera sees the nearest surface at the centre of each pixel.

    Args:
        surfaces: What is in the scene.
        camera: Pinhole, distortion ignored.
        T_world_cam: ``(4, 4)`` pose, camera axes x right, y down, z forward.

    Returns:
        ``(H, W)`` camera z in metres, infinite where no surface is.
    """
    nearest = np.full((camera.height, camera.width), _LEAST_INVERSE_DEPTH, np.float32)
    for _, G, window in _seen(surfaces, camera, T_world_cam):
        if (hit := _hit(nearest, G, window)) is not None:
            nearest[window][hit.visible] = hit.inverse_depth
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / np.where(nearest > _LEAST_INVERSE_DEPTH, nearest, 0.0), np.float32)


def _seen(
    surfaces: Sequence[Surface], camera: Intrinsics, T_world_cam: Array
) -> Iterator[tuple[Surface, Array, tuple[slice, slice]]]:
    """Yield the rectangles that may be seen, the nearest first.

    Each comes with the map from pixels to ``(u, v, 1)`` over depth, and rows and columns it may cover.
    """
    R_cam_world, centre = T_world_cam[:3, :3].T, T_world_cam[:3, 3]
    # Columns span each plane in the camera's frame, so that A (u, v, 1) is a point of it.
    spans_m = np.array([surface.spans_m for surface in surfaces])
    spans_m[:, :, 2] -= centre
    As = R_cam_world @ spans_m
    corners = As @ np.array([[0, 1, 1, 0], [0, 0, 1, 1], [1, 1, 1, 1]])  # (N, 3, 4)
    order = _in_view(corners, camera)
    low, high = _windows(corners[order], camera)
    seen = (low < high).all(1) & (np.abs(np.linalg.det(As[order])) > 1e-9)
    order, low, high = order[seen], low[seen], high[seen]
    Gs = np.linalg.inv(As[order]) @ np.linalg.inv(camera.K)
    for index, G, (left, top), (right, bottom) in zip(
        order.tolist(), Gs, low.tolist(), high.tolist(), strict=True
    ):
        yield surfaces[index], G, (slice(top, bottom), slice(left, right))


def _in_view(corners: Array, camera: Intrinsics) -> NDArray[np.intp]:
    """Return which rectangles ``(N, 3, 4)`` may be seen, the nearest first: what they hide is not painted."""
    x, y, z = corners[:, 0], corners[:, 1], corners[:, 2]
    left, right = (0 - camera.cx) / camera.fx, (camera.width - camera.cx) / camera.fx
    top, bottom = (0 - camera.cy) / camera.fy, (camera.height - camera.cy) / camera.fy
    beside = (x < left * z).all(1) | (x > right * z).all(1) | (y < top * z).all(1) | (y > bottom * z).all(1)
    seen = np.flatnonzero(~beside & (z >= NEAR_M).any(1))
    order = np.argsort(np.linalg.norm(corners[seen], axis=1).min(1))
    return np.asarray(seen[order])


def _windows(corners: Array, camera: Intrinsics) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first pixel and the one past the last, both ``(N, 2)``, that rectangles may cover.

    Args:
        corners: ``(N, 3, 4)`` in the camera's frame, one at least of each in front of it.
        camera: Pinhole, distortion ignored.
    """
    following = np.roll(corners, -1, axis=2)
    in_front = corners[:, 2] >= NEAR_M
    crosses = in_front != (following[:, 2] >= NEAR_M)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        shares = (NEAR_M - corners[:, 2]) / (following[:, 2] - corners[:, 2])
        cuts = corners + shares[:, None] * (following - corners)
        points = np.concatenate([corners, cuts], axis=2)
        pixels = points[:, :2] / points[:, 2:] * np.array([[camera.fx], [camera.fy]])
        pixels += np.array([[camera.cx], [camera.cy]])
    kept = np.concatenate([in_front, crosses], axis=1)[:, None]
    low = np.maximum(np.floor(np.where(kept, pixels, np.inf).min(2)), 0)
    high = np.ceil(np.where(kept, pixels, -np.inf).max(2)) + 1
    return low.astype(np.intp), np.minimum(high, (camera.width, camera.height)).astype(np.intp)


@dataclass(frozen=True, eq=False)
class _Hit:
    """Where a rectangle is the nearest: pixels ``(H, W)`` of a window, and values ``(N,)`` at those."""

    visible: NDArray[np.bool_]
    u: NDArray[np.float32]
    v: NDArray[np.float32]
    inverse_depth: NDArray[np.float32]


def _hit(nearest: NDArray[np.float32], G: Array, window: tuple[slice, slice]) -> _Hit | None:
    """Tell where a rectangle is nearer than what is there; ``G`` maps pixels to ``(u, v, 1)`` over depth."""
    rows, columns = window
    ys = np.arange(rows.start, rows.stop, dtype=np.float32)[:, None]
    xs = np.arange(columns.start, columns.stop, dtype=np.float32)
    G32 = G.astype(np.float32)
    inverse_depth = G32[2, 0] * xs + G32[2, 1] * ys + G32[2, 2]
    visible = (inverse_depth > nearest[window]) & (inverse_depth < 1 / NEAR_M)
    if not visible.any():
        return None
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        u = (G32[0, 0] * xs + G32[0, 1] * ys + G32[0, 2]) / inverse_depth
        v = (G32[1, 0] * xs + G32[1, 1] * ys + G32[1, 2]) / inverse_depth
        visible &= (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
    return _Hit(visible, u[visible], v[visible], inverse_depth[visible]) if visible.any() else None


def _paint(
    image: NDArray[np.float32],
    nearest: NDArray[np.float32],
    surface: Surface,
    G: Array,
    window: tuple[slice, slice],
) -> None:
    """Draw one rectangle where it is the nearest; ``G`` maps pixels to ``(u, v, 1)`` over depth."""
    hit = _hit(nearest, G, window)
    if hit is None:
        return
    levels = surface.texture.levels
    tall, wide = levels[0].shape[:2]
    wide, tall = wide * surface.repeats[0], tall * surface.repeats[1]
    # Texture pixels under an image pixel decide the level, half a level sharper: pixels have several samples.
    area = abs(np.linalg.det(G)) * wide * tall / hit.inverse_depth**3
    level = np.clip(0.5 * np.log2(area) - 0.5, 0, len(levels) - 1)
    # Colour by colour: numpy takes ten times as long to pick or set pixels of three values.
    shown = np.zeros((3, len(level)), np.float32)
    for k in range(int(level.min()), int(np.ceil(level.max())) + 1):
        weights = 1 - np.abs(level - k)
        mixed = np.flatnonzero(weights > 0)
        if len(mixed) == 0:
            continue  # of a few pixels, some are near and the others far
        weights = weights[mixed].astype(np.float32)
        layer = _looked_up(levels[k], surface.repeats, hit.u[mixed], hit.v[mixed])
        for colour in range(3):
            shown[colour, mixed] += weights * layer[:, colour]
    picture = image[window]
    for colour in range(3):
        picture[..., colour][hit.visible] = shown[colour] * surface.light
    nearest[window][hit.visible] = hit.inverse_depth


def _looked_up(
    texture: NDArray[np.float32],
    repeats: tuple[float, float],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return ``(N, 3)`` colours of a texture that fits so often, at places ``(N,)`` in [0, 1]."""
    # OpenCV takes images of less than 2^15 rows and columns, so places fill rows.
    maps = np.zeros((2, -(-len(u) // _ROW), _ROW), np.float32)
    maps[0].ravel()[: len(u)] = u * (texture.shape[1] * repeats[0]) - 0.5
    maps[1].ravel()[: len(v)] = v * (texture.shape[0] * repeats[1]) - 0.5
    layer = cv2.remap(texture, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(layer.reshape(-1, 3)[: len(u)], np.float32)
