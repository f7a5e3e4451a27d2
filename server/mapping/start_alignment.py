"""Takes the drift out of the tracks a map is to begin with: every view is aligned with all the others.

A start is decided by a fraction of a pixel, and following points from image to image has moved them by more
where images are noisy. The turns between the views are known well before anything else is, and points are
far against how little the camera has moved: images are warped by the turns alone.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.geometry.grey import Grey
from semcast.server.geometry.patch_alignment import ANCHOR_PATCH_PX, Templates, align_patches, seen_alike
from semcast.server.geometry.projection import MIN_DEPTH_MAP
from semcast.server.mapping.kept_frames import Observed
from semcast.server.mapping.track_ids import shared_rows

Array = NDArray[np.float64]


def aligned_views(camera: Intrinsics, views: Sequence[Observed], T_world_cam: Array) -> list[Observed]:
    """Return the views with each point in the median of where the others, and its track, have it.

    Args:
        camera: Pinhole.
        views: With their images; those without stay as they are, and tell nothing of the others.
        T_world_cam: ``(V, 4, 4)`` poses, of which the turns are used.
    """
    return [_aligned(camera, views, T_world_cam, index) for index in range(len(views))]


def _aligned(camera: Intrinsics, views: Sequence[Observed], T_world_cam: Array, index: int) -> Observed:
    view = views[index]
    if view.grey is None:
        return view
    places = np.full((len(views), len(view.ids), 2), np.nan)
    places[index] = view.xy
    for other, seen in enumerate(views):
        mine, theirs = shared_rows(view.ids, seen.ids)
        if other == index or seen.grey is None or len(mine) == 0:
            continue
        R = T_world_cam[index, :3, :3].T @ T_world_cam[other, :3, :3]
        turned, turned_xy, alike = _turned(camera, seen.grey, seen.xy[theirs], R)
        templates = Templates.cut(turned, turned_xy, ANCHOR_PATCH_PX)
        no_warps = np.tile(np.eye(2), (len(mine), 1, 1))
        found = align_patches(templates, view.grey, view.xy[mine], no_warps)
        fits = found.fits(view.xy[mine]) & alike
        places[other, mine[fits]] = found.xy[fits]
    return replace(view, xy=np.nanmedian(places, axis=0))


def _turned(camera: Intrinsics, image: Grey, xy: Array, R: Array) -> tuple[Grey, Array, NDArray[np.bool_]]:
    """An image as a camera turned by ``R`` would have taken it, and points of it.

    The whole image is turned, not each patch by its derivative there: what a patch is off by to second order
    has the same direction all over an image, and looks like parallax.

    Returns:
        The image, ``(N, 2)`` the points in it, and whether they are in front of that camera and seen at about
        their size.
    """
    homography = camera.K @ R @ np.linalg.inv(camera.K)
    rays = camera.unproject(xy) @ R.T
    # Of a homography with determinant one, the area changes with the third power of this.
    side = np.maximum(rays[:, 2, None, None], MIN_DEPTH_MAP) ** -1.5
    alike = seen_alike(side * np.eye(2), rays[:, 2])
    turned = cv2.warpPerspective(image, homography, image.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    in_front = np.where(alike[:, None], rays, [0.0, 0.0, 1.0])
    return turned.astype(np.uint8), camera.project(in_front), alike
