"""The start of a map: two views with parallax, the frames between them, and an adjustment of all.

Standing still and turning on the spot give no depth; the start then waits. Frames that came before are kept,
so that they get their poses as soon as there is a map.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform
from semcast.server.geometry.epipolar import (
    fit_rotation,
    fundamental_matrix,
    rotation_residual_px,
    sampson_px,
    turn_in_doubt_deg,
)
from semcast.server.geometry.two_view_candidates import MIN_MATCHES
from semcast.server.geometry.weighting import MAD_TO_SIGMA, ConfidenceMode, NoiseModel, fuse_confidence
from semcast.server.mapping.ambiguity import Structure, decide
from semcast.server.mapping.hypotheses import hypothesis_of, poses_in, problem_of
from semcast.server.mapping.kept_frames import Observed
from semcast.server.mapping.scene_motion import SceneMotion, motion_of_scene
from semcast.server.mapping.start_alignment import aligned_views
from semcast.server.mapping.start_attempts import Patience, Undecided
from semcast.server.mapping.start_geometry import MIN_POINTS, Start, StartGeometry
from semcast.server.mapping.track_ids import shared_rows

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

_NONE: Ids = np.zeros(0, np.int64)
#: Frames kept for poses in retrospect.
MAX_HISTORY = 300
#: Of them, those whose images are kept too: 10 MB of 640x480.
_MAX_IMAGES = 32
#: Views of a start: two of a scene with little perspective can't tell it from its mirror image in depth.
_MIN_VIEWS = 3
#: Attempts in which tracks did not last for that many views, after which two have to do.
_MAX_TOO_SHORT = 2
#: Attempts in which another motion explained almost as much of the image, after which that does not hinder.
_MAX_CONTESTED = 12
#: Structures that go on to the next attempt, at most.
_MAX_HYPOTHESES = 3
#: Those that are more doubtful than the best one by this do not go on.
_HOPELESS = 1.0
#: Points from which a start is made, as long as few frames wait for it; after that ``MIN_POINTS`` do.
_PLENTY_OF_POINTS = 60
#: Frames that have waited by then.
_PATIENCE_FRAMES = 12
#: Share of the reference's tracks that must still be there; else the reference moves on.
_MIN_SHARED = 0.12
#: Share of the tracks two views share that must agree with a relative pose.
_LEAST_AGREEING = 0.5
#: Median way of the tracks, as share of the image width, below which no start is tried.
_MIN_FLOW_SHARE = 0.012
#: Newer frames that are tried where an attempt found no way of the camera: as many,
_MAX_OTHERS = 8
#: and turning must leave more of the tracks since one of them by this factor: medians of few tracks vary.
_MORE_RELIEF = 1.2
#: Median angle between the rays of the two views.
_MIN_MEDIAN_PARALLAX_DEG = 0.7
#: How many times the standard deviation of the turn between them that angle must be, with matches that err by
#: a pixel. It has been four times and more, over poor links too; at the edges of views that a turn led apart,
#: where a flat scene's other structure was taken for the true one, it was 1.0 to 1.2 times.
_MIN_PARALLAX_DOUBTS = 2.0
#: Median way that turning leaves of the tracks, in standard deviations of their distance to epipolar lines.
#: Where the camera only turned and tracks err alike in all directions, that is 1.7, and was up to 3.3 after a
#: search for lines along which they err; at starts it has been 5.4 and more, over poor links too.
_MIN_RELIEF_SIGMAS = 4.0


@dataclass(frozen=True)
class _Pair:
    """Tracks that two frames share.

    Attributes:
        ids: ``(N,)`` tracks.
        xy0: ``(N, 2)`` in the first frame.
        xy1: ``(N, 2)`` in the second.
        confidence: ``(N,)`` of both ends.
        left_out: ``(L,)`` suspects that both saw too.
    """

    ids: Ids
    xy0: Array
    xy1: Array
    confidence: Array
    left_out: Ids

    @property
    def flow_px(self) -> float:
        """Median way of the tracks; there must be one."""
        return float(np.median(np.linalg.norm(self.xy1 - self.xy0, axis=1)))


def _pair(first: Observed, second: Observed, suspect: Ids) -> _Pair:
    """Match two frames by the ids of their tracks."""
    row0, row1 = shared_rows(first.ids, second.ids)
    ids = first.ids[row0]
    doubtful = np.isin(ids, suspect)
    left_out, ids, row0, row1 = ids[doubtful], ids[~doubtful], row0[~doubtful], row1[~doubtful]
    confidence = fuse_confidence(first.confidence[row0], second.confidence[row1])
    return _Pair(ids, first.xy[row0], second.xy[row1], confidence, left_out)


class Initialiser:
    """Collects frames until some of them start a map.

    Args:
        camera: Pinhole.
        mode: Use of confidence.
        min_parallax_deg: From which a point is triangulated.
        seed: Of the searches.
    """

    def __init__(self, camera: Intrinsics, mode: ConfidenceMode, min_parallax_deg: float, seed: int) -> None:
        self._camera = camera
        self._mode: ConfidenceMode = mode
        self._geometry = StartGeometry(camera, min_parallax_deg, seed)
        self._seed = seed
        self.clear()

    def clear(self) -> None:
        """Forget all frames."""
        self.history: list[Observed] = []
        self._reference = 0
        self._is_tried = self._found_no_way = False
        self._agreeing = 1.0
        self._too_short = Patience(_MAX_TOO_SHORT)
        self._contested = Patience(_MAX_CONTESTED)
        self._undecided = Undecided()

    @property
    def ids(self) -> Ids:
        """Ids of all tracks that are remembered, ascending."""
        remembered = [*(o.ids for o in self.history), *(h.ids for h in self._undecided.hypotheses)]
        return np.unique(np.concatenate([np.zeros(0, np.int64), *remembered]))

    def renew(self, before: Ids, after: Ids) -> None:
        """Give all tracks that are remembered the ids ``after`` instead of ``before``, both ascending."""
        self.history = [replace(o, ids=after[np.searchsorted(before, o.ids)]) for o in self.history]
        going_on = self._undecided.hypotheses
        self._undecided.hypotheses = [replace(h, ids=after[np.searchsorted(before, h.ids)]) for h in going_on]

    def leave_out(self, ids: Ids) -> None:
        """Forget tracks that turned out to be of no scene, in the frames that saw them too."""
        if self.history and np.isin(self.history[-1].ids, ids).any():
            self.history = [o.without(ids) for o in self.history]
            # What they took part in says nothing any more.
            self._undecided.hypotheses = []
            self._undecided.forget_evidence()

    def add(
        self, observed: Observed, noise: NoiseModel, suspect: Ids = _NONE, *, waits: bool = False
    ) -> Start | None:
        """Take a frame and try to start a map with it.

        Args:
            observed: Its tracks.
            noise: Of the observations.
            suspect: Tracks that stand in the image and may be of no scene. No start rests on them: it would
                take what moves with the camera for what is far away, and the camera for not turning.
            waits: Keep the frame, but do not start from it: much of its image is missing, or the camera
                stands.

        Returns:
            The start, or None for now. On success ``history`` still holds the frames to be posed.
        """
        if len(observed.ids) < MIN_MATCHES:
            return None
        self._remember(observed, suspect)
        if waits or self._reference == len(self.history) - 1:
            return None
        pair = _pair(self.history[self._reference], observed, suspect)
        if not self._has_moved(pair):
            return None
        if len(pair.left_out) and not self._is_tried:
            pair = self._from_nearest(pair, suspect)
        relief_px = self._relief_px(pair.xy0, pair.xy1)
        if self._found_no_way:
            pair, relief_px = self._from_most_relief(pair, relief_px, suspect)
        self._is_tried = True
        evidence_px = np.array([pair.flow_px, relief_px])
        if not self._undecided.wants(evidence_px):
            return None
        # Two views in succession: the search that would tell whether they are good is what waiting saves.
        if self._reference + 1 == len(self.history) - 1 and self._too_short.puts_off():
            return None
        return self._attempt(pair, evidence_px, noise)

    def _attempt(self, pair: _Pair, evidence_px: Array, noise: NoiseModel) -> Start | None:
        """Try to start a map from the newest frame and the reference, and from those between.

        Args:
            pair: Tracks of the two.
            evidence_px: By what the attempt goes, see ``Undecided.wants``.
            noise: Of the observations.
        """
        scene = motion_of_scene(
            self._camera, pair.xy0, pair.xy1, pair.confidence, noise, mode=self._mode, seed=self._seed
        )
        agreeing = 0.0 if scene is None else float(scene.motion.inliers.mean())
        self._agreeing = max(_LEAST_AGREEING, agreeing)
        self._found_no_way = scene is None or not self._is_good(scene) or not self._has_gone(pair, scene)
        if scene is None or self._found_no_way:
            return None
        if scene.is_contested and self._contested.puts_off():
            return None
        history = [o.without(pair.left_out) for o in self.history]
        span = [o.without(pair.ids[scene.alone]) for o in history[self._reference :]]
        start = self._build(span, scene, pair.ids[scene.motion.inliers], noise)
        if start is None:
            self._undecided.note_evidence(evidence_px)
        else:
            self.history = history
        return start

    def _remember(self, observed: Observed, suspect: Ids) -> None:
        """Add a frame to those kept, and look whether the reference may stay."""
        self.history.append(observed)
        if len(self.history) > MAX_HISTORY:
            self.history.pop(0)
            self._reference = max(0, self._reference - 1)
        self._move_reference(suspect)
        self._forget_images()

    def _has_moved(self, pair: _Pair) -> bool:
        """Whether enough tracks have moved by enough for a start to be tried."""
        return len(pair.ids) >= self._min_points() and pair.flow_px >= _MIN_FLOW_SHARE * self._camera.width

    def _from_nearest(self, pair: _Pair, suspect: Ids) -> _Pair:
        """Let the reference be the newest frame that the scene has moved enough since.

        As long as a bonnet was taken for a part of it, the scene seemed to rest, however far it went. Few
        tracks last for such a way, and of those that do many slid along an outline.

        Args:
            pair: Of the reference as it was, which is kept if no newer frame will do.
            suspect: Tracks that may be of no scene.
        """
        for k in range(len(self.history) - 2, self._reference, -1):
            nearer = _pair(self.history[k], self.history[-1], suspect)
            if self._has_moved(nearer):
                self._reference = k
                return nearer
        return pair

    def _from_most_relief(self, pair: _Pair, relief_px: float, suspect: Ids) -> tuple[_Pair, float]:
        """Let the reference be a newer frame if turning leaves clearly more of the tracks since that one.

        Of a camera that turns to and fro, the oldest frame that shares enough tracks with the newest shares a
        strip at the edge, across which going looks like turning, and tracks that have drifted for long.

        Args:
            pair: Of the reference as it was, which is kept if no newer frame is better.
            relief_px: What turning leaves of its tracks, see ``_relief_px``.
            suspect: Tracks that may be of no scene.

        Returns:
            The pair of the reference, and what turning leaves of that.
        """
        least_px = _MORE_RELIEF * relief_px
        others = np.linspace(self._reference, len(self.history) - 1, _MAX_OTHERS + 2, dtype=int)[1:-1]
        for k in np.unique(others[others > self._reference]).tolist():
            other = _pair(self.history[k], self.history[-1], suspect)
            if self._has_moved(other) and (left_px := self._relief_px(other.xy0, other.xy1)) > least_px:
                pair, relief_px, least_px = other, left_px, left_px
                self._reference = k
                self._undecided.forget_evidence()
        return pair, relief_px

    def _relief_px(self, xy0: Array, xy1: Array) -> float:
        """Median way of tracks that turning alone does not explain: a hand turns more than it goes."""
        R_cam1_cam0 = fit_rotation(self._camera, xy0, xy1, iterations=1)
        return float(np.median(rotation_residual_px(self._camera, R_cam1_cam0, xy0, xy1)))

    def _min_points(self) -> int:
        """A start from a few points of a damaged image costs the whole map; waiting costs a few frames."""
        return MIN_POINTS if len(self.history) >= _PATIENCE_FRAMES else _PLENTY_OF_POINTS

    def _is_good(self, scene: SceneMotion) -> bool:
        """Whether a map could begin with a motion: of half of the tracks, but for what moves by itself."""
        found = scene.motion
        enough = max(self._min_points(), _LEAST_AGREEING * int(scene.judged_by.sum()))
        return (
            int(found.inliers.sum()) >= enough
            and not found.is_rotation
            and found.parallax_deg > _MIN_MEDIAN_PARALLAX_DEG
        )

    def _has_gone(self, pair: _Pair, scene: SceneMotion) -> bool:
        """Whether it takes a translation of the camera to explain two views, and not a turn and errors."""
        found, tracks = scene.motion, scene.judged_by
        xy0, xy1 = pair.xy0[tracks], pair.xy1[tracks]
        F = fundamental_matrix(self._camera, found.T_cam1_cam0)
        sigma_px = MAD_TO_SIGMA * float(np.median(np.abs(sampson_px(F, xy0, xy1))))
        if self._relief_px(xy0, xy1) < _MIN_RELIEF_SIGMAS * sigma_px:
            return False
        xy0, xy1 = pair.xy0[found.inliers], pair.xy1[found.inliers]
        doubt_deg = turn_in_doubt_deg(self._camera, found.T_cam1_cam0, xy0, xy1)
        return found.parallax_deg > _MIN_PARALLAX_DOUBTS * doubt_deg

    def _move_reference(self, suspect: Ids) -> None:
        """Let the reference be the oldest frame that still shares enough tracks with the newest.

        Enough are so many that those of them that agree, by their share in the last search, make a start.
        With fewer the reference would stay for as long as the last few tracks last, and no start come of it.
        Tracks that stand in the image last longest of all, and don't count: no start rests on them.
        """
        newest = self.history[-1].without(suspect)
        while self._reference < len(self.history) - 1:
            reference = self.history[self._reference].without(suspect)
            shared = int(np.isin(reference.ids, newest.ids, assume_unique=True).sum())
            if shared >= max(MIN_POINTS / self._agreeing, _MIN_SHARED * len(reference.ids)):
                return
            self._reference += 1
            self._is_tried = False
            # Its tracks begin anew. Attempts are counted on: a fast camera would never use them up.
            self._undecided.forget_evidence()

    def _forget_images(self) -> None:
        """Keep the images of a few frames among those that may become keyframes of the start."""
        span = range(self._reference, len(self.history))
        with_image = [k for k in span if self.history[k].grey is not None]
        gone = [*range(self._reference), *(with_image[1:-1:2] if len(with_image) > _MAX_IMAGES else [])]
        for k in gone:
            if self.history[k].grey is not None:
                self.history[k] = replace(self.history[k], grey=None)

    def _build(
        self, span: list[Observed], scene: SceneMotion, ids: Ids, expected: NoiseModel
    ) -> Start | None:
        """Place the frames between two views, decide what they show, and triangulate from all.

        Args:
            span: Frames from the first of the two views to the second.
            scene: Their relative pose.
            ids: Tracks that agree with it.
            expected: Noise of observations, as it was before this scene was seen.
        """
        T_world_cam = self._geometry.poses_between(span, scene, ids)
        if T_world_cam is None or (len(T_world_cam) < _MIN_VIEWS and self._too_short.puts_off()):
            return None
        poses = np.stack([T_world_cam[k] for k in sorted(T_world_cam)])
        views = aligned_views(self._camera, [span[k] for k in sorted(T_world_cam)], poses)
        structure = self._decide(views, poses, scene.noise)
        if structure is None:
            return None
        T_cam_world = invert_transform(structure.T_world_cam) @ structure.T_world_cam[0]
        # Where nothing moves by itself, points may err as they are expected to: the more the better.
        return self._geometry.start_of(views, T_cam_world, scene.noise if scene.alone.any() else expected)

    def _decide(self, views: list[Observed], T_world_cam: Array, noise: NoiseModel) -> Structure | None:
        """Adjust the start and the structures it may be mistaken for; None while several fit."""
        problem = problem_of(views, T_world_cam, self._camera, noise)
        if problem is None:
            return None
        carried = []
        for hypothesis in self._undecided.hypotheses:
            T = poses_in(hypothesis, views, self._camera, noise, self._seed)
            again = None if T is None else problem_of(views, T, self._camera, noise)
            if again is not None:
                carried.append((again, hypothesis.doubt))
        structure, structures = decide(problem, carried, at_last=self._undecided.is_overdue)
        if structure is None:
            going_on = [
                hypothesis_of(s, views, self._camera, noise)
                for s in structures[:_MAX_HYPOTHESES]
                if s.ok and s.doubt < structures[0].doubt + _HOPELESS
            ]
            self._undecided.note_attempt(going_on)
        return structure
