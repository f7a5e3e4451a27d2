"""``semcast channel``: run the simulated radio link, or change one that runs."""

import argparse
import json
import logging
from pathlib import Path

from semcast.channel.emulator import run_channel, set_channel, warn_of_settings
from semcast.channel.emulator_settings import EmulatorSettings
from semcast.channel.settings import ChannelSettings
from semcast.commands.running import add_settings, read_given, read_settings, run_until_stopped
from semcast.common.config import build_settings
from semcast.common.config_flags import given_values
from semcast.common.errors import ConfigError

logger = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "action",
        nargs="?",
        choices=("run", "set"),
        default="run",
        help="run (default) starts the link; set changes the given values of the one that runs",
    )
    add_settings(parser, EmulatorSettings)


def run(arguments: argparse.Namespace) -> int:
    """Run the link until stopped, or send the given values to the running one."""
    if arguments.action == "set":
        return _set(arguments)
    settings = read_settings(EmulatorSettings, arguments)
    return run_until_stopped(lambda stop: run_channel(settings, stop))


def _set(arguments: argparse.Namespace) -> int:
    """Send what was given and nothing else: which values go together only the running channel knows."""
    given = read_given(EmulatorSettings, arguments)
    changes = given.pop("link", None)
    if not changes:
        raise ConfigError("set needs a value to change, such as --snr-db 4")
    if "seed" in given:
        logger.warning("seed: no effect on a channel that runs")
    settings = build_settings(EmulatorSettings, given)
    if "trace_file" in changes:  # the running channel has another working folder
        changes["trace_file"] = str(Path(changes["trace_file"]).absolute())
    try:
        in_force = set_channel(settings.network, settings.agent_id, changes)
    except ConfigError as err:
        typed = given_values(EmulatorSettings, arguments).get("link", {})
        if str(err).partition(" ")[0] not in changes.keys() - typed.keys():
            raise
        raise ConfigError(f"{arguments.config}: {err}") from err
    warn_of_settings(build_settings(ChannelSettings, in_force), changes)
    print(json.dumps(in_force, indent=1))
    return 0
