"""A Rerun recording of a finished run: the one the server wrote, or one made from poses, images and map."""

import contextlib
import json
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from semcast.common.errors import SemcastError, SourceError
from semcast.common.image_file import read_image
from semcast.common.message_fields import sendable
from semcast.common.run_folder import FRAMES_NAME, VIEWER_NAME, RunData
from semcast.common.whole_file import whole_file
from semcast.server.export.parts import after_gaps
from semcast.server.view.frame_view import FrameView
from semcast.server.view.picture import compress_picture
from semcast.server.view.rerun_viewer import Delivery, RerunStream
from semcast.server.view.scene import Cursor, Scene

JPEG_QUALITY = 80
CLOSE_DEADLINE_S = 30.0


def write_rrd(
    path: Path, folder: Path, data: RunData, images: Mapping[int, Path], *, copy: bool
) -> list[Path]:
    """Copy the run's own recording, plots included; without one, show its poses, kept images and points.

    The file is whole or stays as it was.

    Args:
        path: The ``.rrd`` file.
        folder: The run folder.
        data: Its reconstruction.
        images: Frame id to file of the kept images.
        copy: False where ``data`` is not all the run's own recording shows.

    Raises:
        SourceError: An image can't be read.
        SemcastError: The file can't be written, or not to its end.
        OSError: The folder, or a file in it, can't be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    recorded = folder / VIEWER_NAME
    if copy and recorded.is_file():
        with recorded.open("rb") as source, whole_file(path) as copied:
            shutil.copyfileobj(source, copied)
        return [path]
    begins_line = after_gaps(data.frame_ids.tolist(), _unposed(folder / FRAMES_NAME))
    # Rerun opens files by name: this one keeps the name until what is written is whole.
    with whole_file(path) as file:
        try:
            stream = RerunStream(
                recording_id=sendable(folder.name, 200) or "run",
                camera=data.intrinsics,
                has_truth=False,
                has_confidence=False,
                file=Path(file.name),
            )
        except (RuntimeError, UnicodeEncodeError) as err:  # a name may be no text
            raise SemcastError(f"{path} can't be written: {err}") from err
        try:
            _show(stream, data, images, begins_line)
            # Rerun writes on a thread of its own, and says only here that it could not, as on a full disk.
            delivery = stream.flush(CLOSE_DEADLINE_S)
        finally:
            is_closed = stream.close(CLOSE_DEADLINE_S)
        if not is_closed or delivery is not Delivery.DONE:
            raise SemcastError(f"{path} can't be written to its end: is there room on the disk?")
    return [path]


def _unposed(path: Path) -> list[int]:
    """Return the frames that had no pose when they were tracked, as far as the rows of a run tell."""
    posed: dict[int, bool] = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else ():
        with contextlib.suppress(ValueError, TypeError, KeyError):  # half a line, of a run that was killed
            row = json.loads(line)
            posed[int(row["frame_id"])] = bool(row["posed"])
    return [frame_id for frame_id, has_pose in posed.items() if not has_pose]


def _show(
    stream: RerunStream, data: RunData, images: Mapping[int, Path], begins_line: frozenset[int]
) -> None:
    """Send points, poses and images, frame by frame."""
    scene, cursor = Scene(), Cursor()
    # By how far landmarks are from where the camera begins, a scene knows how large it is.
    scene.set_keyframes(data.frame_ids[:1], data.T_world_cam[:1])
    scene.add_landmarks(data.landmark_ids, data.xyz, data.rgb, data.confidence, np.zeros(0, dtype=np.int64))
    begins_part = np.diff(data.frame_submap, prepend=data.frame_submap[:1]) != 0
    for frame_id, t_ns, T_world_cam, is_first in zip(
        data.frame_ids.tolist(), data.t_source_ns.tolist(), data.T_world_cam, begins_part, strict=True
    ):
        if is_first or frame_id in begins_line:
            scene.interrupt_path()
        view = _view(data, frame_id, t_ns, T_world_cam, images.get(frame_id))
        scene.add_frame(view)
        if view.image is not None:
            scene.set_picture(compress_picture(view, JPEG_QUALITY))
        stream.write(scene.changes_since(cursor))


def _view(
    data: RunData, frame_id: int, t_source_ns: int, T_world_cam: np.ndarray, path: Path | None
) -> FrameView:
    image = None
    if path is not None:
        try:
            image = read_image(path)
        except SourceError as err:
            raise SourceError(f"{path} can't be read as an image") from err
    xy = data.observed_xy[data.observed_keyframe_ids == frame_id]
    return FrameView(
        frame_id=frame_id,
        t_source_ns=t_source_ns,
        T_world_cam=T_world_cam,
        state="tracking",
        scalars={},
        image=image,
        confidence=None,
        keypoints_xy=xy,
        keypoint_inlier=np.ones(len(xy), dtype=bool),
    )
