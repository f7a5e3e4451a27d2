"""Whether two images show the motion of the scene, or that of something large that moves through it.

A relative pose is that of most tracks, and a lorry beside the camera has more of them than the street it is
in: its paint has corners everywhere, a wall has few. The scene is therefore what takes up more of the image.
Where much of that does not follow the motion that was found, another is looked for among the tracks that
don't, and the two are compared by the area each explains.

While a camera has hardly moved, one motion may explain both, a person who walks and the room behind, each a
little badly. So a motion is looked for too that explains as much as it can as well as good images allow, and
is the scene's where it fits far better what it fits.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.server.geometry.epipolar import fundamental_matrix, sampson_px
from semcast.server.geometry.two_view import TwoViewResult, estimate_two_view, follows, search_closely
from semcast.server.geometry.weighting import ConfidenceMode, NoiseModel
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
#: Inlier threshold of the first search, in standard deviations of the noise,
_THRESHOLD_SIGMAS = 2.0
#: and its limits.
_THRESHOLD_RANGE_PX = (1.0, 3.0)
#: Inlier threshold of the close search: tracks of good images are known to a tenth of a pixel.
_CLOSE_PX = 0.2
#: Share of the area by which motions are compared that fit differently well: the scene has so much at least.
_LEAST_SHARE = 0.4
#: By this factor must the close one be nearer to it. The motion of a scene behind people was, by 0.2 to 0.5.
_CLOSER_RATIO = 0.6
#: So far off, in standard deviations, is that share of normal errors at most.
_SHARE_SIGMAS = 0.524
#: Less noise than this is not believed, however well tracks fit.
_LEAST_SIGMA_PX = 0.05
#: Share of all tracks that must follow a motion for the others to be of no scene.
_MOST = 0.5


@dataclass(frozen=True)
class SceneMotion:
    """The motion that explains the most of the image.

    Attributes:
        motion: The camera's.
        noise: Of the tracks, as those that follow it show: no more than was expected.
        alone: ``(N,)`` tracks of something that moves by itself: those that don't follow the motion, where
            they are so many that they are no chance. All False else.
        is_contested: The motion explains the most, but another almost as much.
    """

    motion: TwoViewResult
    noise: NoiseModel
    alone: Mask
    is_contested: bool

    @property
    def judged_by(self) -> Mask:
        """Tracks that tell whether the motion is one, ``(N,)``: all, unless most of them move by themselves.

        Those that follow it best do so where there is but noise, too.
        """
        return ~self.alone if self.alone.mean() > 1.0 - _MOST else np.ones(len(self.alone), bool)


def motion_of_scene(
    camera: Intrinsics,
    xy0: Array,
    xy1: Array,
    confidence: Array,
    noise: NoiseModel,
    *,
    mode: ConfidenceMode,
    seed: int,
) -> SceneMotion | None:
    """Compare the motion of most tracks with what else moves in the image; None where nothing tells one.

    Args:
        camera: Pinhole.
        xy0: ``(N, 2)`` pixels of the first image.
        xy1: ``(N, 2)`` pixels of the second one, matched row by row.
        confidence: ``(N,)`` of the matches.
        noise: Of the tracks, as it is expected.
        mode: Use of confidence.
        seed: Of the searches.
    """
    area = 1.0 / np.bincount(group := cells_of(xy1, camera.width))[group]
    area /= area.sum()
    found = _of_most(camera, xy0, xy1, confidence, _threshold_px(noise), mode, seed)
    if found is None:
        return None
    found = _closest(camera, found, xy0, xy1, area, seed)
    noise = _as_shown(camera, found, xy0, xy1, confidence, area, noise)
    threshold_px = _THRESHOLD_SIGMAS * noise.sigma0_px
    follow = follows(camera, found.T_cam1_cam0, xy0, xy1, threshold_px)
    share = float(area[follow].sum())
    first = SceneMotion(found, noise, np.zeros(len(xy0), bool), is_contested=False)
    rest = np.flatnonzero(~follow)
    if share >= _SURE_SHARE or len(rest) < _MIN_TRACKS:
        return first
    if follow.mean() >= _MOST:
        first = replace(first, alone=~follow)
    rival = _of_most(camera, xy0[rest], xy1[rest], confidence[rest], threshold_px, mode, seed)
    if rival is None:
        return first
    # What follows both motions, because it is far away or along the way, counts for both.
    follow = follows(camera, rival.T_cam1_cam0, xy0, xy1, threshold_px)
    rival_share = float(area[follow].sum())
    if rival_share > share:
        return SceneMotion(replace(rival, inliers=follow), noise, ~follow, is_contested=False)
    return replace(first, is_contested=rival_share > _RIVAL_RATIO * share)


def _threshold_px(noise: NoiseModel) -> float:
    return float(np.clip(_THRESHOLD_SIGMAS * noise.sigma0_px, *_THRESHOLD_RANGE_PX))


def _of_most(
    camera: Intrinsics,
    xy0: Array,
    xy1: Array,
    confidence: Array,
    threshold_px: float,
    mode: ConfidenceMode,
    seed: int,
) -> TwoViewResult | None:
    """The motion of most tracks."""
    return estimate_two_view(
        camera,
        xy0,
        xy1,
        confidence,
        mode=mode,
        threshold_px=threshold_px,
        seed=seed,
        min_iterations=ITERATIONS[0],
        max_iterations=ITERATIONS[1],
        choose_model=True,
    )


def _closest(
    camera: Intrinsics, found: TwoViewResult, xy0: Array, xy1: Array, area: Array, seed: int
) -> TwoViewResult:
    """A motion that fits a large part of the image far better than the one that was found; else that one."""
    close = search_closely(
        camera,
        xy0,
        xy1,
        threshold_px=_CLOSE_PX,
        seed=seed,
        min_iterations=ITERATIONS[0],
        max_iterations=ITERATIONS[1],
    )
    if close is None:
        return found
    off_px, off_close_px = (
        _off_by(np.abs(sampson_px(fundamental_matrix(camera, m.T_cam1_cam0), xy0, xy1)), area)
        for m in (found, close)
    )
    return close if off_close_px < _CLOSER_RATIO * off_px else found


def _as_shown(
    camera: Intrinsics,
    found: TwoViewResult,
    xy0: Array,
    xy1: Array,
    confidence: Array,
    area: Array,
    noise: NoiseModel,
) -> NoiseModel:
    """Noise of the tracks by how near those of the scene are to where a motion has them."""
    distance_px = np.abs(sampson_px(fundamental_matrix(camera, found.T_cam1_cam0), xy0, xy1))
    factor = _off_by(distance_px / noise.sigma_px(confidence), area) / _SHARE_SIGMAS
    sigma0_px = max(_LEAST_SIGMA_PX, factor * noise.sigma0_px)
    return replace(noise, sigma0_px=min(noise.sigma0_px, sigma0_px))


def _off_by(distance: Array, area: Array) -> float:
    """How far off that share of the area is at most which a scene has at least."""
    order = np.argsort(distance)
    row = int(np.searchsorted(np.cumsum(area[order]), _LEAST_SHARE))
    return float(distance[order[min(row, len(order) - 1)]])
