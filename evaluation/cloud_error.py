"""How near a dense cloud is to the surfaces of a drawn scene, and how much of what was seen it covers.

Accuracy and completeness as reconstructions are compared by (Knapitsch et al., Tanks and Temples, 2017), both
in shares of the distance from the camera: a drone's cloud can't be as exact as that of a table.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypedDict

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import transform_points
from semcast.evaluation.scenes.surfaces import Surface

Array = NDArray[np.float64]
Points = NDArray[np.floating]

#: What is seen counts as covered if a point is within this share of its distance.
COVERED = 0.02
#: Points of a keyframe that are measured at most, and pixels each way between those that have to be covered.
_MAX_MEASURED = 4000
_APART_PX = 8
#: An exact tree of FLANN, and as many leaves as it takes.
_EXACT_TREE, _ALL_LEAVES = {"algorithm": 4, "leaf_max_size": 10}, {"checks": -1}


@dataclass(frozen=True)
class TrueView:
    """What a keyframe saw of a drawn scene.

    Attributes:
        T_world_cam: ``(4, 4)`` where it was, metres.
        camera: Of ``depth``.
        depth: ``(H, W)`` camera z in metres, infinite where there is nothing.
        surfaces: What there was to see.
    """

    T_world_cam: Array
    camera: Intrinsics
    depth: NDArray[np.float32]
    surfaces: Sequence[Surface]


class CloudError(TypedDict):
    """Figures of one or more clouds; None of what there is nothing of.

    Attributes:
        points: Mean number of points of a cloud.
        accuracy_median: Median distance of points from a surface, in shares of that from the camera.
        accuracy_p90: The 90th percentile of the same.
        completeness: Share of what keyframes saw that has a point within ``COVERED`` of its distance.
    """

    points: float
    accuracy_median: float | None
    accuracy_p90: float | None
    completeness: float | None


def cloud_error(clouds: Iterable[Mapping[int, Points]], true: Mapping[int, TrueView]) -> CloudError:
    """Measure clouds, each keyframe's points from where the keyframe was in truth.

    Args:
        clouds: Each as keyframe id to ``(N, 3)`` points in its camera frame, metres.
        true: Of every keyframe, also those that add no points.
    """
    sizes, distances, covered = [], [np.zeros(0)], [np.zeros(0, bool)]
    seen, reach = _seen(true)
    for cloud in clouds:
        placed = [np.zeros((0, 3))]
        for k, points in cloud.items():
            placed.append(transform_points(true[k].T_world_cam, points.astype(np.float64)))
            some = slice(None, None, 1 + len(points) // _MAX_MEASURED)
            distances.append(distance_from(true[k].surfaces, placed[-1][some]) / points[some, 2])
        xyz = np.concatenate(placed)
        sizes.append(len(xyz))
        covered.append(_distance_between(seen, xyz) < COVERED * reach)
    every = np.concatenate(distances)
    median, p90 = np.percentile(every, [50, 90]).tolist() if len(every) else (None, None)
    return CloudError(
        points=float(np.mean(sizes)),
        accuracy_median=median,
        accuracy_p90=p90,
        completeness=float(np.concatenate(covered).mean()) if len(reach) else None,
    )


def distance_from(surfaces: Sequence[Surface], xyz: Array) -> Array:
    """Return how far points ``(N, 3)`` are from the nearest rectangle, ``(N,)`` metres."""
    nearest = np.full(len(xyz), np.inf)
    for surface in surfaces:
        off = xyz - surface.corner_m
        for edge in (surface.edge_u_m, surface.edge_v_m):
            off = off - np.clip(off @ edge / (edge @ edge), 0.0, 1.0)[:, None] * edge
        np.minimum(nearest, np.linalg.norm(off, axis=1), out=nearest)
    return nearest


def _seen(true: Mapping[int, TrueView]) -> tuple[Array, Array]:
    """Return places ``(N, 3)`` that keyframes saw, on a grid of their pixels, and how far along the view."""
    places, reach = [np.zeros((0, 3))], [np.zeros(0)]
    for view in true.values():
        depth = view.depth[_APART_PX // 2 :: _APART_PX, _APART_PX // 2 :: _APART_PX].astype(np.float64)
        rows, columns = np.nonzero(np.isfinite(depth))
        z = depth[rows, columns]
        pixels = np.column_stack([columns, rows]) * _APART_PX + _APART_PX // 2
        places.append(transform_points(view.T_world_cam, z[:, None] * view.camera.unproject(pixels)))
        reach.append(z)
    return np.concatenate(places), np.concatenate(reach)


def _distance_between(places: Array, xyz: Array) -> Array:
    """Return how far each place ``(N, 3)`` is from the nearest ``(M, 3)``; infinite without any."""
    if not len(xyz) or not len(places):
        return np.full(len(places), np.inf)
    tree = cv2.flann_Index(xyz.astype(np.float32), _EXACT_TREE)  # type: ignore[attr-defined]
    _, squared = tree.knnSearch(places.astype(np.float32), 1, params=_ALL_LEAVES)
    return np.sqrt(np.asarray(squared[:, 0], np.float64))
