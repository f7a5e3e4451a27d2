"""Coordinate frames that hang on each other at times, as ROS keeps them in ``tf``."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from semcast.common.errors import SourceError
from semcast.common.geometry import interpolate_pose, invert_transform

Array = NDArray[np.float64]

#: Longest time between two transforms that are interpolated between.
MAX_GAP_NS = 250_000_000


@dataclass(frozen=True)
class StampedTransform:
    """How one frame lies in another.

    Attributes:
        parent: Frame that the child is given in.
        child: The frame.
        time_ns: When; None for always.
        T_parent_child: ``(4, 4)``.
    """

    parent: str
    child: str
    time_ns: int | None
    T_parent_child: Array


class TransformHistory:
    """How one frame lies in another over time. First all transforms are added, then they are asked for."""

    def __init__(self) -> None:
        self._times_ns: list[int] = []
        self._transforms: list[Array] = []
        self._fixed: Array | None = None

    def add(self, time_ns: int | None, T_parent_child: Array) -> None:
        """Add a transform at a time, in any order; None: it holds for all times."""
        if time_ns is None:
            self._fixed = T_parent_child
        else:
            self._times_ns.append(time_ns)
            self._transforms.append(T_parent_child)

    @cached_property
    def _in_order(self) -> tuple[NDArray[np.int64], Array]:
        times_ns, first = np.unique(np.array(self._times_ns, dtype=np.int64), return_index=True)
        return times_ns, np.array(self._transforms)[first]

    @cached_property
    def for_all_times(self) -> Array | None:
        """What holds at all times, also because it is said over and over, as ROS 1 does of what is rigid."""
        if self._fixed is None and len(self._in_order[0]) > 1:
            transforms = self._in_order[1]
            return transforms[0] if (transforms == transforms[0]).all() else None
        return self._fixed

    def at(self, time_ns: int) -> Array | None:
        """Return the transform at a time, ``(4, 4)``, by those around it; None where none is within reach.

        What holds ``for_all_times`` is passed over: a body that is seen at rest may be gone afterwards.
        """
        times_ns, transforms = self._in_order
        right = int(np.searchsorted(times_ns, time_ns))
        if right < len(times_ns) and times_ns[right] == time_ns:
            return np.asarray(transforms[right])
        if not 0 < right < len(times_ns):
            return None
        gap_ns = int(times_ns[right] - times_ns[right - 1])
        if gap_ns > MAX_GAP_NS:
            return None
        share = (time_ns - int(times_ns[right - 1])) / gap_ns
        return interpolate_pose(transforms[right - 1], transforms[right], share)


def plain_name(frame: str) -> str:
    """Return a frame's name without the slash that ROS 1 put before it."""
    return frame.removeprefix("/")


class FrameTree:
    """Frames, each in a parent. First all transforms are added, then poses are asked for."""

    def __init__(self) -> None:
        # Child -> parent -> how the child lies in it.
        self._edges: dict[str, dict[str, TransformHistory]] = {}

    @property
    def frames(self) -> list[str]:
        """All frames there are, in the order of the alphabet."""
        return sorted({*self._edges, *(parent for parents in self._edges.values() for parent in parents)})

    def add(self, said: StampedTransform) -> None:
        """Add a transform."""
        parents = self._edges.setdefault(said.child, {})
        parents.setdefault(said.parent, TransformHistory()).add(said.time_ns, said.T_parent_child)

    def check_connected(self, root: str, frame: str) -> None:
        """Check that transforms lead from one frame to another.

        Raises:
            SourceError: They don't, a frame is unknown, or one on the way hangs on two others.
        """
        for name in (root, frame):
            if name not in self.frames:
                known = ", ".join(self.frames) or "none"
                raise SourceError(f"there is no transform of a frame {name!r}: known are {known}")
        top, top_of_root = self._up(frame)[-1], self._up(root)[-1]
        if top != top_of_root:
            raise SourceError(
                f"no transforms lead from {frame!r}, which hangs on {top!r}, to {root!r}, "
                f"which hangs on {top_of_root!r}"
            )

    def pose(self, root: str, frame: str, time_ns: int) -> Array | None:
        """Return ``T_root_frame`` at a time, ``(4, 4)``; None where a transform on the way has no such time.

        Between two transforms at most a quarter of a second apart it is interpolated.

        Raises:
            SourceError: No transforms lead there.
        """
        self.check_connected(root, frame)
        up_root, up_frame = self._up(root), self._up(frame)
        meeting = next(name for name in up_frame if name in up_root)
        T_meeting_frame = self._down(meeting, up_frame, time_ns)
        T_meeting_root = self._down(meeting, up_root, time_ns)
        if T_meeting_frame is None or T_meeting_root is None:
            return None
        return invert_transform(T_meeting_root) @ T_meeting_frame

    def _up(self, frame: str) -> list[str]:
        """Return a frame, its parent, and so on."""
        names = [frame]
        while names[-1] in self._edges:
            parent, *others = self._edges[names[-1]]
            if others:
                raise SourceError(
                    f"frame {names[-1]!r} must have one parent, got "
                    f"{' and '.join(map(repr, (parent, *others)))}"
                )
            if parent in names:
                raise SourceError(f"frames must not hang on each other in a ring, got {[*names, parent]}")
            names.append(parent)
        return names

    def _down(self, ancestor: str, up: Iterable[str], time_ns: int) -> Array | None:
        """Return the pose in an ancestor of the first of the frames that lead up to it."""
        T_ancestor_frame = np.eye(4)
        for name, parent in pairwise(up):
            if name == ancestor:
                break
            edge = self._edges[name][parent]
            step = edge.at(time_ns) if edge.for_all_times is None else edge.for_all_times
            if step is None:
                return None
            T_ancestor_frame = step @ T_ancestor_frame
        return T_ancestor_frame
