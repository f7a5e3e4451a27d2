"""The example settings are ones the roles take, and the service files keep the roles running."""

import configparser
from pathlib import Path

import pytest

from semcast.agent.settings import AgentSettings
from semcast.channel.emulator_settings import EmulatorSettings
from semcast.common.config import build_settings, read_toml
from semcast.role import STOP_DEADLINE_S
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
