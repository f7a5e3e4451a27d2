"""Takes the drift out of tracks: at keyframes they are aligned with how an earlier keyframe saw them.

Following a point from image to image makes a small error at every step, and a larger one where images are
noisy: about a pixel in a dozen decoded frames. At a keyframe the pose is known, so that the patch of an older
keyframe can be warped to how it should look now, and the point put back on it.
"""

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform
from semcast.server.geometry.patch_alignment import Templates, affine_warps, align_patches, seen_alike
from semcast.server.geometry.pnp import MIN_DEPTH_MAP
from semcast.server.mapping.recall import KeyframeImages
from semcast.server.mapping.tracks import Sight, TrackTable
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]

#: Keyframes that are looked at, the newest ones, as many as an adjustment takes.
NUM_ANCHORS = 10
#: A point that would move further than this has found something else.
_MAX_MOVE_PX = 3.0
_MIN_CORRELATION = 0.7


def anchor_tracks(
    camera: Intrinsics,
    world: WorldMap,
    images: KeyframeImages,
    tracks: TrackTable,
    sight: Sight,
    T_world_cam: Array,
    *,
    submap: int,
) -> int:
    """Align the tracks of landmarks in sight, each with the oldest kept keyframe that saw it.

    A track that does not fit there stays where it is.

    Args:
        camera: Pinhole.
        world: The map.
        images: Of keyframes.
        tracks: Followed to the new image; moved.
        sight: The new image.
        T_world_cam: Its pose.
        submap: The current one.

    Returns:
        How many tracks were aligned.
    """
    by_id = {k.frame_id: k for k in world.keyframes_of(submap)}
    T_cam_world = invert_transform(T_world_cam)
    landmark = world.landmarks.rows(tracks.ids)
    waiting = tracks.visible & (landmark >= 0)
    parts: list[tuple[NDArray[np.intp], Array, Templates]] = []
    for image in images.newest(NUM_ANCHORS):  # oldest first
        keyframe = by_id.get(image.frame_id)
        if keyframe is None:
            continue
        rows, xy0 = _shared(tracks, waiting, keyframe)
        T_anchor_world = invert_transform(keyframe.T_world_cam)
        depth = world.landmarks.xyz[landmark[rows]] @ T_anchor_world[2, :3] + T_anchor_world[2, 3]
        before = depth > MIN_DEPTH_MAP
        rows, xy0, depth = rows[before], xy0[before], depth[before]
        warps, depth_now = affine_warps(camera, T_cam_world @ keyframe.T_world_cam, xy0, depth)
        alike = seen_alike(warps, depth_now)
        if alike.any():
            parts.append((rows[alike], warps[alike], Templates.cut(image.grey, xy0[alike])))
            waiting[rows[alike]] = False
    if not parts:
        return 0
    rows, warps = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    templates = Templates.join([part[2] for part in parts])
    found = align_patches(templates, sight.grey, tracks.xy[rows], warps)
    near = np.linalg.norm(found.xy - tracks.xy[rows], axis=1) < _MAX_MOVE_PX
    fits = near & (found.correlation > _MIN_CORRELATION)
    tracks.settle_at(rows[fits], found.xy[fits])
    return int(fits.sum())


def _shared(
    tracks: TrackTable, waiting: NDArray[np.bool_], keyframe: Keyframe
) -> tuple[NDArray[np.intp], Array]:
    """Rows of waiting tracks that a keyframe saw too, and where."""
    rows = np.flatnonzero(waiting)
    _, mine, theirs = np.intersect1d(tracks.ids[rows], keyframe.ids, assume_unique=True, return_indices=True)
    return rows[mine], keyframe.xy[theirs]
