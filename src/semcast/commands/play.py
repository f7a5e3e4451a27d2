"""``semcast play``: put a recorded stream back on the network, for live processes."""

import argparse

from semcast.agent.play import PlaySettings, run_play
from semcast.commands.running import add_settings, read_settings, run_until_stopped


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_settings(parser, PlaySettings)


def run(arguments: argparse.Namespace) -> int:
    """Play until the stream ends or the process is stopped."""
    settings = read_settings(PlaySettings, arguments)
    return run_until_stopped(lambda stop: run_play(settings, stop))
