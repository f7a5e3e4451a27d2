"""``semcast recover``: make a recording that was cut off whole again."""

import argparse

from semcast.commands.paths import named_path
from semcast.common.recording_writer import recover_file


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("file", type=named_path, metavar="FILE", help="recording that was cut off or damaged")
    parser.add_argument(
        "--out", type=named_path, metavar="PATH", help="where to write it; without it FILE is replaced"
    )


def run(arguments: argparse.Namespace) -> int:
    """Copy every whole message and say what was there."""
    out = arguments.out or arguments.file
    info = recover_file(arguments.file, out)
    faults = [] if info.complete else ["cut off"]
    if count := info.num_damaged_chunks:
        faults.append(f"damaged: {count} chunk{'s' * (count > 1)} left out")
    print(f"{out}: {info.counts.total()} messages; {arguments.file} was {' and '.join(faults) or 'whole'}")
    return 0
