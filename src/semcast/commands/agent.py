"""``semcast agent``: encode a camera or a recorded sequence and publish channel symbols."""

import argparse
from dataclasses import replace

from semcast.agent.agent import run_agent
from semcast.agent.settings import AgentSettings
from semcast.commands.running import add_settings, read_given, read_settings, run_until_stopped
from semcast.common.codecs import codec_of_weights, warn_of_modulation


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_settings(parser, AgentSettings)


def settings_of(arguments: argparse.Namespace) -> AgentSettings:
    """Return the settings that were given; weights decide on the codec unless one was asked for as well.

    Raises:
        SemcastError: A setting is wrong, or the weights can't be read.
    """
    settings = read_settings(AgentSettings, arguments)
    if settings.weights is None or "codec" in read_given(AgentSettings, arguments):
        return settings
    return replace(settings, codec=codec_of_weights(settings.weights, settings.runtime))


def run(arguments: argparse.Namespace) -> int:
    """Send until the source ends or the process is stopped."""
    settings = settings_of(arguments)
    warn_of_modulation(settings.codec, read_given(AgentSettings, arguments))
    return run_until_stopped(lambda stop: run_agent(settings, stop))
