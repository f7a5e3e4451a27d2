"""What there is of a map, and its files: trajectory, landmarks, what exports to other tools are made from."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.run_folder import (
    MAP_NAME,
    RECONSTRUCTION_NAME,
    TRAJECTORY_NAME,
    PartInMetres,
    RunData,
    write_run,
)
from semcast.common.trajectory import Trajectory, write_tum
from semcast.server.export.outputs import EachFile, trajectory_of, write_ply
from semcast.server.mapping.reconstruction import Reconstruction

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Results:
    """What there is of a map.

    Attributes:
        poses: ``T_world_cam`` of all posed frames by id.
        trajectory: The same with times.
        part_of: Frame id of each -> the part of the map it is in now.
        num_landmarks: Of the map.
        num_keyframes: Keyframes the map rests on.
    """

    poses: Mapping[int, Array]
    trajectory: Trajectory
    part_of: Mapping[int, int]
    num_landmarks: int
    num_keyframes: int


def results_of(reconstruction: Reconstruction, t_source_ns: Mapping[int, int]) -> Results:
    """Sum up a map.

    Args:
        reconstruction: Whose map.
        t_source_ns: Frame id to recorded time.
    """
    poses = reconstruction.final_trajectory()
    world = reconstruction.world
    return Results(
        poses=poses,
        trajectory=trajectory_of(poses, t_source_ns),
        part_of=world.part_of_frames(),
        num_landmarks=len(world.landmarks),
        num_keyframes=len(np.unique(world.observations()[1])),
    )


def write_results(
    folder: Path,
    reconstruction: Reconstruction,
    results: Results,
    camera: Intrinsics,
    t_source_ns: Mapping[int, int],
    each: EachFile,
    metres: tuple[PartInMetres, ...] = (),
) -> None:
    """Write trajectory, map and reconstruction, which is what exports to other tools are made from.

    Args:
        folder: Where to.
        reconstruction: Whose map.
        results: Of the same.
        camera: Of the decoded images.
        t_source_ns: Frame id to recorded time.
        each: Takes note of files that can't be written.
        metres: Of each part whose unit is known.
    """
    ids, xyz, rgb, confidence = reconstruction.landmarks()
    landmark_ids, keyframe_ids, xy = reconstruction.world.observations()
    with each.attempt(folder / TRAJECTORY_NAME) as path:
        write_tum(path, results.trajectory)
    with each.attempt(folder / MAP_NAME) as path:
        write_ply(path, xyz, rgb, confidence)
    timed = sorted(frame_id for frame_id in results.poses if frame_id in t_source_ns)
    used = np.isin(landmark_ids, ids) & np.isin(keyframe_ids, timed)
    with each.attempt(folder / RECONSTRUCTION_NAME):
        write_run(
            folder,
            RunData(
                intrinsics=camera,
                frame_ids=np.array(timed, dtype=np.int64),
                t_source_ns=np.array([t_source_ns[k] for k in timed], dtype=np.int64),
                T_world_cam=np.array([results.poses[k] for k in timed]).reshape(-1, 4, 4),
                frame_submap=np.array([results.part_of[k] for k in timed], dtype=np.int64),
                keyframe_ids=np.unique(keyframe_ids[used]),
                landmark_ids=ids,
                xyz=xyz,
                rgb=rgb,
                confidence=confidence,
                landmark_submap=reconstruction.world.landmarks.submap,
                observed_landmark_ids=landmark_ids[used],
                observed_keyframe_ids=keyframe_ids[used],
                observed_xy=xy[used].astype(np.float32),
                metres=metres,
            ),
        )
