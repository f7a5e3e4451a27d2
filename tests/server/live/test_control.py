"""What other processes ask of a server."""

import os

import pytest
from waiting import until

from semcast.common.errors import SemcastError

pytestmark = pytest.mark.xdist_group("real-time")

DEADLINE_S = 60.0


def test_control_requests_reset_and_save(tmp_path, air, monkeypatch):
    monkeypatch.setattr("semcast.server.control.SERVE_WAIT_S", DEADLINE_S)
    running = air.serve(out=tmp_path)
    radio = air.agent(100)
    radio.stream(range(10))

    epoch = radio.poses[-1].map_epoch
    assert radio.ask("get").settings["mode"] == "live"
    assert not radio.ask("explode").ok
    assert radio.ask("save").ok
    until((tmp_path / "map.ply").exists)
    assert not (tmp_path / "summary.json").exists()
    assert radio.ask("reset").ok
    radio.stream(range(10, 14))
    assert radio.poses[-1].map_epoch == epoch + 1
    running.finish(stop=True)


def test_a_save_that_fails_is_answered_and_the_stream_goes_on(tmp_path, air, caplog, monkeypatch):
    monkeypatch.setattr("semcast.server.control.SERVE_WAIT_S", DEADLINE_S)
    (tmp_path / "map.ply").mkdir()
    running = air.serve(out=tmp_path)
    radio = air.agent(100)
    radio.stream([0, 1])
    reply = radio.ask("save")
    assert not reply.ok
    assert reply.error.startswith(f"outputs can't be written to {tmp_path}: ")
    assert "map.ply" in reply.error
    assert reply.error in caplog.text
    assert running.server.metrics.status(100).last_error == reply.error
    radio.stream([2, 3])
    with pytest.raises(SemcastError, match="map.ply"):
        running.finish(stop=True)


def test_a_save_that_fails_in_a_folder_whose_name_is_no_text_is_answered(tmp_path, air, monkeypatch):
    monkeypatch.setattr("semcast.server.control.SERVE_WAIT_S", DEADLINE_S)
    folder = tmp_path / os.fsdecode(b"out\xff")
    (folder / "map.ply").mkdir(parents=True)
    running = air.serve(out=folder)
    radio = air.agent(100)
    radio.stream([0, 1])
    reply = radio.ask("save")
    assert not reply.ok
    assert reply.error.startswith(f"outputs can't be written to {tmp_path}/out?: ")
    with pytest.raises(SemcastError, match="map.ply"):
        running.finish(stop=True)


def test_a_server_at_its_end_does_not_say_that_it_did_what_it_was_asked_for(air):
    running = air.serve()
    radio = air.agent(100)
    running.finish(stop=True)
    for op in ("save", "reset"):
        reply = radio.ask(op)
        assert not reply.ok
        assert reply.error == f"{op} can't be served: the server is at its end"
    assert radio.ask("get").ok
