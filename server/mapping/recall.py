"""Landmarks that are in sight but have lost their track are looked for again, where the pose expects them.

Rows that did not arrive, a blur or a jerk end tracks; their landmarks are still in the map. They are followed
from the newest keyframes they were seen in, whose images are kept.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, transform_points
from semcast.server.geometry.features import Grey
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.tracks import TrackTable
from semcast.server.mapping.world_map import WorldMap

Array = NDArray[np.float64]

#: Keyframes that are looked at here, the newest ones.
_NUM_RECALLED = 3
#: A point is looked for no nearer to the border than this.
_BORDER_PX = 8


@dataclass(frozen=True)
class SeenFrom:
    """A keyframe and its image."""

    frame_id: int
    grey: Grey


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


def recall_landmarks(
    camera: Intrinsics,
    world: WorldMap,
    images: KeyframeImages,
    tracks: TrackTable,
    sight: Sight,
    T_world_cam: Array,
    *,
    submap: int,
    reach_px: float,
    wanted: int,
) -> NDArray[np.int64]:
    """Look for landmarks of the newest keyframes that have no track; each found one gets its track back.

    Args:
        camera: Pinhole.
        world: The map.
        images: Of keyframes.
        tracks: After the new image was followed; grows.
        sight: The new image.
        T_world_cam: Its pose, or the expected one.
        submap: The current one; landmarks of others are not in the same world.
        reach_px: A point found further than this from where it is expected is another one.
        wanted: With so many found, older keyframes are not looked at any more.

    Returns:
        Ids of the tracks that were found.
    """
    T_cam_world = invert_transform(T_world_cam)
    found = [np.zeros(0, np.int64)]
    for image in reversed(images.newest(_NUM_RECALLED)):
        if sum(map(len, found)) >= wanted:
            break
        keyframe = world.keyframe(image.frame_id)
        if keyframe is None or keyframe.submap != submap:
            continue
        row = world.landmarks.rows(keyframe.ids)
        lost = np.flatnonzero((row >= 0) & ~np.isin(keyframe.ids, tracks.ids, assume_unique=True))
        points_cam = transform_points(T_cam_world, world.landmarks.xyz[row[lost]])
        expected = camera.project(points_cam)
        in_sight = sight.shows(expected, _BORDER_PX)
        lost, expected = lost[in_sight], expected[in_sight]
        if len(lost):
            seen = keyframe.ids[lost], keyframe.xy[lost]
            found.append(tracks.take_up(sight, image.grey, *seen, expected, reach_px))
    return np.concatenate(found)
