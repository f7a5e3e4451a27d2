"""Whether two images show the motion of the scene, or that of something large that moves through it.

A relative pose is that of most tracks, and a lorry beside the camera has more of them than the street it is
in: its paint has corners everywhere, a wall has few. The scene is therefore what takes up more of the image.
Where much of that does not follow the motion that was found, another is looked for among the tracks that
don't, and the two are compared by the area each explains.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.geometry.two_view import TwoViewResult, estimate_two_view, follows
from semcast.server.geometry.weighting import ConfidenceMode
from semcast.server.mapping.standing import cells_of

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: What explains this share of the area is the scene. At rest it has been 0.87 and more, over poor links too;
#: something that moves by itself has left it 0.81 and less.
_SURE_SHARE = 0.85
#: Another motion that explains this share of the area that the first one does is no chance find.
#: At rest, what tracks that slipped agree on has reached 0.65.
_RIVAL_RATIO = 0.5
#: Tracks that another motion is looked for in.
_MIN_TRACKS = 12
#: Draws of the searches for a motion a map is to begin with, at least and at most.
ITERATIONS = (130, 1300)


@dataclass(frozen=True)
class SceneMotion:
    """The motion that explains the most of the image.

    Attributes:
        motion: The camera's.
        alone: ``(N,)`` tracks of something that moves by itself: those that don't follow a motion that was
            found beside the first one. All False where the first one is the scene's.
        is_contested: The first motion explains the most, but another almost as much.
    """

    motion: TwoViewResult
    alone: Mask
    is_contested: bool


def motion_of_scene(
    camera: Intrinsics,
    found: TwoViewResult,
    xy0: Array,
    xy1: Array,
    confidence: Array,
    *,
    mode: ConfidenceMode,
    threshold_px: float,
    seed: int,
) -> SceneMotion:
    """Compare the motion of most tracks with what else moves in the image.

    Args:
        camera: Pinhole.
        found: The motion of most tracks.
        xy0: ``(N, 2)`` pixels of the first image.
        xy1: ``(N, 2)`` pixels of the second one, matched row by row.
        confidence: ``(N,)`` of the matches.
        mode: Use of it.
        threshold_px: Inlier threshold ``found`` was searched with.
        seed: Of the search.
    """
    area = 1.0 / np.bincount(group := cells_of(xy1, camera.width))[group]
    area /= area.sum()
    follow = follows(camera, found.T_cam1_cam0, xy0, xy1, threshold_px)
    share = float(area[follow].sum())
    first = SceneMotion(found, np.zeros(len(xy0), bool), is_contested=False)
    rest = np.flatnonzero(~follow)
    if share >= _SURE_SHARE or len(rest) < _MIN_TRACKS:
        return first
    rival = estimate_two_view(
        camera,
        xy0[rest],
        xy1[rest],
        confidence[rest],
        mode=mode,
        threshold_px=threshold_px,
        seed=seed,
        min_iterations=ITERATIONS[0],
        max_iterations=ITERATIONS[1],
        choose_model=True,
    )
    if rival is None:
        return first
    # What follows both motions, because it is far away or along the way, counts for both.
    follow = follows(camera, rival.T_cam1_cam0, xy0, xy1, threshold_px)
    rival_share = float(area[follow].sum())
    if rival_share > share:
        return SceneMotion(replace(rival, inliers=follow), ~follow, is_contested=False)
    return replace(first, is_contested=rival_share > _RIVAL_RATIO * share)
