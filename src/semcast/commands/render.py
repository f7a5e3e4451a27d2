"""``semcast render``: a drawn scene as a recorded sequence with its exact path."""

import argparse
import sys

from semcast.commands.console import passing_progress
from semcast.commands.running import add_settings, read_settings
from semcast.evaluation.scenes.render import RenderSettings, render_scene


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_settings(parser, RenderSettings)


def run(arguments: argparse.Namespace) -> int:
    """Draw the frames and name the folder on stdout."""
    settings = read_settings(RenderSettings, arguments)
    with passing_progress() as bar:
        task = bar.add_task("drawing", total=None)
        num_frames = render_scene(settings, lambda done, total: bar.update(task, completed=done, total=total))
    print(f"{num_frames} frames", file=sys.stderr)
    print(settings.out)
    return 0
