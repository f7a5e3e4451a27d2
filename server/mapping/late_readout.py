"""Puts a map right that was begun before it was known that its camera has a rolling shutter."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_se3, invert_transform, transform_points
from semcast.server.geometry.projection import MIN_DEPTH_MAP
from semcast.server.mapping.keyframe_images import KeyframeImages, SeenFrom
from semcast.server.mapping.readout import lean
from semcast.server.mapping.rolling_shutter import ImageFlow, RowTimes, taken_from
from semcast.server.mapping.world_map import WorldMap

Array = NDArray[np.float64]

#: Landmarks by which a pose is put right at least.
_MIN_POINTS = 12


def put_map_right(
    world: WorldMap, images: KeyframeImages, camera: Intrinsics, flows: Mapping[int, ImageFlow]
) -> None:
    """Make up for a rolling shutter in all that a map was made from.

    What keyframes saw moves to where a global shutter would have had it, and their images too; poses lose
    what they took over of the shutter's lean. Landmarks stay: an adjustment has to follow.

    Args:
        world: The map.
        images: Of keyframes.
        camera: Pinhole, with the readout that is not made up for yet.
        flows: How images moved, by frame id; frames without are left as they are.
    """
    poses = _upright(world, camera, flows)
    rows = RowTimes(camera)
    greys = {image.frame_id: image.grey for image in images}
    for keyframe in world.keyframes:
        frame_id = keyframe.frame_id
        if (flow := flows.get(frame_id)) is None:
            continue
        keyframe.xy = rows.put_right(flow, keyframe.xy)
        if (grey := greys.get(frame_id)) is not None:
            right = np.asarray(taken_from(grey, rows.places(flow, camera.shape_hw)), np.uint8)
            images.replace(SeenFrom(frame_id, right))
        if frame_id in poses:
            world.move_keyframe(frame_id, poses[frame_id])
    for frame_id, T_world_cam in poses.items():
        world.move_frame(frame_id, T_world_cam)


def _upright(world: WorldMap, camera: Intrinsics, flows: Mapping[int, ImageFlow]) -> dict[int, Array]:
    """Return ``T_world_cam`` of the middle row of frames, by frame id."""
    keyframes = {keyframe.frame_id: keyframe for keyframe in world.keyframes}
    poses = {}
    for frame_id, flow in flows.items():
        T_world_cam = world.pose_of_frame(frame_id)
        if T_world_cam is None or (keyframe := keyframes.get(world.frames[frame_id][0])) is None:
            continue
        xyz = world.landmarks.xyz_of(keyframe.ids)
        points = transform_points(invert_transform(T_world_cam), xyz)
        points = points[points[:, 2] > MIN_DEPTH_MAP]
        xy = camera.project(points)
        inside = ((xy >= 0.0) & (xy < (camera.width, camera.height))).all(axis=1)
        if inside.sum() >= _MIN_POINTS:
            off = lean(camera, points[inside], flow.at(xy[inside]))
            poses[frame_id] = T_world_cam @ exp_se3(-off)
    return poses
