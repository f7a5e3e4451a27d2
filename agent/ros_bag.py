"""ROS bags, versions 1 and 2: their images, cameras and transforms, read without ROS (by ``rosbags``)."""

import contextlib
import itertools
import logging
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import Connection
from rosbags.rosbag1 import ReaderError as Reader1Error
from rosbags.rosbag2 import ReaderError as Reader2Error
from rosbags.typesys import Stores, get_typestore

from semcast.agent.frame_tree import StampedTransform, plain_name
from semcast.agent.ros_bag_parts import check_times, in_order
from semcast.agent.ros_image import compressed_image_file, raw_image_file
from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError
from semcast.common.geometry import make_transform, rotation_from_quat_wxyz
from semcast.common.ros_bag_files import bag_parts, is_ros_bag

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

_RAW, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
#: Last names of the topics of tf, and whether what they say holds for all times.
_TF_TOPICS = {"tf": False, "tf_static": True}
#: Message with a pose -> where in it the pose is.
_POSES = {
    "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    "nav_msgs/msg/Odometry": "pose.pose",
    "geometry_msgs/msg/TransformStamped": "transform",
}


@dataclass(frozen=True)
class BagImage:
    """An image of a bag.

    Attributes:
        time_ns: When it was taken, by the clock of the headers; by that of the recording where no header says
            when.
        frame: Coordinate frame of its camera, "" where it says none.
        suffix: Of an image file, with the point.
        content: Of that file.
        problem: Why there is no content, else "".
    """

    time_ns: int
    frame: str
    suffix: str
    content: bytes
    problem: str = ""


class RosBag:
    """A bag that is open.

    Args:
        path: ``.bag`` of ROS 1, or a folder of the parts of one; folder with ``metadata.yaml``, ``.mcap`` or
            ``.db3`` of ROS 2.

    Raises:
        SourceError: There is no bag that can be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        if not path.exists():
            raise SourceError(f"there is no file or folder {path}")
        parts = in_order(bag_parts(path))
        try:
            with self._said():
                # Bags of ROS 2 before Iron don't hold the definitions of their messages.
                self._reader = AnyReader(parts, default_typestore=get_typestore(Stores.LATEST))
                self._reader.open()
        except SourceError as err:
            if is_ros_bag(path):
                raise
            raise SourceError(f"{path} is no ROS bag: 'semcast info' says what it is") from err
        try:
            check_times(parts, [(part.start_time, part.end_time) for part in self._reader.readers])
        except SourceError:
            self._reader.close()
            raise

    def __enter__(self) -> "RosBag":
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._reader.close()

    @contextlib.contextmanager
    def _said(self) -> Iterator[None]:
        """Turn what the library says of a damaged bag into an error of ours.

        It has errors of its own for damage that it looks for. For any other it fails as its parsers, of four
        formats, happen to: by assertions, keys, texts that are none, sizes beyond memory, errors of SQLite.
        """
        try:
            yield
        except (AnyReaderError, Reader1Error, Reader2Error, OSError) as err:
            raise SourceError(f"{self._path} can't be read as a ROS bag: {err}") from err
        except Exception as err:
            what = " ".join(f"{type(err).__name__} {err}".split())
            raise SourceError(f"{self._path} can't be read as a ROS bag, it is damaged: {what}") from err

    @property
    def span_s(self) -> float:
        """Time from the first message to the last."""
        return self._reader.duration * 1e-9 if self._reader.message_count else 0.0

    def counts(self, kind: Literal["image", "pose"]) -> dict[str, int]:
        """Return topic -> number of messages, of topics of a kind."""
        wanted = (_RAW, _COMPRESSED) if kind == "image" else tuple(_POSES)
        counts: dict[str, int] = {}
        for connection in self._reader.connections:
            if connection.msgtype in wanted:
                counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
        return dict(sorted(counts.items()))

    def _messages(
        self, topics: set[str], since_ns: int | None = None, until_ns: int | None = None
    ) -> Iterator[tuple[Connection, int, Any]]:
        connections = [c for c in self._reader.connections if c.topic in topics]
        if not connections:
            return
        with self._said():
            for connection, time_ns, raw in self._reader.messages(connections, since_ns, until_ns):
                yield connection, time_ns, self._reader.deserialize(raw, connection.msgtype)

    def images(self, topic: str, start_s: float = 0.0, seconds: float | None = None) -> Iterator[BagImage]:
        """Yield the images of a topic in the order in which they were recorded.

        Args:
            topic: Of images.
            start_s: From so long after the bag's beginning on.
            seconds: For so long; None to the end.
        """
        since_ns = self._reader.start_time + round(start_s * 1e9)
        until_ns = None if seconds is None else since_ns + round(seconds * 1e9)
        late_ns = self._late_ns(topic)
        for connection, recorded_ns, message in self._messages({topic}, since_ns, until_ns):
            time_ns = _stamp_ns(message.header) or recorded_ns - late_ns
            frame = plain_name(message.header.frame_id)
            is_raw = connection.msgtype == _RAW
            try:
                suffix, content = raw_image_file(message) if is_raw else compressed_image_file(message)
            except SourceError as err:
                yield BagImage(time_ns, frame, "", b"", str(err))
            else:
                yield BagImage(time_ns, frame, suffix, content)

    def _late_ns(self, topic: str) -> int:
        """Return by how much the recording's clock is ahead of the headers'; 0 where these say no time.

        A simulator's first image may well be of the time 0, of a clock that has little to do with ours.
        """
        first_two = itertools.islice(self._messages({topic}), 2)
        stamps_ns = ((recorded_ns, _stamp_ns(message.header)) for _, recorded_ns, message in first_two)
        return next((recorded_ns - stamp_ns for recorded_ns, stamp_ns in stamps_ns if stamp_ns), 0)

    def camera(self, image_topic: str, info_topic: str | None = None) -> Intrinsics | None:
        """Return the camera of an image topic, None where the bag says nothing of it or it wasn't calibrated.

        Rectified images (``image_rect``...) have the projection that rectifies to, without distortion.

        Args:
            image_topic: Topic of its images.
            info_topic: Topic of its ``CameraInfo``; None takes the ``camera_info`` beside the images.

        Raises:
            SourceError: It is none of a pinhole, or the topic that was named is not there.
        """
        base = re.sub(r"/(compressed|ffmpeg|theora)$", "", image_topic)
        folder, _, name = base.rpartition("/")
        topic = info_topic or f"{folder}/camera_info"
        is_info = {c.topic for c in self._reader.connections if c.msgtype == _CAMERA_INFO}
        if topic not in is_info:
            if info_topic is None:
                return None
            raise SourceError(
                f"camera_info_topic must be one of {', '.join(sorted(is_info)) or 'none'}, got {topic}"
            )
        info = next((message for _, _, message in self._messages({topic})), None)
        if info is None or not any(info.K if hasattr(info, "K") else info.k):
            logger.warning("%s says nothing: its camera was not calibrated", topic)
            return None
        try:
            return _intrinsics(info, is_rectified=name.startswith("image_rect"))
        except (SourceError, ValueError) as err:  # the latter where binning leaves no pixel
            raise SourceError(f"{topic}: {err}") from err

    def poses(self, topic: str) -> Iterator[StampedTransform]:
        """Yield the poses of a topic; ``child`` is "" where they don't say whose they are.

        Those without a rotation or with numbers that are none are left out: trackers that have lost their
        body say such things.
        """
        yield from _valid_transforms(topic, self._poses(topic))

    def _poses(self, topic: str) -> Iterator[tuple[str, str, int, Any]]:
        for connection, recorded_ns, message in self._messages({topic}):
            pose: Any = message
            for part in _POSES[connection.msgtype].split("."):
                pose = getattr(pose, part)
            time_ns = _stamp_ns(message.header) or recorded_ns
            yield message.header.frame_id, getattr(message, "child_frame_id", ""), time_ns, pose

    def transforms(self, near: str = "") -> Iterator[StampedTransform]:
        """Yield what ``tf`` and ``tf_static`` say; as in ROS, but for what is no transform.

        Args:
            near: A topic. Of several namespaces those count that it lies in, if there are such: robots of a
                team may have frames of the same names. Else what the root has no topic for is taken from all.
        """
        topics = {c.topic for c in self._reader.connections if c.msgtype in _TF_TYPES}
        places = {topic: _place(topic) for topic in topics if _place(topic)[1] in _TF_TOPICS}
        around = {topic for topic, (folder, _) in places.items() if near.startswith(folder + "/")}
        if not any(places[topic][0] for topic in around):  # in no namespace: the root may say a part only
            said = {places[topic][1] for topic in around}
            around |= {topic for topic, (_, name) in places.items() if name not in said}
        yield from _valid_transforms("tf", self._transforms(around))

    def _transforms(self, topics: set[str]) -> Iterator[tuple[str, str, int | None, Any]]:
        for connection, recorded_ns, message in self._messages(topics):
            for said in message.transforms:
                is_fixed = _TF_TOPICS[_place(connection.topic)[1]]
                time_ns = None if is_fixed else _stamp_ns(said.header) or recorded_ns
                yield said.header.frame_id, said.child_frame_id, time_ns, said.transform


def _place(topic: str) -> tuple[str, str]:
    """Return the namespace of a topic, "" at the root, and its last name."""
    namespace, _, name = topic.rpartition("/")
    return namespace, name


def _valid_transforms(
    topic: str, said: Iterable[tuple[str, str, int | None, Any]]
) -> Iterator[StampedTransform]:
    """Yield transforms of parent, child, time and pose of a message; warn once of those that are none."""
    is_told = False
    for parent, child, time_ns, pose in said:
        try:
            matrix = _matrix(pose)
        except ValueError as err:
            if not is_told:
                logger.warning("%s: %r in %r is left out where it is no pose: %s", topic, child, parent, err)
            is_told = True
        else:
            yield StampedTransform(plain_name(parent), plain_name(child), time_ns, matrix)


def _stamp_ns(header: Any) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def _matrix(pose: Any) -> Array:
    """Return the 4x4 matrix of a ``Pose`` or a ``Transform``.

    Raises:
        ValueError: Its numbers are none of a pose.
    """
    at = pose.position if hasattr(pose, "position") else pose.translation
    turn = pose.orientation if hasattr(pose, "orientation") else pose.rotation
    t = np.array([at.x, at.y, at.z], dtype=np.float64)
    if not np.isfinite(t).all():
        raise ValueError(f"position must be finite, got {t.tolist()}")
    return make_transform(rotation_from_quat_wxyz((turn.w, turn.x, turn.y, turn.z)), t)


def _intrinsics(info: Any, *, is_rectified: bool) -> Intrinsics:
    """Return the camera of a ``CameraInfo``; ROS 1 writes its fields in capitals.

    It is calibrated for whole images of full resolution. Those that are sent may be a part of them (``roi``,
    in pixels of full resolution), of which ``binning`` makes one pixel of several.
    """
    K, D, P = (
        np.asarray(getattr(info, n if hasattr(info, n) else n.lower()), dtype=np.float64) for n in "KDP"
    )
    matrix = P.reshape(3, 4)[:, :3] if is_rectified else K.reshape(3, 3)
    width, height = info.roi.width or info.width, info.roi.height or info.height
    camera = Intrinsics.from_dict(
        {
            "fx": float(matrix[0, 0]),
            "fy": float(matrix[1, 1]),
            "cx": float(matrix[0, 2]) - info.roi.x_offset,
            "cy": float(matrix[1, 2]) - info.roi.y_offset,
            "width": int(width),
            "height": int(height),
            **({} if is_rectified else {"distortion_model": info.distortion_model, "distortion": D.tolist()}),
        }
    )
    return _binned(camera, int(info.binning_x or 1), int(info.binning_y or 1))


def _binned(camera: Intrinsics, columns: int, rows: int) -> Intrinsics:
    """Return the camera whose pixels are so many columns and rows of another's; what is over is not sent."""
    width, height = camera.width // columns, camera.height // rows
    if not width or not height:
        raise ValueError(
            f"binning must leave a pixel of {camera.width}x{camera.height}, got {columns}x{rows}"
        )
    return replace(camera, width=width * columns, height=height * rows).scaled_to(width, height)
