"""ROS bags to read in tests, written by the library that reads them, in both versions and all containers."""

from types import SimpleNamespace

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

CONTAINERS = ("bag", "mcap", "sqlite3")
SECOND = 10**9
#: Of messages; others have some of the same names.
_PACKAGES = (
    "builtin_interfaces/",
    "geometry_msgs/",
    "nav_msgs/",
    "sensor_msgs/",
    "std_msgs/msg/Header",
    "tf2_msgs/",
)


class BagMaker:
    """Collects messages and writes them as one bag.

    Args:
        container: One of ``CONTAINERS``; the first is ROS 1, the others are ROS 2.
    """

    def __init__(self, container="mcap"):
        self._container = container
        self._store = get_typestore(Stores.ROS1_NOETIC if container == "bag" else Stores.LATEST)
        if container == "bag":  # its collection of ROS 1 lacks this one
            transforms = "geometry_msgs/TransformStamped[] transforms"
            self._store.register(get_types_from_msg(transforms, "tf2_msgs/msg/TFMessage"))
        self.types = SimpleNamespace(
            **{
                name.split("/")[-1]: kind
                for name, kind in self._store.types.items()
                if name.startswith(_PACKAGES)
            }
        )
        self._messages = []

    def header(self, time_ns, frame):
        stamp = self.types.Time(sec=time_ns // SECOND, nanosec=time_ns % SECOND)
        first = {"seq": 0} if self._container == "bag" else {}
        return self.types.Header(**first, stamp=stamp, frame_id=frame)

    def add(self, topic, message, time_ns):
        self._messages.append((topic, message, time_ns))

    def image(self, topic, pixels, encoding, time_ns, frame="cam", recorded_ns=None):
        pixels = np.asarray(pixels)
        message = self.types.Image(
            header=self.header(time_ns, frame),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=pixels.shape[1] * pixels.itemsize * (pixels.shape[2] if pixels.ndim == 3 else 1),
            data=pixels.view(np.uint8).ravel(),
        )
        self.add(topic, message, time_ns if recorded_ns is None else recorded_ns)

    def compressed(self, topic, content, form, time_ns, frame="cam"):
        data = np.frombuffer(content, dtype=np.uint8)
        kind = self.types.CompressedImage
        self.add(topic, kind(header=self.header(time_ns, frame), format=form, data=data), time_ns)

    def camera_info(
        self, topic, K, D, P, size_wh, model="plumb_bob", time_ns=SECOND, roi_xywh=(0, 0, 0, 0), binning=0
    ):
        x, y, width, height = roi_xywh
        roi = self.types.RegionOfInterest(
            x_offset=x, y_offset=y, height=height, width=width, do_rectify=False
        )
        named = {
            "K": np.array(K, float),
            "D": np.array(D, float),
            "R": np.eye(3).ravel(),
            "P": np.array(P, float),
        }
        if self._container != "bag":
            named = {name.lower(): value for name, value in named.items()}
        message = self.types.CameraInfo(
            header=self.header(time_ns, "cam"),
            height=size_wh[1],
            width=size_wh[0],
            distortion_model=model,
            binning_x=binning,
            binning_y=binning,
            roi=roi,
            **named,
        )
        self.add(topic, message, time_ns)

    def transform(self, topic, parent, child, xyz, time_ns, quat_xyzw=(0.0, 0.0, 0.0, 1.0)):
        stamped = self._stamped(parent, child, xyz, time_ns, quat_xyzw)
        self.add(topic, self.types.TFMessage(transforms=[stamped]), time_ns)

    def _stamped(self, parent, child, xyz, time_ns, quat_xyzw):
        x, y, z, w = quat_xyzw
        return self.types.TransformStamped(
            header=self.header(time_ns, parent),
            child_frame_id=child,
            transform=self.types.Transform(
                translation=self.types.Vector3(x=xyz[0], y=xyz[1], z=xyz[2]),
                rotation=self.types.Quaternion(x=x, y=y, z=z, w=w),
            ),
        )

    def pose(self, topic, parent, xyz, time_ns, w=1.0):
        pose = self._pose(xyz, w)
        self.add(topic, self.types.PoseStamped(header=self.header(time_ns, parent), pose=pose), time_ns)

    def _pose(self, xyz, w=1.0):
        return self.types.Pose(
            position=self.types.Point(x=xyz[0], y=xyz[1], z=xyz[2]),
            orientation=self.types.Quaternion(x=0.0, y=0.0, z=0.0, w=w),
        )

    def odometry(self, topic, parent, child, xyz, time_ns):
        zero = self.types.Vector3(x=0.0, y=0.0, z=0.0)
        twist = self.types.TwistWithCovariance(
            twist=self.types.Twist(linear=zero, angular=zero), covariance=np.zeros(36)
        )
        message = self.types.Odometry(
            header=self.header(time_ns, parent),
            child_frame_id=child,
            pose=self.types.PoseWithCovariance(pose=self._pose(xyz), covariance=np.zeros(36)),
            twist=twist,
        )
        self.add(topic, message, time_ns)

    def write(self, folder, name="drive"):
        """Write the bag and return its path: a file, but for sqlite3, where it is a folder."""
        is_ros1 = self._container == "bag"
        path = folder / (f"{name}.bag" if is_ros1 else name)
        plugins = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
        writer = (
            Writer1(path) if is_ros1 else Writer2(path, version=9, storage_plugin=plugins[self._container])
        )
        serialise = self._store.serialize_ros1 if is_ros1 else self._store.serialize_cdr
        with writer:
            connections = {}
            for topic, message, time_ns in sorted(self._messages, key=lambda said: said[2]):
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self._store)
                writer.write(connections[topic], time_ns, serialise(message, kind))
        return path / f"{name}.mcap" if self._container == "mcap" else path
