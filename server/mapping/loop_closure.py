"""Closing a loop: the camera is where it has been before, but the map says it is elsewhere.

Where it is off by little, landmarks of long ago are still found one by one (``revisit``), and say where the
camera is. Where it is off by more, the place is recognised by descriptors, among old keyframes that drift
leaves in question, and has to be recognised twice. Both say how the newest part of the map has to move, in
scale too; that is shared out along the way. Only then are the landmarks used anew: placed by the newest
part as it was, they would hide the difference.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import invert_transform, rotation_angle_deg
from semcast.server.geometry.pnp import reprojection_residual, search_pose
from semcast.server.geometry.weighting import GATE_SIGMAS, NoiseModel
from semcast.server.mapping.pose_graph import PoseConstraint, SolvedGraph, solve_graph
from semcast.server.mapping.relocalisation import MAX_CONSIDERED, Place, Relocaliser, submap_similarity
from semcast.server.mapping.revisit import Revisit, off_lines_px, old_sigma_px, tells_depth
from semcast.server.mapping.scene_depth import median_depth
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.steps import steps_of, usable_depth
from semcast.server.mapping.world_map import Keyframe, WorldMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: The newest keyframes, which are never a loop. It is also how many keyframes pass without a look after one
#: was closed, or nothing had drifted.
_NUM_RECENT = 20
#: Keyframes from one look to the next.
_LOOK_INTERVAL = 4
#: Drift at most, as a share of the distance travelled since.
_MAX_DRIFT = 0.1
#: How near to the old keyframe the camera must have come back, as a share of that distance.
_MAX_APART = 0.3
#: Keyframes after which a place recognised once no longer counts, nor a loop that was refused.
_MAX_PENDING = 10
#: Two recognitions of a place agree up to this distance, in median depths,
_SAME_DEPTHS = 0.1
#: this angle,
_SAME_DEG = 2.0
#: and this factor between their scales.
_SAME_SCALE = 1.15
#: Landmarks found one by one that prove a place.
_MIN_FOUND = 20
#: The same as a share of those found.
_MIN_FOUND_SHARE = 0.6
#: Standard deviations of a recognised place: rotation in radians, translation in median depths, and logarithm
#: of the scale. Landmarks of there are to be found in the newest image where the graph puts the camera.
_PLACE_SIGMA = (0.001, 0.004, 0.01)
#: The same of places that were recognised before: the way in between has been adjusted since.
_FORMER_SIGMA = (0.004, 0.02, 0.03)
#: Half the squared error in standard deviations that a loop may leave: seven errors of five deviations. What
#: takes more is no drift but a wrong place: landmarks of poor depth may be agreed with from 30 degrees off.
_MAX_COST = 0.5 * 7 * 5.0**2


@dataclass(frozen=True)
class Loop:
    """The newest part of the map, seen from an old one.

    Attributes:
        keyframe_id: The newest keyframe.
        place: Where a frame soon after it is in the old part.
        scale: Units of the old part in one of the newest.
        T_old_new: ``(4, 4)``, brings points ``scale * x`` of the newest part to their places in the old.
    """

    keyframe_id: int
    place: Place
    scale: float
    T_old_new: Array

    def moved(self, T_world_cam: Array) -> Array:
        """Return the pose a camera of the newest part has in the old one."""
        T = T_world_cam.copy()
        T[:3, 3] *= self.scale
        return np.asarray(self.T_old_new @ T)

    def agrees(self, other: "Loop", view: "LoopView", depth: float) -> bool:
        """Whether another recognition says the same of where a view is and how large its unit is."""
        scale = self.scale / other.scale
        T = invert_transform(self.moved(view.T_world_cam)) @ other.place.T_world_cam
        return bool(
            np.linalg.norm(T[:3, 3]) < _SAME_DEPTHS * depth
            and rotation_angle_deg(T[:3, :3]) < _SAME_DEG
            and max(scale, 1.0 / scale) < _SAME_SCALE
        )


@dataclass(frozen=True)
class LoopView:
    """A posed frame.

    Attributes:
        sight: Its image.
        T_world_cam: ``(4, 4)``.
        ids: ``(N,)`` tracks in sight.
        xy: ``(N, 2)`` where they are.
    """

    sight: Sight
    T_world_cam: Array
    ids: Ids
    xy: Array


class LoopFinder:
    """Recognises old places of a submap at its keyframes.

    Args:
        camera: Pinhole.
        relocaliser: Recognises.
        seed: Of the pose search.
    """

    def __init__(self, camera: Intrinsics, relocaliser: Relocaliser, seed: int) -> None:
        self._camera = camera
        self._seed = seed
        self._relocaliser = relocaliser
        self._pending: Loop | None = None
        self._since_pending = self._since_look = 0
        self._settled = self._refused = 0
        self._tied_id = -1  # keyframe since which nothing has drifted, while that is settled

    @property
    def is_in_doubt(self) -> bool:
        """Whether where the camera is contradicts a place: one recognised once, or that of a refused loop."""
        return self._pending is not None or self._refused > 0

    def look(
        self, view: LoopView, world: WorldMap, noise: NoiseModel, submap: int, found: Revisit | None
    ) -> Loop | None:
        """Look for a loop.

        Args:
            view: A frame that becomes a keyframe.
            world: The map.
            noise: Of observations.
            submap: The current one.
            found: Landmarks of long ago that it sees, where they were found one by one.

        Returns:
            The loop, once it is sure.
        """
        self._since_look += 1
        self._since_pending += 1
        self._settled -= 1
        self._refused -= 1
        if self._since_pending > _MAX_PENDING:
            self._pending = None
        if self._refused > _MAX_PENDING - _LOOK_INTERVAL:  # so soon it would be the same again
            return None
        if (
            found is not None
            and self._settled > 0
            and not self._may_be_open(found, view, world, noise, submap)
        ):
            found = None
        newest = next(k for k in reversed(world.keyframes) if k.submap == submap)
        place = None if found is None else self._place_of(found, view, world, noise, submap)
        if place is not None:
            return self._judge(view, world, noise, newest, place, is_sure=True)
        if self._pending is None and self._since_look < _LOOK_INTERVAL:
            return None
        candidates = self._candidates(world, submap, view.T_world_cam)
        if not candidates:
            return None
        self._since_look = 0
        place = self._relocaliser.recognise(view.sight, world, noise, candidates)
        return None if place is None else self._judge(view, world, noise, newest, place, is_sure=False)

    def _may_be_open(
        self, found: Revisit, view: LoopView, world: WorldMap, noise: NoiseModel, submap: int
    ) -> bool:
        """Whether what was settled is in question: old landmarks are seen elsewhere than expected.

        Those of the newest keyframes don't count: around a loop just closed, they have yet to settle.
        """
        mine = world.keyframes_of(submap)
        if len(mine) <= _NUM_RECENT or found.keyframe_id >= mine[-_NUM_RECENT].frame_id:
            return False
        ids, xy = found.ids[found.points.ok], found.points.xy[found.points.ok]
        return not self._is_near(view, world.landmarks.xyz_of(ids), xy, noise)

    def _is_near(self, view: LoopView, xyz: Array, xy: Array, noise: NoiseModel) -> bool:
        """Whether landmarks of long ago are, by their median, seen where the view's pose has them."""
        residual, in_front = reprojection_residual(self._camera, invert_transform(view.T_world_cam), xyz, xy)
        away_px = float(np.median(np.where(in_front, np.linalg.norm(residual, axis=1), np.inf)))
        return away_px < GATE_SIGMAS * old_sigma_px(noise)

    def _place_of(
        self, found: Revisit, view: LoopView, world: WorldMap, noise: NoiseModel, submap: int
    ) -> Place | None:
        """Where a frame is that sees landmarks of long ago, going by these alone.

        Those of unknown depth have no say: together they agree with a pose far off. So do at times those of
        poor depth: found points must be no further from epipolar lines than at the frame's pose, or than
        their noise.
        """
        has_say = found.points.ok & tells_depth(self._camera, world.keyframes_of(submap), found.ids)
        ids, xy = found.ids[has_say], found.points.xy[has_say]
        sigma_px = old_sigma_px(noise)
        sigma = np.full(len(ids), sigma_px)
        xyz = world.landmarks.xyz_of(ids)
        pose = search_pose(self._camera, xyz, xy, sigma, GATE_SIGMAS * sigma, seed=self._seed)
        if pose is None or pose.num_inliers < max(_MIN_FOUND, _MIN_FOUND_SHARE * len(ids)):
            return None
        T_world_cam = invert_transform(pose.T_cam_world)
        off, off_before = (
            np.minimum((off_lines_px(self._camera, world, found, T) / sigma_px) ** 2, GATE_SIGMAS**2).mean()
            for T in (T_world_cam, view.T_world_cam)
        )
        if off > max(off_before, 1.0):
            return None
        return Place(T_world_cam, found.keyframe_id, ids[pose.inliers], xy[pose.inliers], submap)

    def _judge(
        self,
        view: LoopView,
        world: WorldMap,
        noise: NoiseModel,
        newest: Keyframe,
        place: Place,
        *,
        is_sure: bool,
    ) -> Loop | None:
        """What a recognised place means: that nothing has drifted, or a loop."""
        if self._is_near(view, world.landmarks.xyz_of(place.ids), place.xy, noise):
            self._pending, self._refused = None, 0
            if self._settled <= 0 or place.keyframe_id <= self._tied_id:
                self._settled, self._tied_id = _NUM_RECENT, place.keyframe_id
            return None
        fresh = ~np.isin(view.ids, place.ids)  # what is followed anyway knows no other scale
        similarity = submap_similarity(place, world, view.T_world_cam, view.ids[fresh], view.xy[fresh])
        if similarity is None:
            return None
        loop = Loop(newest.frame_id, place, *similarity)
        before, self._pending, self._since_pending = self._pending, loop, 0
        if not is_sure:
            depth = loop.scale * median_depth(world, newest)
            if before is None or not before.agrees(loop, view, depth):
                return None
        self._pending, self._refused = None, 0
        self._settled, self._tied_id = _NUM_RECENT, place.keyframe_id
        return loop

    def refuse(self) -> None:
        """Take note that the loop just found can't be closed: its place may be a wrong one.

        Nothing of it may be used meanwhile: landmark by landmark the map would be tied to it.
        """
        self._settled, self._refused = 0, _MAX_PENDING

    def note_tie(self, keyframe_id: int) -> None:
        """Note that a keyframe's landmarks were found where they should be: nothing has drifted since it.

        What was known of an older one is not prolonged by that.
        """
        if self._settled > 0 and keyframe_id <= self._tied_id:
            self._settled = _NUM_RECENT

    def _candidates(self, world: WorldMap, submap: int, T_world_cam: Array) -> list[Keyframe]:
        """Old keyframes the camera may be at if it has drifted on the way that no tie makes up for."""
        mine = world.keyframes_of(submap)
        if len(mine) <= _NUM_RECENT:
            return []
        newest, older = mine[-1], mine[:-_NUM_RECENT]
        position = np.stack([k.T_world_cam[:3, 3] for k in mine])
        steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
        if self._settled > 0:
            steps[np.array([k.frame_id for k in mine[1:]]) > self._tied_id] = 0.0
        way = (steps.sum() - np.concatenate([[0.0], np.cumsum(steps)]))[: len(older)]
        apart = np.linalg.norm(position[: len(older)] - T_world_cam[:3, 3], axis=1)
        axis = np.stack([k.T_world_cam[:3, 2] for k in older])
        turn = np.arccos(np.clip(axis @ T_world_cam[:3, 2], -1.0, 1.0))
        depth = median_depth(world, newest)
        near = (apart < _MAX_DRIFT * way + depth) & (apart < _MAX_APART * way)
        near &= turn < self._camera.half_diagonal_rad
        rows = np.flatnonzero(near)
        return [older[row] for row in rows[:: max(1, -(-len(rows) // MAX_CONSIDERED))].tolist()]


def share_out(world: WorldMap, submap: int, loop: Loop) -> tuple[Ids, SolvedGraph] | None:
    """Distribute the drift of a loop over the keyframes of a submap (pose graph).

    Args:
        world: The map; it is not changed.
        submap: Of the loop.
        loop: What was recognised.

    Returns:
        Frame ids of the submap's keyframes, ascending, and where they go; None where there is no solution, or
        none that drift explains.
    """
    mine = world.keyframes_of(submap)
    row = {k.frame_id: i for i, k in enumerate(mine)}
    constraints = [step.constraint for step in steps_of(world, mine)]
    for new, old in world.revisits.items():
        if new in row and old in row:
            constraints.append(
                _tie(world, mine, row[old], row[new], mine[row[new]].T_world_cam, 1.0, _FORMER_SIGMA)
            )
    old, new = row[loop.place.keyframe_id], row[loop.keyframe_id]
    constraints.append(
        _tie(world, mine, old, new, loop.moved(mine[new].T_world_cam), loop.scale, _PLACE_SIGMA)
    )
    solved = solve_graph(np.stack([k.T_world_cam for k in mine]), constraints)
    if solved is None or solved.cost > _MAX_COST:
        return None
    return np.array([k.frame_id for k in mine], dtype=np.int64), solved


def _tie(
    world: WorldMap,
    mine: Sequence[Keyframe],
    old: int,
    new: int,
    T_world_new: Array,
    scale: float,
    sigma: tuple[float, float, float],
) -> PoseConstraint:
    """What a place that was recognised says of two keyframes."""
    T = invert_transform(mine[old].T_world_cam) @ T_world_new
    depth = usable_depth(world, mine[old], float(np.linalg.norm(T[:3, 3])))
    return PoseConstraint(old, new, T, scale, (sigma[0], sigma[1] * depth, sigma[2]))
