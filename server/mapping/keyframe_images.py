"""Images of keyframes, which are kept so that landmarks can be looked for again by how they looked there."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.geometry.grey import Grey
from semcast.server.geometry.streaks import band_power
from semcast.server.mapping.world_map import Keyframe, WorldMap


@dataclass(frozen=True)
class SeenFrom:
    """The image of a keyframe.

    Attributes:
        frame_id: Of the keyframe.
        grey: ``(H, W)`` uint8, as its tracks were followed in it.
    """

    frame_id: int
    grey: Grey

    @cached_property
    def band_power(self) -> NDArray[np.float64]:
        """Of the image, see ``streaks``: by that streaks of motion blur are told."""
        return band_power(self.grey)


class KeyframeImages:
    """Images of keyframes, bounded in number: of too many, an older one close to others goes.

    Args:
        capacity: Images kept at most, three or more.

    Raises:
        ValueError: There is no older one between others to go.
    """

    def __init__(self, capacity: int) -> None:
        if capacity < 3:
            raise ValueError(f"capacity must be at least 3, got {capacity}")
        self._capacity = capacity
        self._images: list[SeenFrom] = []

    def __len__(self) -> int:
        return len(self._images)

    def __iter__(self) -> Iterator[SeenFrom]:
        """Yield them, oldest first."""
        return iter(self._images)

    def append(self, image: SeenFrom) -> None:
        """Keep the image of the newest keyframe."""
        self._images.append(image)
        if len(self._images) > self._capacity:
            ids = np.array([image.frame_id for image in self._images[: len(self._images) // 2 + 1]])
            del self._images[1 + int(np.argmin(ids[2:] - ids[:-2]))]

    def replace(self, image: SeenFrom) -> None:
        """Take another version of a keyframe's image, if it is kept."""
        self._images = [image if kept.frame_id == image.frame_id else kept for kept in self._images]

    def keep(self, keyframe_ids: set[int]) -> None:
        """Forget images of other keyframes."""
        self._images = [image for image in self._images if image.frame_id in keyframe_ids]

    def newest(self, count: int) -> list[SeenFrom]:
        """Return the newest ones, oldest first."""
        return self._images[-count:]


class ImagedMap(NamedTuple):
    """The part of a map the camera is in, with images of its keyframes.

    Attributes:
        camera: Pinhole.
        world: The whole map.
        images: Of keyframes.
        submap: The part; landmarks of others are not in the same world.
    """

    camera: Intrinsics
    world: WorldMap
    images: KeyframeImages
    submap: int

    def newest_views(self, count: int) -> list[tuple[SeenFrom, Keyframe]]:
        """Return those of the newest ``count`` images whose keyframes are in the submap, oldest first."""
        there = [(image, self.world.keyframe(image.frame_id)) for image in self.images.newest(count)]
        return [(image, k) for image, k in there if k is not None and k.submap == self.submap]
