"""Tracks without a depth, as rays from the keyframe that saw them: they hold the camera's rotation.

While a camera turns, most of what it sees is new, and the few landmarks left lie on one side of the image,
where turning and moving look alike. The new tracks are many and everywhere. Nobody knows how far their points
are, but each lies on a ray (``ray_observations``), which near the keyframe is a short line in the image.
Something large that moves by itself has such tracks too, many, and for long: keyframes tell them by that no
point at rest explains where they were seen. Where keyframes have turned wrongly themselves, that is said of
the far view as well.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.geometry.epipolar import shape_of
from semcast.server.geometry.ray_observations import RayObservations
from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.refuted import on_something_large
from semcast.server.mapping.scene_depth import median_depth
from semcast.server.mapping.sight import Seen
from semcast.server.mapping.track_ids import rows_among
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: Keyframes whose tracks are looked at.
_NUM_KEYFRAMES = 12
#: A point lies at least this share of the usual depth in front of the cameras.
_MIN_DEPTH_SHARE = 0.05


def rays_of(
    camera: Intrinsics,
    world: WorldMap,
    noise: NoiseModel,
    seen: Seen,
    submap: int,
    *,
    with_refuted: bool = False,
) -> RayObservations | None:
    """Observations of tracks on rays from the newest keyframe that saw each.

    Args:
        camera: Pinhole.
        world: The map.
        noise: Gives each observation its sigma.
        seen: Tracks without a landmark.
        submap: Part of the map whose keyframes count.
        with_refuted: Take what that keyframe refuted too, where that is much.

    Returns:
        Those of the tracks that a keyframe saw, without those that it refuted unless they are asked for; None
        where there is none or no depth is known.
    """
    found, refuted = np.zeros(len(seen), bool), np.zeros(len(seen), bool)
    depth, parts = float("inf"), []
    views = _newest(world, submap)
    for position, keyframe in enumerate(views):
        row = rows_among(seen.ids, keyframe.ids)
        new = np.flatnonzero(~found & ~refuted & (row >= 0))
        # A few that are refuted have slipped. Many are something large, or the far view.
        if len(keyframe.refuted) and not (with_refuted and len(on_something_large(keyframe))):
            refuted[new] = np.isin(seen.ids[new], keyframe.refuted)
            new = new[~refuted[new]]
        if len(new) == 0:
            continue
        own = _first_known_depth(world, views[position:])
        depth = own if np.isfinite(own) else depth
        if not np.isfinite(depth):
            break
        parts.append(_Part(keyframe, row[new], new, depth))
        found[new] = True
        if (found | refuted).all():
            break
    return _on_rays(parts, camera, noise, seen) if parts else None


@dataclass(frozen=True)
class _Part:
    """Tracks that a keyframe saw as the newest one.

    Attributes:
        keyframe: It.
        row: ``(N,)`` rows of the tracks in it.
        row_now: ``(N,)`` and in what is seen now.
        depth: The usual one of its scene.
    """

    keyframe: Keyframe
    row: NDArray[np.intp]
    row_now: NDArray[np.intp]
    depth: float


def _on_rays(parts: Sequence[_Part], camera: Intrinsics, noise: NoiseModel, seen: Seen) -> RayObservations:
    """Put what is seen on the rays of its keyframes: computed for all at once, as each frame needs it."""
    counts = [len(part.row) for part in parts]
    now = seen[np.concatenate([part.row_now for part in parts])]
    then = np.concatenate([part.keyframe.confidence[part.row] for part in parts])
    edge_then = np.concatenate([part.keyframe.edge[part.row] for part in parts])
    rays = [p.keyframe.T_world_cam[:3, :3] @ camera.unproject(p.keyframe.xy[p.row]).T for p in parts]
    sigma_px, sigma_then_px = noise.sigma_px(now.confidence), noise.sigma_px(then)
    shape, shape_then = shape_of(now.edge), shape_of(edge_then)
    covariance = sigma_px[:, None, None] ** 2 * shape + sigma_then_px[:, None, None] ** 2 * shape_then
    gate_px, gate_then_px = noise.threshold_px(now.confidence), noise.threshold_px(then)
    return RayObservations(
        origin=np.repeat([part.keyframe.T_world_cam[:3, 3] for part in parts], counts, axis=0).T.copy(),
        direction=np.concatenate(rays, axis=1),
        min_depth=np.repeat([_MIN_DEPTH_SHARE * part.depth for part in parts], counts),
        observed=(now.xy - (camera.cx, camera.cy)).T.copy(),
        covariance=np.stack([covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]]),
        gate=np.minimum(gate_px / sigma_px, gate_then_px / sigma_then_px),
    )


def much_is_refuted(world: WorldMap, submap: int) -> bool:
    """Tell whether ``with_refuted`` can change what ``rays_of`` returns."""
    return any(len(on_something_large(keyframe)) for keyframe in _newest(world, submap))


def _newest(world: WorldMap, submap: int) -> list[Keyframe]:
    """Keyframes whose tracks become rays, newest first; the map may have a thousand."""
    mine = (k for k in reversed(world.keyframes) if k.submap == submap and len(k.ids))
    return list(islice(mine, _NUM_KEYFRAMES))


def _first_known_depth(world: WorldMap, views: list[Keyframe]) -> float:
    """Median depth of the landmarks of the first view that has some; infinite where none has."""
    return next((d for d in (median_depth(world, k) for k in views) if np.isfinite(d)), float("inf"))
