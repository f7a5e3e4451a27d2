"""``semcast channel``: run the simulated radio link, or change one that runs."""

import argparse
import json
from dataclasses import fields

from semcast.channel.emulator import run_channel, set_channel
from semcast.channel.emulator_settings import EmulatorSettings
from semcast.channel.settings import ChannelSettings
from semcast.commands.running import add_settings, read_settings, run_until_stopped
from semcast.common.errors import ConfigError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "action",
        nargs="?",
        choices=("run", "set"),
        default="run",
        help="run (default) starts the link; set changes the given values of the one that runs",
    )
    add_settings(parser, EmulatorSettings, skip=frozenset({"network.agent_id"}))


def run(arguments: argparse.Namespace) -> int:
    """Run the link until stopped, or send the given values to the running one."""
    settings = read_settings(EmulatorSettings, arguments)
    if arguments.action == "run":
        return run_until_stopped(lambda stop: run_channel(settings, stop))
    names = [f.name for f in fields(ChannelSettings) if f"link.{f.name}" in vars(arguments)]
    if not names:
        raise ConfigError("set needs a value to change, such as --snr-db 4")
    changes = {name: getattr(settings.link, name) for name in names}
    print(json.dumps(set_channel(settings.network, settings.agent_id, changes), indent=1))
    return 0
