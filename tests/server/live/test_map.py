"""The map over the network, for who comes late."""

import numpy as np
import pytest
from waiting import until

from semcast.common.map_mirror import MapMirror
from semcast.common.network_settings import NetworkSettings
from semcast.common.run_folder import read_run
from semcast.common.transport import open_client
from semcast.server.mapping.settings import ReconstructionSettings

pytestmark = pytest.mark.xdist_group("real-time")

AGENT = "cam0"
DEADLINE_S = 60.0


def test_who_comes_late_has_the_whole_map_and_follows_it(tmp_path, air, monkeypatch, read_ply):
    monkeypatch.setattr("semcast.server.control.SERVE_WAIT_S", DEADLINE_S)
    running = air.serve(out=tmp_path)
    radio = air.agent(100)
    with open_client(NetworkSettings(connect=(air.endpoint,)), DEADLINE_S) as client:
        early = MapMirror(client, AGENT, DEADLINE_S)
        assert len(early.map.ids) == 0
        radio.stream(range(12))
        with open_client(NetworkSettings(connect=(air.endpoint,)), DEADLINE_S) as other:
            late = MapMirror(other, AGENT, DEADLINE_S)
            then = late.map
            assert (then.agent_epoch, then.map_epoch) == (100, 0)
            assert len(then.ids) > 50
            assert len(then.keyframe_ids) > 1
            radio.stream(range(12, 20))
            assert radio.ask("save").ok
            marks = len(read_ply(tmp_path / "map.ply"))
            for mirror in (early, late):
                until(lambda m=mirror: len(m.map.ids) == marks, "the map as the server saved it")
            assert late.map.keyframe_ids[-1] > then.keyframe_ids[-1]
            for name in ("ids", "xyz", "rgb", "confidence", "keyframe_ids", "keyframe_poses"):
                assert np.array_equal(getattr(early.map, name), getattr(late.map, name)), name
    running.finish(stop=True)


def test_who_follows_the_map_has_it_as_it_was_adjusted_at_the_end(tmp_path, air):
    running = air.serve(out=tmp_path, reconstruction=ReconstructionSettings(window_size=3))
    radio = air.agent(100)
    with open_client(NetworkSettings(connect=(air.endpoint,)), DEADLINE_S) as client:
        mirror = MapMirror(client, AGENT, DEADLINE_S)
        radio.stream(range(20))
        assert radio.ask("save").ok
        before = read_run(tmp_path)
        running.finish(stop=True)
        after = read_run(tmp_path)
        of_keyframes = np.isin(after.frame_ids, after.keyframe_ids)
        assert np.array_equal(before.keyframe_ids, after.keyframe_ids)
        assert np.abs(after.T_world_cam - before.T_world_cam).max() > 1e-4
        written = after.T_world_cam[of_keyframes]
        until(
            lambda: np.allclose(mirror.map.keyframe_poses, written, rtol=0.0, atol=1e-5),
            "the keyframes where the results have them",
        )


def test_a_server_without_a_map_has_no_answer(air):
    running = air.serve()
    with open_client(NetworkSettings(connect=(air.endpoint,)), DEADLINE_S) as client:
        assert len(MapMirror(client, AGENT, DEADLINE_S).map.ids) == 0
    running.finish(stop=True)


def test_a_map_of_many_hours_is_sent_and_one_that_cannot_be_ends_no_stream(air, monkeypatch, caplog):
    monkeypatch.setattr("semcast.server.control.SERVE_WAIT_S", DEADLINE_S)
    running = air.serve()
    radio = air.agent(100)
    radio.stream(range(8))
    world = running.server._sessions.current._reconstruction.world
    for frame_id in range(100, 100 + 70_000):  # thinned out since
        world.poses[frame_id], world.submap_of[frame_id] = np.eye(4), 0
    with open_client(NetworkSettings(connect=(air.endpoint,)), DEADLINE_S) as client:
        assert len(MapMirror(client, AGENT, DEADLINE_S).map.keyframe_ids) > 70_000
        world.poses[100] = np.full((4, 4), np.nan)
        assert len(MapMirror(client, AGENT, DEADLINE_S).map.keyframe_ids) == 0
    assert "map can't be served: map.keyframe_poses must be finite" in caplog.text
    del world.poses[100]
    radio.stream([8])
    running.finish(stop=True)
