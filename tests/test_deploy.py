"""The example settings are ones the roles take."""

from pathlib import Path

import pytest

from semcast.agent.settings import AgentSettings
from semcast.channel.emulator_settings import EmulatorSettings
from semcast.common.config import build_settings, read_toml
from semcast.server.settings import ServerSettings

CONFIG = Path(__file__).resolve().parents[1] / "deploy" / "config"


@pytest.mark.parametrize(
    ("name", "cls"), [("agent", AgentSettings), ("channel", EmulatorSettings), ("server", ServerSettings)]
)
def test_the_example_settings_of_each_role_are_valid(name, cls):
    settings = build_settings(cls, read_toml(CONFIG / f"{name}.toml"))
    assert settings != (None if cls is AgentSettings else cls())
