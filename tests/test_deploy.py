"""The example settings are ones the roles take, and the service files keep the roles running."""

import configparser
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from semcast.agent.settings import AgentSettings
from semcast.channel.emulator_settings import EmulatorSettings
from semcast.common.config import build_settings, read_toml
from semcast.common.role import STOP_DEADLINE_S
from semcast.server.settings import ServerSettings

DEPLOY = Path(__file__).resolve().parents[1] / "deploy"
CONFIG = DEPLOY / "config"


@pytest.mark.parametrize(
    ("name", "cls"), [("agent", AgentSettings), ("channel", EmulatorSettings), ("server", ServerSettings)]
)
def test_the_example_settings_of_each_role_are_valid(name, cls):
    settings = build_settings(cls, read_toml(CONFIG / f"{name}.toml"))
    assert settings != (None if cls is AgentSettings else cls())


def test_a_service_is_tried_again_for_ever_and_has_time_to_write_its_results():
    unit = configparser.ConfigParser(interpolation=None)
    unit.optionxform = str
    unit.read(DEPLOY / "systemd" / "semcast@.service")
    assert unit["Service"]["Restart"] == "always"
    # By default five starts in ten seconds, a second apart, are the last ones.
    assert unit["Unit"]["StartLimitIntervalSec"] == "0"
    assert float(unit["Service"]["TimeoutStopSec"]) >= STOP_DEADLINE_S
    # A signal to every process of the service would end those that adjust and write.
    assert unit["Service"]["KillMode"] == "mixed"
    # A copy of the file under another name is of another camera.
    assert unit["Service"]["ExecStart"].endswith("--config /etc/%p/%i.toml")
    assert unit["Service"]["StateDirectory"] == "%p-%i"


@pytest.mark.skipif(shutil.which("setsid") is None, reason="the viewer runs in a group of its own")
def test_a_screenshot_is_taken_with_the_python_that_was_named(tmp_path):
    def tool(name, text):
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
        return str(tmp_path / name)

    out = tmp_path / "picture.png"
    # Asked for a port it gives one, asked whether the viewer answers it says yes.
    python = tool("mine", f'echo 1; case "$1" in *photograph_page.py) echo "$@" >{out};; esac')
    tool("python3", "exit 1")
    env = {
        **os.environ,
        "PATH": f"{tmp_path}:{os.environ['PATH']}",
        "PYTHON": python,
        "RERUN": tool("rerun", "exec sleep 9"),
    }
    command = [str(DEPLOY / "screenshot.sh"), "web", "run.rrd", str(out)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stderr) == (0, "")
    assert "photograph_page.py http://127.0.0.1:1/" in out.read_text()
