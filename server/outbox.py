"""Publishes what the server finds on a thread of its own: a slow subscriber never holds the tracker up."""

import logging
import threading
from collections import OrderedDict
from dataclasses import replace
from typing import Literal

import numpy as np

from semcast.common.errors import SemcastError
from semcast.common.geometry import make_transform
from semcast.common.keys import map_key, metric_pose_key, pose_key
from semcast.common.mailbox import Mailbox
from semcast.common.messages import MapMessage, MetricPose, PoseMessage
from semcast.common.metrics import Metrics
from semcast.common.transport import Publisher, Session
from semcast.common.wire import pack
from semcast.common.worker_guard import WorkerGuard
from semcast.server.export.markers import MarkerPlacement
from semcast.server.mapping.state import FrameResult, MapUpdate
from semcast.server.receiver import ReceivedFrame

logger = logging.getLogger(__name__)

#: Poses that wait for slow subscribers; beyond it the oldest are dropped as ``outbox``.
CAPACITY = 1024


class Outbox:
    """Sends poses and map changes of one agent.

    Of changes none may be missing, or who follows them has another map from then on, and would not know:
    those that wait become one.

    Args:
        session: An open session.
        agent_id: Whose stream it is.
        metrics: Where to count.
    """

    def __init__(self, session: Session, agent_id: str, metrics: Metrics) -> None:
        self._pose = session.publisher(pose_key(agent_id), "every")
        self._metric_pose = session.publisher(metric_pose_key(agent_id), "every")
        self._map = session.publisher(map_key(agent_id), "every")
        self._metrics = metrics
        self._box: Mailbox[PoseMessage | MetricPose | Literal["map"]] = Mailbox(CAPACITY, "newest")
        self._change: MapMessage | None = None
        self._change_lock = threading.Lock()
        self._t_capture_ns: OrderedDict[tuple[int, int], int] = OrderedDict()
        self._guard = WorkerGuard("sending what was found", self._on_failure)
        self._thread = threading.Thread(target=self._run, name="semcast-outbox", daemon=True)
        self._thread.start()

    def put_pose(self, arrival: ReceivedFrame, result: FrameResult) -> None:
        """Send what became of one frame, after the poses it gave to earlier frames.

        Args:
            arrival: The frame.
            result: What the tracker made of it.
        """
        epoch = arrival.message.agent_epoch
        self._t_capture_ns[(epoch, result.frame_id)] = arrival.message.t_capture_ns
        while len(self._t_capture_ns) > CAPACITY:
            self._t_capture_ns.popitem(last=False)
        for frame_id, t_source_ns, T_world_cam in result.backfilled:
            t_capture_ns = self._t_capture_ns.get((epoch, frame_id))
            if t_capture_ns is not None:
                late = replace(
                    result,
                    frame_id=frame_id,
                    t_source_ns=t_source_ns,
                    T_world_cam=T_world_cam,
                    num_inliers=0,
                    covariance=None,
                )
                self._put(pose_message(epoch, t_capture_ns, late))
        self._put(pose_message(epoch, arrival.message.t_capture_ns, result))

    def put_metric_pose(
        self, agent_epoch: int, result: FrameResult, placement: MarkerPlacement | None
    ) -> None:
        """Send the pose in metres of a frame that ``put_pose`` sent, if the way there is known.

        Args:
            agent_epoch: Of the frame.
            result: What the tracker made of it, or what an adjustment has made of that since.
            placement: The way to metres from its part of the map.
        """
        t_capture_ns = self._t_capture_ns.get((agent_epoch, result.frame_id))
        if placement is not None and t_capture_ns is not None:
            self._put(metric_pose(pose_message(agent_epoch, t_capture_ns, result), placement))

    def put_map(self, agent_epoch: int, update: MapUpdate) -> None:
        """Send what a frame, or the end of a stream, changed in the map."""
        message = map_message(agent_epoch, update)
        with self._change_lock:
            waiting, self._change = self._change, message
            if waiting is not None:
                self._change = merged(waiting, message)
        if waiting is None:
            self._put("map")

    def _put(self, entry: PoseMessage | MetricPose | Literal["map"]) -> None:
        self._metrics.drop("outbox", self._box.put(entry) or 0)

    def _run(self) -> None:
        while (entry := self._box.get()) is not None:
            if isinstance(entry, PoseMessage):
                self._send(self._pose, entry)
            elif isinstance(entry, MetricPose):
                self._send(self._metric_pose, entry)
            with self._change_lock:
                change, self._change = self._change, None
            if change is not None:
                self._send(self._map, change)

    def _send(self, publisher: Publisher, message: PoseMessage | MetricPose | MapMessage) -> None:
        with self._guard:
            try:
                publisher.put(pack(message))
            except SemcastError as err:
                self._metrics.drop("unsent")
                logger.debug("not sent: %s", err)

    def _on_failure(self, text: str) -> None:
        self._metrics.drop("unsent")
        self._metrics.error(text)

    def close(self) -> None:
        """Send what waits and end the thread. Idempotent."""
        self._box.close()
        self._thread.join(2.0)


def pose_message(agent_epoch: int, t_capture_ns: int, result: FrameResult) -> PoseMessage:
    """Return the message of a frame's pose."""
    T, covariance = result.T_world_cam, result.covariance
    known = covariance is not None and bool(np.isfinite(covariance).all())
    return PoseMessage(
        agent_epoch=agent_epoch,
        frame_id=result.frame_id,
        t_capture_ns=t_capture_ns,
        t_source_ns=result.t_source_ns,
        T_world_cam=tuple(T.ravel().tolist()) if T is not None else None,
        state=result.state.value,
        num_inliers=result.num_inliers,
        covariance=tuple(covariance.ravel().tolist()) if covariance is not None and known else None,
        map_epoch=result.map_epoch,
        submap=result.submap,
    )


def metric_pose(pose: PoseMessage, placement: MarkerPlacement) -> MetricPose:
    """Return a pose in metres; there must be one."""
    T_marker_cam = np.array(pose.T_world_cam).reshape(4, 4)
    T_marker_cam[:3, 3] = placement.points(T_marker_cam[None, :3, 3])[0]
    T_marker_cam[:3, :3] = placement.R @ T_marker_cam[:3, :3]
    covariance = pose.covariance
    if covariance is not None:
        unit = np.repeat([1.0, placement.scale], 3)
        covariance = tuple((np.array(covariance).reshape(6, 6) * np.outer(unit, unit)).ravel().tolist())
    return MetricPose(
        agent_epoch=pose.agent_epoch,
        frame_id=pose.frame_id,
        t_capture_ns=pose.t_capture_ns,
        t_source_ns=pose.t_source_ns,
        T_marker_cam=tuple(T_marker_cam.ravel().tolist()),
        covariance=covariance,
        m_per_unit=placement.scale,
        relative_sigma=placement.relative_sigma,
        T_marker_world=tuple(make_transform(placement.R, placement.t).ravel().tolist()),
        marker_id=placement.marker_id,
        num_keyframes=placement.num_images,
        map_epoch=pose.map_epoch,
        submap=pose.submap,
    )


def map_message(agent_epoch: int, update: MapUpdate) -> MapMessage:
    """Return the message of a map change, or of a whole map."""
    return MapMessage(
        agent_epoch=agent_epoch,
        map_epoch=update.map_epoch,
        ids=update.ids,
        xyz=update.xyz.astype(np.float32),
        rgb=update.rgb,
        confidence=update.confidence,
        removed=update.removed,
        keyframe_ids=update.keyframe_ids,
        keyframe_poses=update.keyframe_poses,
    )


def merged(earlier: MapMessage, later: MapMessage) -> MapMessage:
    """Return the change that two changes after each other are together."""
    if (earlier.agent_epoch, earlier.map_epoch) != (later.agent_epoch, later.map_epoch):
        return later  # another map
    stays = ~np.isin(earlier.ids, np.concatenate([later.ids, later.removed]))
    kept = ~np.isin(earlier.keyframe_ids, later.keyframe_ids)
    return replace(
        later,
        ids=np.concatenate([earlier.ids[stays], later.ids]),
        xyz=np.concatenate([earlier.xyz[stays], later.xyz]),
        rgb=np.concatenate([earlier.rgb[stays], later.rgb]),
        confidence=np.concatenate([earlier.confidence[stays], later.confidence]),
        removed=np.union1d(np.setdiff1d(earlier.removed, later.ids), later.removed),
        keyframe_ids=np.concatenate([earlier.keyframe_ids[kept], later.keyframe_ids]),
        keyframe_poses=np.concatenate([earlier.keyframe_poses[kept], later.keyframe_poses]),
    )
