"""``semcast agent``: encode a camera or a recorded sequence and publish channel symbols."""

import argparse

from semcast.agent.agent import run_agent
from semcast.agent.settings import AgentSettings
from semcast.commands.running import add_settings, read_settings, run_until_stopped


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_settings(parser, AgentSettings)


def run(arguments: argparse.Namespace) -> int:
    """Send until the source ends or the process is stopped."""
    settings = read_settings(AgentSettings, arguments)
    return run_until_stopped(lambda stop: run_agent(settings, stop))
