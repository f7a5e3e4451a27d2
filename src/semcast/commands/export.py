"""``semcast export``: a run in the format of another tool."""

import argparse
import re
import sys

from semcast.commands.paths import named_path

#: Kept here so that ``--help`` loads neither numpy nor OpenCV; a test holds it equal to the server's list.
FORMATS = ("tum", "kitti", "ply", "colmap", "nerfstudio", "rrd")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "run", type=named_path, metavar="RUN", help="folder that --out of demo, server or replay wrote"
    )
    parser.add_argument(
        "--format",
        choices=FORMATS,
        required=True,
        help="tum, kitti: poses; ply: points; colmap, nerfstudio: a folder with poses, points and images; "
        "rrd: for the Rerun viewer",
    )
    parser.add_argument(
        "--part",
        type=_part,
        default="all",
        metavar="N|largest|all",
        help="part of the map; 'semcast info RUN' lists them where there are several (default: all)",
    )
    parser.add_argument(
        "--out", type=named_path, required=True, metavar="PATH", help="file or folder to write"
    )


def _part(word: str) -> str:
    if not re.fullmatch(r"[0-9]+|largest|all", word):
        raise argparse.ArgumentTypeError(f"must be a number, largest or all, got {word!r}")
    return word


def run(arguments: argparse.Namespace) -> int:
    """Write the export and name its files on stdout."""
    from semcast.common.errors import ConfigError
    from semcast.common.run_folder import read_run
    from semcast.server.export.formats import export_run
    from semcast.server.export.parts import select_part

    if arguments.out.resolve() == arguments.run.resolve():
        raise ConfigError(f"--out must be another place than the run itself, got {arguments.out}")
    files = export_run(arguments.run, arguments.format, arguments.out, arguments.part)
    data = select_part(read_run(arguments.run), arguments.part)
    print(
        f"{len(data.frame_ids)} posed frames, {len(data.keyframe_ids)} keyframes, "
        f"{len(data.landmark_ids)} landmarks",
        file=sys.stderr,
    )
    for file in files:
        print(file)
    return 0
