"""Aligns tracks with patches of earlier keyframes: takes out their drift, and detects false matches.

Following a point from image to image makes a small error at every step, and a larger one where images are
noisy: about a pixel in a dozen decoded frames. At a keyframe the pose is known, so that patches of older
keyframes can be warped to how they should look now, and the point put back on them. Every older image has
noise of its own, so a point is aligned with all of them and put in the median of where they have it.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import invert_transform
from semcast.server.geometry.patch_alignment import (
    ANCHOR_PATCH_PX,
    AlignedPatches,
    Templates,
    affine_warps,
    align_patches,
    seen_alike,
)
from semcast.server.geometry.projection import MIN_DEPTH_MAP, depths_in
from semcast.server.geometry.weighting import MAD_TO_SIGMA
from semcast.server.mapping.keyframe_images import ImagedMap, SeenFrom
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.track_ids import shared_rows
from semcast.server.mapping.tracks import TrackTable
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]

#: Keyframes that are looked at, the newest ones.
NUM_ANCHORS = 10
#: Side and stride in pixels of the patches by which tracks are put back: a small one finds what is a pixel or
#: two off, and has less of what is behind an outline.
_FINE_PATCH = (11, 1)
#: Side and stride of those by which tracks are told from chance finds, whose correlation needs more around.
_WHOLE_PATCH = (ANCHOR_PATCH_PX, 2)
#: Keyframes a track must be aligned with for the scatter of the places to tell how well it is known.
_MIN_PLACES = 4
#: The newest keyframes that the tracks behind a pose are compared with.
_NUM_COMPARED = 3
#: Of the tracks those show, how many must look as they did. Behind gaps of 3 to 10 frames 46 to 100 % of 11
#: to 122 did where the pose was right, in noisy images too, and none of 2 to 39 where it was wrong.
_MIN_ALIKE = 5
#: The same as a share.
_MIN_ALIKE_SHARE = 0.2
#: Landmarks next to a track without a depth, by which its patch is warped.
_NEIGHBOURS = 5
#: Landmarks a keyframe must show for that.
_MIN_LANDMARKS = 5


def anchor_tracks(mapped: ImagedMap, tracks: TrackTable, sight: Sight, T_world_cam: Array) -> int:
    """Align the tracks in sight with the kept keyframes that saw them.

    Of each track the median of the positions that fit is taken, and their scatter for how well it is known;
    one that fits nowhere stays where it is.

    Args:
        mapped: Keyframes, their images and landmarks.
        tracks: Followed to the new image; moved.
        sight: The new image.
        T_world_cam: Its pose.

    Returns:
        How many tracks were aligned.
    """
    views = mapped.newest_views(NUM_ANCHORS)
    all_rows = np.flatnonzero(tracks.visible)
    aligned = _align(mapped, views, tracks, all_rows, sight, T_world_cam, _FINE_PATCH)
    if aligned is None:
        return 0
    rows, anchor, found = aligned
    fits = found.fits(tracks.xy[rows])
    places = np.full((len(views), len(tracks), 2), np.nan)
    places[anchor[fits], rows[fits]] = found.xy[fits]
    settled = np.unique(rows[fits])
    middle, scatter_px2 = _middle(places[:, settled])
    tracks.settle_at(settled, middle, scatter_px2)
    return len(settled)


def resembles(
    mapped: ImagedMap, tracks: TrackTable, sight: Sight, T_world_cam: Array, ids: NDArray[np.int64]
) -> bool:
    """Tell whether tracks that agree with a pose show what the newest keyframes saw.

    KLT finds something near almost any guess, and all that was found near one guess agrees with its pose.

    Args:
        mapped: Keyframes, their images and landmarks.
        tracks: Followed to the new image.
        sight: The new image.
        T_world_cam: Its pose.
        ids: ``(N,)`` the tracks that agree.
    """
    views = mapped.newest_views(_NUM_COMPARED)
    rows = np.flatnonzero(tracks.visible & np.isin(tracks.ids, ids))
    aligned = _align(mapped, views, tracks, rows, sight, T_world_cam, _WHOLE_PATCH)
    if aligned is None:
        return False
    rows, _, found = aligned
    num_alike = len(np.unique(rows[found.fits(tracks.xy[rows])]))
    return num_alike >= max(_MIN_ALIKE, _MIN_ALIKE_SHARE * len(np.unique(rows)))


def _align(
    mapped: ImagedMap,
    views: Sequence[tuple[SeenFrom, Keyframe]],
    tracks: TrackTable,
    wanted: NDArray[np.intp],
    sight: Sight,
    T_world_cam: Array,
    patch: tuple[int, int],
) -> tuple[NDArray[np.intp], NDArray[np.intp], AlignedPatches] | None:
    """Align some tracks with each keyframe that saw them, by patches of some side and stride.

    Returns:
        Rows of tracks ``(M,)``, one for each keyframe that shows it, that keyframe's row ``(M,)``, and where
        the patches are; None where no keyframe shows any well enough.
    """
    T_cam_world = invert_transform(T_world_cam)
    parts: list[tuple[NDArray[np.intp], Array, Templates]] = []
    for image, keyframe in views:
        rows, xy0 = _shared(tracks, wanted, keyframe)
        depth = _depths(mapped.world, keyframe, tracks.ids[rows], xy0)
        told = depth > 0.0
        rows, xy0, depth = rows[told], xy0[told], depth[told]
        warps, depth_now = affine_warps(mapped.camera, T_cam_world @ keyframe.T_world_cam, xy0, depth)
        alike = seen_alike(warps, depth_now)
        parts.append((rows[alike], warps[alike], Templates.cut(image.grey, xy0[alike], *patch)))
    if not any(len(part[0]) for part in parts):
        return None
    rows, warps = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    found = align_patches(Templates.join([part[2] for part in parts]), sight.grey, tracks.xy[rows], warps)
    return rows, np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts]), found


def _middle(places: Array) -> tuple[Array, Array]:
    """Median ``(N, 2)`` of places ``(K, N, 2)``, NaN for none, and their variance ``(N,)`` per coordinate.

    The variance is that of a normal distribution with their median absolute deviation, NaN where there are
    too few places.
    """
    middle = np.nanmedian(places, axis=0)
    deviation_px = MAD_TO_SIGMA * np.nanmedian(np.abs(places - middle), axis=0).mean(axis=1)
    enough = np.isfinite(places[..., 0]).sum(axis=0) >= _MIN_PLACES
    return middle, np.where(enough, deviation_px**2, np.nan)


def _shared(tracks: TrackTable, rows: NDArray[np.intp], keyframe: Keyframe) -> tuple[NDArray[np.intp], Array]:
    """Return those of some tracks that a keyframe saw too, and where."""
    mine, theirs = shared_rows(tracks.ids[rows], keyframe.ids)
    return rows[mine], keyframe.xy[theirs]


def _depths(world: WorldMap, keyframe: Keyframe, ids: NDArray[np.int64], xy: Array) -> Array:
    """Depth in a keyframe of each of its points ``(N,)``, in map units; 0 where nothing tells it.

    That of its landmark; of a point that has none yet, or one behind the camera, the median of the inverse
    depths of the landmarks next to it, which is near enough for a warp.
    """
    landmark = world.landmarks.rows(ids)
    depth = np.zeros(len(ids))
    known = landmark >= 0
    T_keyframe_world = invert_transform(keyframe.T_world_cam)
    depth[known] = depths_in(T_keyframe_world, world.landmarks.xyz[landmark[known]])
    known = depth > MIN_DEPTH_MAP
    depth[~known] = 0.0
    if known.sum() >= _MIN_LANDMARKS and not known.all():
        x, y = xy.astype(np.float32).T
        square = (x[~known, None] - x[known]) ** 2 + (y[~known, None] - y[known]) ** 2
        near = np.argpartition(square, _NEIGHBOURS - 1, axis=1)[:, :_NEIGHBOURS]
        depth[~known] = 1.0 / np.median(1.0 / depth[known][near], axis=1)
    return depth
