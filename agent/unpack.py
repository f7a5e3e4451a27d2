"""A ROS bag as a recorded sequence of our own layout: images, times, camera and true path."""

import logging
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semcast.agent.frame_tree import FrameTree, StampedTransform, TransformHistory, plain_name
from semcast.agent.ros_bag import BagImage, RosBag
from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError
from semcast.common.new_folder import new_folder
from semcast.common.times import ns_to_seconds
from semcast.common.trajectory import Trajectory, seconds_of, write_tum
from semcast.common.whole_file import write_whole

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class UnpackSettings:
    """Settings of ``unpack``.

    Raises:
        ValueError: A value is out of range.
    """

    bag: Path = field(
        metadata={
            "help": "ROS bag: a .bag of ROS 1, or a folder of its parts; a folder, .mcap or .db3 of ROS 2",
            "positional": True,
        }
    )
    out: Path = field(metadata={"help": "new or empty folder for the sequence"})
    image_topic: str | None = field(
        default=None, metadata={"help": "topic of images to take; needed where there are several"}
    )
    camera_info_topic: str | None = field(
        default=None,
        metadata={"help": "topic of the camera's CameraInfo (default: camera_info beside the images)"},
    )
    truth: str | None = field(
        default=None,
        metadata={"help": "true path: a topic of poses, or the frame of /tf in which the camera's are to be"},
    )
    truth_frame: str | None = field(
        default=None,
        metadata={
            "help": "frame that the poses of --truth are of, where they don't say, as PoseStamped never does "
            "(default: the camera's)"
        },
    )
    camera_frame: str | None = field(
        default=None, metadata={"help": "frame of the camera (default: the one its images name)"}
    )
    start_s: float = field(default=0.0, metadata={"help": "leave out so many seconds at the beginning"})
    seconds: float | None = field(default=None, metadata={"help": "take so many seconds (default: all)"})

    def __post_init__(self) -> None:
        if not 0.0 <= self.start_s < math.inf:
            raise ValueError(f"start_s must be at least 0 and finite, got {self.start_s:g}")
        if self.seconds is not None and not 0.0 < self.seconds < math.inf:
            raise ValueError(f"seconds must be positive and finite, got {self.seconds:g}")


@dataclass(frozen=True)
class Unpacked:
    """What came out of a bag.

    Attributes:
        topic: Of its images.
        num_images: Written.
        num_left_out: Images that can't be read, or are out of order by their times.
        camera: As written, None where the bag says nothing of it.
        num_poses: True poses written, None where there are none.
    """

    topic: str
    num_images: int
    num_left_out: int
    camera: Intrinsics | None
    num_poses: int | None


def unpack(settings: UnpackSettings, on_image: Callable[[int, int], None] | None = None) -> Unpacked:
    """Write the images of a bag's camera as a sequence of the native layout.

    Compressed images are kept as they are, others become PNG.

    Args:
        settings: What to take.
        on_image: Is told after each image how many were taken, and how many the topic has.

    Raises:
        SourceError: The bag can't be read, there is no such image, topic or frame, or the folder can't be
            written.
    """
    with RosBag(settings.bag) as bag:
        topic = _image_topic(bag, settings.image_topic)
        camera = bag.camera(topic, settings.camera_info_topic)
        find_pose = None if settings.truth is None else _true_poses(bag, topic, settings, settings.truth)
        with new_folder(settings.out) as folder:
            (folder / "images").mkdir()
            times_ns, num_left_out = _write_images(bag, topic, settings, on_image)
            write_whole(folder / "times.txt", "".join(f"{seconds_of(t_ns)}\n" for t_ns in times_ns))
            if camera is not None:
                camera.save(folder / "intrinsics.json")
            truth = None if find_pose is None else _path(times_ns, find_pose)
            if truth is not None:
                write_tum(folder / "groundtruth.txt", truth)
    return Unpacked(topic, len(times_ns), num_left_out, camera, None if truth is None else len(truth))


def _image_topic(bag: RosBag, asked: str | None) -> str:
    counts = {topic: count for topic, count in bag.counts("image").items() if count}
    if asked is not None and asked in counts:
        return asked
    known = ", ".join(f"{topic} ({count})" for topic, count in counts.items()) or "none"
    if asked is not None:
        raise SourceError(f"image_topic must be one of those with images, {known}, got {asked}")
    if len(counts) != 1:
        raise SourceError(f"image_topic must be given where not one topic has images, they are: {known}")
    return next(iter(counts))


def _write_images(
    bag: RosBag, topic: str, settings: UnpackSettings, on_image: Callable[[int, int], None] | None
) -> tuple[list[int], int]:
    """Write the images; return their times, and how many were left out."""
    total = bag.counts("image")[topic]
    times_ns: list[int] = []
    num_left_out = 0
    images = bag.images(topic, settings.start_s, settings.seconds)
    for taken, (image, following) in enumerate(_with_following(images), 1):
        problem = image.problem or _out_of_order(image, following, times_ns)
        if problem:
            if not num_left_out:
                logger.warning("%s: image %d is left out: %s", topic, taken, problem)
            num_left_out += 1
        else:
            name = f"{len(times_ns):06d}{image.suffix}"
            write_whole(settings.out / "images" / name, image.content)
            times_ns.append(image.time_ns)
        if on_image is not None:
            on_image(taken, total)
    if not times_ns:
        why = (
            f"none of its {num_left_out} can be used"
            if num_left_out
            else "there is none in the time asked for"
        )
        raise SourceError(f"no image of {topic}: {why}")
    return times_ns, num_left_out


def _with_following(images: Iterable[BagImage]) -> Iterator[tuple[BagImage, BagImage | None]]:
    """Yield each image with the one after it, None after the last."""
    waiting = None
    for image in images:
        if waiting is not None:
            yield waiting, image
        waiting = image
    if waiting is not None:
        yield waiting, None


def _out_of_order(image: BagImage, following: BagImage | None, times_ns: list[int]) -> str:
    """Tell why an image can't be the next one, "" if it can.

    Where two are in the wrong order, the one that lies between its neighbours is right: a single time far
    ahead would otherwise cost all images up to it.
    """
    own = f"its time {seconds_of(image.time_ns)} s"
    if times_ns and image.time_ns <= times_ns[-1]:
        return f"{own} is not after {seconds_of(times_ns[-1])} s"
    if following is None or following.problem or image.time_ns <= following.time_ns:
        return ""
    is_following_right = not times_ns or following.time_ns > times_ns[-1]
    return f"{own} is not before {seconds_of(following.time_ns)} s, of the next" if is_following_right else ""


def _true_poses(
    bag: RosBag, topic: str, settings: UnpackSettings, truth: str
) -> Callable[[int], Array | None]:
    """Return what tells the camera's true pose at a time, None where it is not known.

    Those of a topic are carried from the frame they are of to the camera's.
    """
    first = next(bag.images(topic), None)
    camera = plain_name(settings.camera_frame or (first.frame if first is not None else ""))
    if not camera:
        raise SourceError(f"camera_frame must be given for a true path: the images of {topic} name none")
    tree = FrameTree()
    for transform in bag.transforms(topic):
        tree.add(transform)
    if bag.counts("pose").get(truth):
        unnamed = plain_name(settings.truth_frame or camera)
        return _carried_to(camera, bag.poses(truth), unnamed, truth, tree)
    root = plain_name(truth)
    if root not in tree.frames:
        raise SourceError(
            f"truth must be a topic of poses ({', '.join(bag.counts('pose')) or 'there is none'}) or a frame "
            f"of /tf ({', '.join(tree.frames) or 'there is none'}), got {truth}"
        )
    tree.check_connected(root, camera)
    return lambda time_ns: tree.pose(root, camera, time_ns)


def _carried_to(
    camera: str, poses: Iterable[StampedTransform], unnamed: str, topic: str, tree: FrameTree
) -> Callable[[int], Array | None]:
    """Return what tells the camera's pose at a time from a topic's poses of what it is fixed to.

    Args:
        camera: Its frame.
        poses: Of the topic.
        unnamed: Frame of those that don't say of what they are.
        topic: For messages.
        tree: Leads from what they are of to the camera.
    """
    path = TransformHistory()
    bodies = set()
    for pose in poses:
        path.add(pose.time_ns, pose.T_parent_child)
        bodies.add((pose.parent, pose.child or unnamed))
    if len(bodies) != 1:
        said = ", ".join(f"{child!r} in {parent!r}" for parent, child in sorted(bodies)) or "nothing"
        raise SourceError(f"the poses of {topic} must be of one frame in one other, got {said}")
    ((_, body),) = bodies
    if body == camera:
        return path.at
    tree.check_connected(body, camera)

    def find(time_ns: int) -> Array | None:
        T_world_body, T_body_cam = path.at(time_ns), tree.pose(body, camera, time_ns)
        return None if T_world_body is None or T_body_cam is None else T_world_body @ T_body_cam

    return find


def _path(times_ns: list[int], find_pose: Callable[[int], Array | None]) -> Trajectory | None:
    """Return the true poses at those times at which there are any; None with a warning at none of them."""
    found = [(t_ns, pose) for t_ns in times_ns if (pose := find_pose(t_ns)) is not None]
    if not found:
        logger.warning("there is no true pose at the time of any image: groundtruth.txt is not written")
        return None
    at_ns = np.array([t_ns for t_ns, _ in found], dtype=np.int64)
    return Trajectory(ns_to_seconds(at_ns), np.array([pose for _, pose in found]), at_ns)
