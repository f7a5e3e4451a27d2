"""``semcast info``: what a recording, run, sequence, video, camera or weights file is."""

import argparse

from semcast.commands.paths import named_path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "path",
        type=named_path,
        metavar="PATH",
        help="recording (.mcap), folder that --out wrote, sequence folder or transforms.json, "
        "video, calibration, ROS bag, weights (.safetensors, .onnx) or the name of shipped weights",
    )


def run(arguments: argparse.Namespace) -> int:
    """Print what is there."""
    from rich.table import Table

    from semcast.commands.console import plain_console
    from semcast.describe import describe

    # Names of files may hold brackets, which are no markup.
    console = plain_console()
    for heading, lines in describe(arguments.path):
        if not lines:
            continue
        console.print(heading, style="bold", soft_wrap=True)
        table = Table.grid(padding=(0, 2))
        table.add_column(style="dim", no_wrap=True)
        table.add_column(overflow="fold")
        for name, value in lines:
            table.add_row(f"  {name}", value)
        console.print(table)
    return 0
