"""What the doctor says of this machine, and of a system that runs."""

import contextlib
import importlib.metadata
import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
from running_channel import running_channel

from semcast.cli import main
from semcast.commands.doctor import check_packages, check_processor, check_system, check_viewer
from semcast.common.loopback import open_hub
from semcast.common.metrics import Metrics
from semcast.common.status_beat import StatusBeat


@pytest.fixture
def channel():
    """The endpoint of a running channel."""
    with running_channel() as endpoint:
        yield endpoint


def test_doctor_says_what_runs_an_agent_without_torch(monkeypatch):
    def missing(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", missing)
    texts = {finding.what: finding.text for finding in check_packages()}
    assert "extra 'edge'" in texts["onnxruntime"]
    assert "without onnxruntime" in texts["torch"]


def test_doctor_looks_for_the_viewer_that_a_server_starts(monkeypatch, tmp_path):
    (tmp_path / "rerun").touch(mode=0o755)
    monkeypatch.setenv("PATH", str(tmp_path))  # another program of that name, which no server starts
    found = next(check_viewer())
    assert (found.verdict, Path(found.text).parent.name) == ("good", "rerun_cli")
    known = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if "_cli" in name else known(name))
    found = next(check_viewer())
    assert found.verdict == "note"
    assert found.text.startswith("--view native and web can't start: no Rerun viewer is installed")


@pytest.mark.weights
def test_doctor_loads_what_an_agent_without_torch_sends_with():
    code = """
import sys
sys.modules["torch"] = None
from semcast.commands.doctor import check_weights
print([finding.verdict for finding in check_weights() if finding.what == "codec 3dcsc-lite"])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "['good']\n", done.stderr


@pytest.mark.parametrize("words", [["--zenoh-config", "nowhere"], ["--require", "server"]])
def test_doctor_does_not_pass_over_what_is_of_no_system(words, capsys):
    assert main(["doctor", *words]) == 1
    assert f"{words[0]} is of the system that --connect names" in capsys.readouterr().err


def test_doctor_tells_by_its_exit_code_whether_required_roles_are_alive(capsys, monkeypatch):
    monkeypatch.setattr("semcast.commands.doctor.check_weights", pytest.fail)
    hub, endpoint = open_hub()
    with hub:
        hub.declare_alive("cam0", "server")
        words = ["doctor", "--connect", endpoint, "--agent-id", "cam0", "--require"]
        assert main([*words, "server"]) == 0
        assert capsys.readouterr().out == "alive (cam0): server\n"
        assert main([*words, "server,agent,channel"]) == 1
        assert capsys.readouterr().out == (
            "agent (cam0) is not seen: start it with 'semcast agent --agent-id cam0'\n"
            "channel (cam0) is not seen: start it with 'semcast channel --agent-id cam0'\n"
        )
        with pytest.raises(SystemExit):
            main([*words, "server,camera"])
        assert "must be some of agent,channel,server, got 'server,camera'" in capsys.readouterr().err


@pytest.fixture
def quick_beats(monkeypatch):
    """Let roles tell ten times a second of themselves, and be waited for as much shorter."""
    monkeypatch.setattr("semcast.common.status_beat.STATUS_INTERVAL_S", 0.1)


def test_doctor_names_the_agents_that_go_by_another_name(quick_beats):
    hub, endpoint = open_hub()
    with hub:
        hub.declare_alive("cam1", "agent")
        *roles, others = check_system(endpoint, "agent0")
        assert [finding.text for finding in roles] == [
            f"not seen: start it with 'semcast {role}'" for role in ("agent", "channel", "server")
        ]
        assert (others.what, others.verdict) == ("other agents", "note")
        assert others.text == "cam1: --agent-id says which of them is meant"
        hub.declare_alive("agent0", "agent")
        assert [finding.what for finding in check_system(endpoint, "cam1")][-1] == "other agents"
        for role in ("agent", "channel", "server"):
            hub.declare_alive("cam0", role)
        assert len(list(check_system(endpoint, "cam0"))) == 3, "who finds all roles asked for the right one"


def test_doctor_tells_what_a_running_system_says_of_itself(quick_beats):
    hub, endpoint = open_hub()
    metrics = Metrics("agent")
    for _ in range(40):
        metrics.count("sent")
    metrics.drop("thinned", 3)
    with hub, contextlib.closing(StatusBeat(hub, "cam0", "agent", metrics, lambda: 1)):
        for role in ("agent", "channel"):
            hub.declare_alive("cam0", role)
        agent, channel, server = check_system(endpoint, "cam0")
        assert agent.verdict == "good"
        words = r"alive for \d+ s, \d+\.\d frames a second, 40 frames sent; dropped: 3 thinned"
        assert re.fullmatch(words, agent.text)
        assert channel.verdict == "note"
        assert channel.text.startswith("alive, but says nothing of itself")
        assert "start it with 'semcast server --agent-id cam0'" in server.text
        metrics.be_at("waiting")
        metrics.error("the disk is full")
        agent = next(check_system(endpoint, "cam0"))
        assert agent.verdict == "note"
        assert agent.text.endswith("; is at: waiting; last error: the disk is full")
    (finding,) = check_system("nowhere", "cam0")
    assert finding.verdict == "bad"
    assert finding.text.startswith("connect must be an endpoint")


@pytest.mark.parametrize(
    ("is_fast", "has_int8", "verdict", "text"),
    [
        (True, True, "good", "in hardware"),
        (False, True, "note", "not in hardware: int8"),
        (False, False, "note", "not in hardware: float32"),
    ],
)
def test_the_doctor_tells_what_the_networks_run_in(monkeypatch, is_fast, has_int8, verdict, text):
    monkeypatch.setattr("semcast.common.nets.precision.has_fast_bfloat16", lambda: is_fast)
    monkeypatch.setattr("semcast.common.nets.int8.has_int8", lambda: has_int8)
    found = {finding.what: finding for finding in check_processor()}["bfloat16"]
    assert found.verdict == verdict
    assert found.text.startswith(text)


def test_the_doctor_says_nothing_of_bfloat16_where_nothing_uses_it(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert [finding.what for finding in check_processor()] == ["cores"]
