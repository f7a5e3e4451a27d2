"""Files and folders named on the command line, where they are no settings."""

import argparse
from pathlib import Path


def named_path(text: str) -> Path:
    """Take a path for argparse; ``Path("")``, as of an empty variable, would be the working folder.

    Raises:
        argparse.ArgumentTypeError: The text is empty, or holds a NUL.
    """
    if text == "" or "\0" in text:
        raise argparse.ArgumentTypeError(f"must be the name of a file or folder, got {text!r}")
    return Path(text)


def add_run_folder(parser: argparse.ArgumentParser) -> None:
    """Declare ``run``, the folder of a finished run."""
    parser.add_argument(
        "run", type=named_path, metavar="RUN", help="folder that --out of demo, server or replay wrote"
    )
