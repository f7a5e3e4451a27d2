"""Poses in metres on the air, from a marker beside the road."""

import numpy as np
import pytest
from drawn_markers import draw_marker
from waiting import until

from semcast.common.geometry import invert_transform, make_transform
from semcast.common.keys import metric_pose_key
from semcast.common.map_mirror import MapMirror
from semcast.common.messages import MetricPose
from semcast.common.network_settings import NetworkSettings
from semcast.common.run_folder import read_run
from semcast.common.trajectory import read_tum
from semcast.common.transport import open_client
from semcast.common.wire import unpack
from semcast.server.export.markers import MAX_UNCERTAINTY
from semcast.server.frame_rows import read_rows
from semcast.server.marker_settings import MarkerSettings

pytestmark = pytest.mark.xdist_group("real-time")

AGENT = "cam0"
DEADLINE_S = 60.0
SIDE_M, NUMBER = 3.0, 5
#: Beside the road, facing who comes.
T_FIRST_MARKER = make_transform(np.diag([1.0, -1.0, -1.0]), (-4.0, -0.5, 36.0))


@pytest.fixture
def metric_poses(air):
    """Listen to poses in metres."""
    with open_client(NetworkSettings(connect=(air.endpoint,)), DEADLINE_S) as client:
        heard = []
        client.subscribe(metric_pose_key(AGENT), "every", lambda data: heard.append(unpack(data, MetricPose)))
        yield heard


def test_poses_come_in_metres_as_soon_as_the_marker_tells_them(tmp_path, air, metric_poses):
    T_world_cam = air.sequence.groundtruth().T_world_cam
    truth = invert_transform(T_world_cam[0] @ T_FIRST_MARKER) @ T_world_cam
    images = [
        draw_marker(air.sequence.image(k), air.sequence.intrinsics, invert_transform(T), SIDE_M, NUMBER)
        for k, T in enumerate(truth[: len(air.sequence)])
    ]
    air.codec.pictures = lambda number: images[number]
    running = air.serve(out=tmp_path, marker=MarkerSettings(side_m=SIDE_M))
    radio = air.agent(100)
    with open_client(NetworkSettings(connect=(air.endpoint,)), DEADLINE_S) as client:
        mirror = MapMirror(client, AGENT, DEADLINE_S)
        radio.stream(range(len(images)))
        until(lambda: metric_poses and metric_poses[-1].frame_id == len(images) - 1, "the last one in metres")
        num_on_the_way = len(metric_poses)
        summary = running.finish(stop=True)
        until(lambda: len(metric_poses) > num_on_the_way, "the last one as the last adjustment leaves it")
        (adjusted,) = metric_poses[num_on_the_way:]
        del metric_poses[num_on_the_way:]
        first, last = metric_poses[0], metric_poses[-1]
        assert [m.frame_id for m in metric_poses] == list(range(first.frame_id, len(images)))
        assert 3 < first.frame_id < len(images) - 6
        assert 1.96 * first.relative_sigma <= MAX_UNCERTAINTY
        assert last.relative_sigma < 0.5 * first.relative_sigma
        for found in metric_poses[-6:]:
            pose = next(p for p in radio.poses if p.frame_id == found.frame_id)
            assert found.t_capture_ns == pose.t_capture_ns
            # The same pose, in the other frame and unit.
            T_marker_world = np.array(found.T_marker_world).reshape(4, 4)
            T_world_cam = np.array(pose.T_world_cam).reshape(4, 4)
            T_world_cam[:3, 3] *= found.m_per_unit
            T_marker_cam = np.array(found.T_marker_cam).reshape(4, 4)
            np.testing.assert_allclose(T_marker_world @ T_world_cam, T_marker_cam, atol=1e-9)
            distance_m = np.linalg.norm(truth[found.frame_id][:3, 3])
            np.testing.assert_allclose(
                T_marker_cam[:3, 3], truth[found.frame_id][:3, 3], atol=0.03 * distance_m
            )
            covariance = np.array(found.covariance).reshape(6, 6)
            in_units = np.array(pose.covariance).reshape(6, 6)
            np.testing.assert_allclose(covariance[3:, 3:], found.m_per_unit**2 * in_units[3:, 3:])
            np.testing.assert_allclose(covariance[:3, 3:], found.m_per_unit * in_units[:3, 3:])
        assert (adjusted.frame_id, adjusted.t_capture_ns) == (last.frame_id, last.t_capture_ns)
        assert adjusted.covariance is None
        T_world_last = read_tum(tmp_path / "trajectory.tum").T_world_cam[-1]
        T_world_last[:3, 3] *= adjusted.m_per_unit
        T_marker_world = np.array(adjusted.T_marker_world).reshape(4, 4)
        T_marker_last = np.array(adjusted.T_marker_cam).reshape(4, 4)
        np.testing.assert_allclose(T_marker_world @ T_world_last, T_marker_last, atol=1e-5)
        in_metres = mirror.map.in_metres(adjusted)
        at = mirror.map.keyframe_ids.tolist()
        np.testing.assert_allclose(in_metres.keyframe_poses[:, :3, 3], truth[at][:, :3, 3], atol=1.0)
    (told,) = summary["metres"]
    assert told["marker_id"] == NUMBER
    assert told["m_per_unit"] == adjusted.m_per_unit
    assert [part.to_dict() for part in read_run(tmp_path).metres] == [told]
    rows = read_rows(tmp_path / "frames.jsonl")
    assert [row.frame_id for row in rows if row.m_per_unit is not None] == [m.frame_id for m in metric_poses]
    assert told["m_per_unit"] == pytest.approx(rows[-1].m_per_unit, rel=0.05)


def test_without_a_marker_nothing_is_said_in_metres(tmp_path, air, metric_poses):
    running = air.serve(out=tmp_path)
    air.agent(100).stream(range(12))
    summary = running.finish(stop=True)
    assert summary["frames"]["posed"] > 6
    assert summary["metres"] is None
    assert not metric_poses
