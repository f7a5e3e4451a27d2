"""``semcast unpack``: a ROS bag as a recorded sequence."""

import argparse
import sys

from semcast.agent.unpack import Unpacked, UnpackSettings, unpack
from semcast.commands.console import passing_progress
from semcast.commands.running import add_settings, read_settings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_settings(parser, UnpackSettings)


def _in_words(found: Unpacked) -> str:
    camera = (
        "camera unknown" if found.camera is None else f"camera {found.camera.width}x{found.camera.height}"
    )
    left_out = f" ({found.num_left_out} left out)" if found.num_left_out else ""
    truth = "" if found.num_poses is None else f", {found.num_poses} true poses"
    return f"{found.num_images} images of {found.topic}{left_out}, {camera}{truth}"


def run(arguments: argparse.Namespace) -> int:
    """Write the sequence and name its folder on stdout."""
    settings = read_settings(UnpackSettings, arguments)
    with passing_progress() as progress:
        task = progress.add_task("images", total=None)
        found = unpack(settings, lambda taken, total: progress.update(task, completed=taken, total=total))
    print(_in_words(found), file=sys.stderr)
    print(settings.out)
    return 0
