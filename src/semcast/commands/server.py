"""``semcast server``: decode, track, map and show what an agent sends."""

import argparse

from semcast.commands.running import add_settings, read_given, read_settings, run_until_stopped
from semcast.common.codecs import warn_of_modulation
from semcast.server.server import run_server
from semcast.server.settings import ServerSettings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_settings(parser, ServerSettings)


def run(arguments: argparse.Namespace) -> int:
    """Serve until the source ends or the process is stopped; outputs are always written."""
    settings = read_settings(ServerSettings, arguments)
    warn_of_modulation(settings.codec or (), read_given(ServerSettings, arguments))
    if settings.device == "cuda" or settings.precision not in ("auto", "float32"):
        # Without --codec the decoder is loaded when the first frame arrives: too late to say this.
        from semcast.common.nets.codec import torch_device
        from semcast.common.nets.precision import dtype_for

        dtype_for(settings.precision, torch_device(settings.device), can_be_int8=True)
    return run_until_stopped(lambda stop: run_server(settings, stop))
