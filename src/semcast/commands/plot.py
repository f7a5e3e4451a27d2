"""``semcast plot``: pictures of a finished run."""

import argparse
import logging
import sys
from pathlib import Path

from semcast.commands.paths import add_run_folder, named_path

logger = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_run_folder(parser)
    parser.add_argument(
        "--truth",
        type=named_path,
        metavar="PATH",
        help="true path: a TUM file or a sequence folder; by default the sequence the run was compared with",
    )
    parser.add_argument(
        "--format", choices=("png", "svg"), default="png", help="of the pictures (default png)"
    )
    parser.add_argument(
        "--out", type=named_path, metavar="DIR", help="folder for the pictures; by default RUN/plots"
    )


def run(arguments: argparse.Namespace) -> int:
    """Draw the pictures and name their files on stdout."""
    from semcast.common.run_folder import FRAMES_NAME
    from semcast.common.run_summary import read_summary
    from semcast.common.sequence import open_truth, read_known_path, retimed
    from semcast.evaluation.run_plots import RunToPlot, plot_run
    from semcast.server.frame_rows import read_rows

    folder: Path = arguments.run
    truth = None
    if arguments.truth is not None:
        truth = read_known_path(arguments.truth)
    else:
        settings = read_summary(folder).get("settings")
        reference = settings.get("reference") if isinstance(settings, dict) else None
        if isinstance(reference, str) and reference and Path(reference).exists():
            truth, times_ns = open_truth(Path(reference))
            if truth is not None:
                rows = read_rows(folder / FRAMES_NAME)
                truth = retimed(truth, times_ns, {row.frame_id: row.t_source_ns for row in rows})
        elif reference:
            logger.warning("the sequence %s is gone: no true path is drawn; give it by --truth", reference)
    files = plot_run(RunToPlot.read(folder, truth), arguments.out or folder / "plots", arguments.format)
    if truth is None:
        print("no true path is known; give one by --truth", file=sys.stderr)
    for file in files:
        print(file)
    return 0
