"""Takes the drift out of tracks: at keyframes they are aligned with how earlier keyframes saw them.

Following a point from image to image makes a small error at every step, and a larger one where images are
noisy: about a pixel in a dozen decoded frames. At a keyframe the pose is known, so that patches of older
keyframes can be warped to how they should look now, and the point put back on them. Every older image has
noise of its own, so a point is aligned with all of them and put in the median of where they have it.
"""

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform
from semcast.server.geometry.patch_alignment import (
    ANCHOR_PATCH_PX,
    Templates,
    affine_warps,
    align_patches,
    seen_alike,
)
from semcast.server.geometry.pnp import MIN_DEPTH_MAP
from semcast.server.geometry.weighting import MAD_TO_SIGMA
from semcast.server.mapping.recall import KeyframeImages
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.tracks import TrackTable
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]

#: Keyframes that are looked at, the newest ones.
NUM_ANCHORS = 10
#: Places from which on their scatter tells how well a track is known.
_MIN_PLACES = 4
#: Landmarks next to a track without one, by which its patch is warped, and how many a keyframe must show.
_NEIGHBOURS, _MIN_LANDMARKS = 5, 5


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
    """Align the tracks in sight with the kept keyframes that saw them.

    Of each track the median of the positions that fit is taken, and their scatter for how well it is known;
    one that fits nowhere stays where it is.

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
    parts: list[tuple[NDArray[np.intp], Array, Templates]] = []
    for image in images.newest(NUM_ANCHORS):
        keyframe = by_id.get(image.frame_id)
        if keyframe is None:
            continue
        rows, xy0 = _shared(tracks, keyframe)
        depth = _depths(world, keyframe, tracks.ids[rows], xy0)
        told = depth > 0.0
        rows, xy0, depth = rows[told], xy0[told], depth[told]
        warps, depth_now = affine_warps(camera, T_cam_world @ keyframe.T_world_cam, xy0, depth)
        alike = seen_alike(warps, depth_now)
        if alike.any():
            parts.append((rows[alike], warps[alike], Templates.cut(image.grey, xy0[alike], ANCHOR_PATCH_PX)))
    if not parts:
        return 0
    rows, warps = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    found = align_patches(Templates.join([part[2] for part in parts]), sight.grey, tracks.xy[rows], warps)
    fits = found.fits(tracks.xy[rows])
    anchor = np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts])
    places = np.full((len(parts), len(tracks), 2), np.nan)
    places[anchor[fits], rows[fits]] = found.xy[fits]
    aligned = np.unique(rows[fits])
    middle, scatter_px2 = _middle(places[:, aligned])
    tracks.settle_at(aligned, middle, scatter_px2)
    return len(aligned)


def _middle(places: Array) -> tuple[Array, Array]:
    """Median ``(N, 2)`` of places ``(K, N, 2)``, NaN for none, and their variance ``(N,)`` per coordinate.

    The variance is that of a normal distribution with their median absolute deviation, NaN where there are
    too few places.
    """
    middle = np.nanmedian(places, axis=0)
    deviation_px = MAD_TO_SIGMA * np.nanmedian(np.abs(places - middle), axis=0).mean(axis=1)
    enough = np.isfinite(places[..., 0]).sum(axis=0) >= _MIN_PLACES
    return middle, np.where(enough, deviation_px**2, np.nan)


def _shared(tracks: TrackTable, keyframe: Keyframe) -> tuple[NDArray[np.intp], Array]:
    """Rows of visible tracks that a keyframe saw too, and where."""
    rows = np.flatnonzero(tracks.visible)
    _, mine, theirs = np.intersect1d(tracks.ids[rows], keyframe.ids, assume_unique=True, return_indices=True)
    return rows[mine], keyframe.xy[theirs]


def _depths(world: WorldMap, keyframe: Keyframe, ids: NDArray[np.int64], xy: Array) -> Array:
    """Depth in a keyframe of each of its points ``(N,)``, in map units; 0 where nothing tells it.

    That of its landmark; of a point that has none yet, or one behind the camera, the median of the inverse
    depths of the landmarks next to it, which is near enough for a warp.
    """
    T_cam_world = invert_transform(keyframe.T_world_cam)
    landmark = world.landmarks.rows(ids)
    depth = np.zeros(len(ids))
    known = landmark >= 0
    depth[known] = world.landmarks.xyz[landmark[known]] @ T_cam_world[2, :3] + T_cam_world[2, 3]
    known = depth > MIN_DEPTH_MAP
    depth[~known] = 0.0
    if known.sum() >= _MIN_LANDMARKS and not known.all():
        x, y = xy.astype(np.float32).T
        square = (x[~known, None] - x[known]) ** 2 + (y[~known, None] - y[known]) ** 2
        near = np.argpartition(square, _NEIGHBOURS - 1, axis=1)[:, :_NEIGHBOURS]
        depth[~known] = 1.0 / np.median(1.0 / depth[known][near], axis=1)
    return depth
