"""The map of a running server, kept up to date in another process: for planning, or for one's own viewer."""

import logging
import threading
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semcast.common.errors import TransportError
from semcast.common.keys import map_key
from semcast.common.messages import MapMessage, MetricPose
from semcast.common.transport import Session
from semcast.common.wire import WireError, unpack

logger = logging.getLogger(__name__)

#: A map that is begun anew while it is asked for is asked for again, so often in all.
_MAX_QUESTIONS = 3


@dataclass(frozen=True)
class MirroredMap:
    """A map at one moment; arrays are never changed.

    Attributes:
        agent_epoch: Start of the agent it belongs to, 0 while there is none.
        map_epoch: Counts new maps within it; positions of two epochs have nothing to do with each other.
        ids: ``(N,)`` int64 landmarks, ascending.
        xyz: ``(N, 3)`` float32 in the world frame, map units.
        rgb: ``(N, 3)`` uint8.
        confidence: ``(N,)`` float32 in [0, 1].
        keyframe_ids: ``(K,)`` int64 frame ids of keyframes, ascending.
        keyframe_poses: ``(K, 4, 4)`` float64 ``T_world_cam``.
    """

    agent_epoch: int
    map_epoch: int
    ids: NDArray[np.int64]
    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    keyframe_ids: NDArray[np.int64]
    keyframe_poses: NDArray[np.float64]

    def in_metres(self, pose: MetricPose) -> "MirroredMap":
        """Return the map in metres and in the frame of a marker, as a pose of the same map epoch tells.

        That holds for the part of the map the pose is in; place and size of other parts are guesses.

        Raises:
            ValueError: The pose is of another start of the agent or another map epoch.
        """
        mine, its = (self.agent_epoch, self.map_epoch), (pose.agent_epoch, pose.map_epoch)
        if its != mine:
            raise ValueError(f"pose must be of agent_epoch and map_epoch {mine}, got {its}")
        T_marker_world = np.array(pose.T_marker_world).reshape(4, 4)
        R, t = T_marker_world[:3, :3], T_marker_world[:3, 3]
        keyframe_poses = self.keyframe_poses.copy()
        keyframe_poses[:, :3, 3] *= pose.m_per_unit
        return replace(
            self,
            xyz=(pose.m_per_unit * self.xyz @ R.T + t).astype(np.float32),
            keyframe_poses=T_marker_world @ keyframe_poses,
        )

    def updated(self, message: MapMessage) -> "MirroredMap":
        """Return the map with what a message says is new, moved or gone; a new epoch begins anew."""
        before = self
        if not _is_of(message, self):
            before = _EMPTY
        stays = ~np.isin(before.ids, np.concatenate([message.ids, message.removed]))
        ids = np.concatenate([before.ids[stays], message.ids])
        order = np.argsort(ids, kind="stable")
        kept = ~np.isin(before.keyframe_ids, message.keyframe_ids)
        keyframe_ids = np.concatenate([before.keyframe_ids[kept], message.keyframe_ids])
        in_time = np.argsort(keyframe_ids, kind="stable")
        return MirroredMap(
            agent_epoch=message.agent_epoch,
            map_epoch=message.map_epoch,
            ids=ids[order],
            xyz=np.concatenate([before.xyz[stays], message.xyz])[order],
            rgb=np.concatenate([before.rgb[stays], message.rgb])[order],
            confidence=np.concatenate([before.confidence[stays], message.confidence])[order],
            keyframe_ids=keyframe_ids[in_time],
            keyframe_poses=np.concatenate([before.keyframe_poses[kept], message.keyframe_poses])[in_time],
        )


_EMPTY = MirroredMap(
    agent_epoch=0,
    map_epoch=0,
    ids=np.zeros(0, np.int64),
    xyz=np.zeros((0, 3), np.float32),
    rgb=np.zeros((0, 3), np.uint8),
    confidence=np.zeros(0, np.float32),
    keyframe_ids=np.zeros(0, np.int64),
    keyframe_poses=np.zeros((0, 4, 4)),
)


class MapMirror:
    """Follows the map of one agent's server, from whatever moment on and over restarts of the server.

    Args:
        session: An open session; the mirror ends with it.
        agent_id: Whose map.
        timeout_s: How long to wait for the server's answer; without one the map begins empty and is asked for
            again when a server appears, and when its map changes.

    Raises:
        TransportError: The session is closed.
    """

    def __init__(self, session: Session, agent_id: str, timeout_s: float = 5.0) -> None:
        self._session, self._agent_id, self._timeout_s = session, agent_id, timeout_s
        self._lock = threading.Lock()
        self._asking = threading.Lock()
        self._map = _EMPTY
        self._early: list[MapMessage] | None = None
        #: Counts servers that went away, and of which of them the map is. One may go while its answer is on
        #: its way: the map is its then, and not that of the next one.
        self._server = 0
        self._map_of: int | None = None
        session.subscribe(map_key(agent_id), "every", self._on_change)
        self._catch_up()
        session.watch_alive(agent_id, self._on_role)

    @property
    def map(self) -> MirroredMap:
        """The newest state."""
        with self._lock:
            return self._map

    @property
    def _is_behind(self) -> bool:
        """Whether the map isn't that of the present server."""
        return self._map_of != self._server

    def _catch_up(self, *early: MapMessage) -> None:
        """Take the whole map from the server, where it has one.

        Changes that came before it was asked, as those given, are in the answer. Those that come meanwhile
        may be older or newer. Once more on top of it they give the newest state: the last word on a landmark
        is either among them or in the answer. Changes of another map may be of the one before or of the next
        one, and numbers don't tell which, as an agent's clock may have been set back: it is asked again.
        """
        with self._asking:
            with self._lock:
                self._early, asked = [*early], self._server
            whole, num_before = self._ask(), len(early)
            for num_asked in range(1, _MAX_QUESTIONS + 1):
                with self._lock:
                    num_now = len(self._early)
                    # Where it had no map when it was asked, it has one now.
                    is_settled = all(whole is not None and _is_of(m, whole) for m in self._early[num_before:])
                if is_settled or num_asked == _MAX_QUESTIONS:
                    break
                if (answer := self._ask()) is not None:
                    whole, num_before = answer, num_now
            with self._lock:
                changes, self._early = self._early or [], None
                if whole is not None:
                    self._map = _EMPTY.updated(whole)
                    changes = [m for m in changes[num_before:] if _is_of(m, whole)]
                    if is_settled:
                        self._map_of = asked
                for message in changes:
                    self._map = self._map.updated(message)

    def _ask(self) -> MapMessage | None:
        """Whole map of the server, None where it has none or does not answer."""
        try:
            answer = self._session.request(map_key(self._agent_id), b"", self._timeout_s)
            return unpack(answer, MapMessage) if answer is not None else None
        except (TransportError, WireError) as err:
            logger.warning("the map can't be taken from the server: %s", err)
            return None

    def _on_role(self, role: str, alive: bool | None) -> None:
        """A server that was away may be another one, with another map."""
        if role != "server":
            return
        with self._lock:
            if not alive:
                self._server += 1
            must_ask = alive and self._is_behind
        if must_ask:
            self._catch_up()

    def _on_change(self, payload: bytes) -> None:
        try:
            message = unpack(payload, MapMessage)
        except WireError as err:
            logger.warning("a map message can't be read: %s", err)
            return
        with self._lock:
            if self._early is not None:
                self._early.append(message)
                return
            if not self._is_behind and _is_of(message, self._map):
                self._map = self._map.updated(message)
                return
        # A new map has begun, or was reported on before the answer that this one was made of; or when its
        # server appeared there was none yet, nor word of what became of that of the one before.
        self._catch_up(message)


def _is_of(message: MapMessage, other: MapMessage | MirroredMap) -> bool:
    """Tell whether a change is of the same map as another one, or of this map."""
    return (message.agent_epoch, message.map_epoch) == (other.agent_epoch, other.map_epoch)
