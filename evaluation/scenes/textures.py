"""Surfaces to paint scenes with: dead leaves, house fronts, asphalt, plain paint.

Dead leaves, shapes of all sizes that hide one another, have edges and spectra much like those of photographs
(Lee, Mumford and Huang, "Occlusion models for natural images", 2001), so trackers find in them what they find
in the world.
"""

from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

#: Centre, axes and angle in degrees, as OpenCV has them.
_Ellipse = tuple[tuple[float, float], tuple[float, float], float]

_SIDE_PX = 512
_NUM_LEAVES = 1500


class Texture:
    """An image to paint surfaces with, shrunk only once it is looked at: most of a scene is seldom in view.

    Attributes:
        image: ``(H, W, 3)`` at full size.
    """

    def __init__(self, image: NDArray[np.uint8]) -> None:
        """Keep an image."""
        self.image = image

    @cached_property
    def levels(self) -> tuple[NDArray[np.float32], ...]:
        """The image at full, half, quarter, ... size, down to 4 pixels."""
        levels = [self.image.astype(np.float32)]
        while min(levels[-1].shape[:2]) > 4:
            height, width = levels[-1].shape[:2]
            half = cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
            levels.append(half.astype(np.float32))
        return tuple(levels)


def dead_leaves(rng: np.random.Generator, contrast: float = 1.0, max_radius_share: float = 0.25) -> Texture:
    """Return shapes of power-law sizes in colours of a small palette.

    Args:
        rng: Source of shapes and colours.
        contrast: Spread of the colours about their mean, 1 for the full range.
        max_radius_share: Radius of the largest shape as a share of the side.
    """
    mean = _colours(rng, 1, 80, 170)[0]
    palette = np.clip(mean + contrast * (_colours(rng, 12, 0, 200) - 100), 0, 255)
    image = np.full((_SIDE_PX, _SIDE_PX, 3), mean, np.uint8)
    # Between many small ones (density r^-3, equal at all scales) and clear large ones: r^-2.5.
    least, most = 2.0, max_radius_share * _SIDE_PX
    shares = rng.uniform(0, 1, _NUM_LEAVES)
    radii = ((1 - shares) * least**-1.5 + shares * most**-1.5) ** (-1 / 1.5)
    # A call of numpy costs more than a leaf: numbers are scaled here, colours and corners found for all.
    colour_idx, offsets, polygons = [], [], []
    ellipses: list[_Ellipse | None] = []
    for radius in radii.tolist():
        colour_idx.append(rng.integers(12))
        offsets.append(rng.standard_normal())
        centre = (_SIDE_PX * rng.random(), _SIDE_PX * rng.random())
        if rng.random() < 0.5:
            axes = (2 * radius, 2 * radius * (0.4 + 0.6 * rng.random()))
            ellipses.append((centre, axes, 180 * rng.random()))
        else:
            ellipses.append(None)
            polygons.append((*centre, radius, sorted(rng.random(rng.integers(3, 6)).tolist())))
    colours = palette[colour_idx] + 9 * contrast * np.array(offsets)[:, None]
    corners = iter(_corners(polygons))
    for ellipse, colour in zip(ellipses, colours.tolist(), strict=True):
        if ellipse is not None:
            cv2.ellipse(image, ellipse, colour, -1)
        else:
            cv2.fillPoly(image, [next(corners)], colour)
    return Texture(_grained(image, rng, 4 * contrast))


def _corners(polygons: list[tuple[float, float, float, list[float]]]) -> list[NDArray[np.int32]]:
    """Return corners ``(N, 2)`` of polygons given by x, y and radius of a circle and shares of a turn."""
    nums = [len(shares) for *_, shares in polygons]
    circles = np.repeat([circle for *circle, _ in polygons], nums, axis=0)
    angles = 2 * np.pi * np.concatenate([shares for *_, shares in polygons])
    corners = circles[:, :2] + circles[:, 2:] * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.split(corners.astype(np.int32), np.cumsum(nums)[:-1])


def facade(rng: np.random.Generator) -> Texture:
    """Return a house front: rows of windows, all alike but for what stands in them, over a plain wall."""
    wall = _colours(rng, 1, 90, 200)[0]
    image = np.full((_SIDE_PX, _SIDE_PX, 3), wall, np.uint8)
    if rng.uniform() < 0.5:
        for y in range(0, _SIDE_PX, 8):
            cv2.line(image, (0, y), (_SIDE_PX, y), _as_tuple(wall * 0.9), 1)
    floors, columns = int(rng.integers(3, 6)), int(rng.integers(3, 6))
    width, height = rng.uniform(0.35, 0.6) / columns, rng.uniform(0.45, 0.65) / floors
    frame = _as_tuple(_colours(rng, 1, 150, 250)[0])
    for row in range(floors):
        for column in range(columns):
            left, top = (column + 0.5) / columns - width / 2, (row + 0.5) / floors - height / 2
            corner, other = _pixels(left, top), _pixels(left + width, top + height)
            cv2.rectangle(image, corner, other, _as_tuple(_colours(rng, 1, 10, 90)[0]), -1)
            curtain = rng.uniform(0, 0.7)
            shade = _as_tuple(_colours(rng, 1, 80, 230)[0])
            cv2.rectangle(image, corner, _pixels(left + width, top + height * curtain), shade, -1)
            cv2.rectangle(image, corner, other, frame, 3)
    stains = cv2.resize(rng.normal(0, 14, (16, 16)).astype(np.float32), (_SIDE_PX, _SIDE_PX))
    return Texture(_grained(np.clip(image + stains[..., None], 0, 255).astype(np.uint8), rng, 4))


def asphalt(rng: np.random.Generator) -> Texture:
    """Return a grey road with stains and patches of low contrast."""
    stains = cv2.resize(rng.normal(0, 7, (24, 24)).astype(np.float32), (_SIDE_PX, _SIDE_PX))
    image = np.clip(105 + stains, 0, 255)[..., None].repeat(3, axis=2).astype(np.uint8)
    for _ in range(6):
        corner = rng.integers(0, _SIDE_PX, 2)
        other = corner + rng.integers(20, 120, 2)
        grey = float(rng.uniform(85, 125))
        cv2.rectangle(image, corner.tolist(), other.tolist(), (grey, grey, grey), -1)
    return Texture(_grained(image, rng, 9))


def paint(rng: np.random.Generator, grain: float = 2.0) -> Texture:
    """Return one colour with a soft change of light across it."""
    colour = _colours(rng, 1, 60, 220)[0]
    light = cv2.resize(rng.normal(0, 8, (3, 3)).astype(np.float32), (_SIDE_PX, _SIDE_PX))
    image = np.clip(colour + light[..., None], 0, 255).astype(np.uint8)
    return Texture(_grained(image, rng, grain))


def _colours(rng: np.random.Generator, num: int, low: float, high: float) -> NDArray[np.float64]:
    """Return ``(num, 3)`` greys with a little colour: channels of photographs are alike too."""
    greys = rng.uniform(low, high, (num, 1))
    return np.asarray(np.clip(greys + rng.normal(0, 0.09 * (low + high), (num, 3)), 0, 255))


def _as_tuple(colour: NDArray[np.float64]) -> tuple[float, ...]:
    return tuple(colour.tolist())


def _pixels(x: float, y: float) -> tuple[int, int]:
    return int(x * _SIDE_PX), int(y * _SIDE_PX)


def _grained(image: NDArray[np.uint8], rng: np.random.Generator, sigma: float) -> NDArray[np.uint8]:
    # Whole levels of grain added to whole ones: what rounding down the sum would give.
    grain = np.floor(rng.normal(0, sigma, image.shape[:2])).astype(np.int16)
    return np.asarray(cv2.add(image, cv2.merge([grain] * 3), dtype=cv2.CV_8U), np.uint8)
