"""Tells ROS bags by how they look, without reading them."""

import shlex
import struct
from pathlib import Path

from semcast.common.errors import SourceError

MCAP_MAGIC = b"\x89MCAP0\r\n"
#: After the magic: opcode of the header and its length, then the length of the profile's name.
_MCAP_HEAD = struct.Struct("<BQI")


def is_ros_bag(path: Path) -> bool:
    """Tell whether a path is a bag: ``.bag``, ``.db3``, an ``.mcap`` of ROS, a folder of ROS 2's or parts."""
    try:
        if path.is_dir():
            is_split = bag_parts(path) != [path]
            return is_split or b"rosbag2_bagfile_information" in _start_of(path / "metadata.yaml")
        if not path.is_file():
            return False
        start = _start_of(path)
    except OSError:
        return False
    if start.startswith(MCAP_MAGIC) and len(start) >= len(MCAP_MAGIC) + _MCAP_HEAD.size:
        _, _, length = _MCAP_HEAD.unpack_from(start, len(MCAP_MAGIC))
        begin = len(MCAP_MAGIC) + _MCAP_HEAD.size
        return start[begin : begin + length] in (b"ros1", b"ros2")
    return path.suffix.lower() in (".bag", ".db3")


def bag_parts(path: Path) -> list[Path]:
    """Return the files of a folder of nothing but ``.bag``, as ROS 1 splits one; else the path itself.

    Whether they belong together is told when they are opened.
    """
    inside = sorted(path.iterdir()) if path.is_dir() else []
    is_split = all(part.suffix.lower() == ".bag" for part in inside)
    return inside if inside and is_split else [path]


def check_no_ros_bag(path: Path) -> None:
    """Refuse a bag where something else is read.

    Raises:
        SourceError: It is one; the message says what to do with it.
    """
    if is_ros_bag(path):
        way = shlex.join(("semcast", "unpack", str(path), "--out", "FOLDER"))
        raise SourceError(f"{path} is a ROS bag: a sequence is made of it by: {way}")


def _start_of(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(4096)
