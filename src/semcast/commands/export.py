"""``semcast export``: a run in the format of another tool."""

import argparse
import re
import sys
from typing import TYPE_CHECKING

from semcast.commands.paths import add_run_folder, named_path

if TYPE_CHECKING:
    from semcast.server.export.formats import FindPlacement

#: Kept here so that ``--help`` loads neither numpy nor OpenCV; a test holds it equal to the server's list.
FORMATS = ("tum", "kitti", "ply", "dense", "colmap", "nerfstudio", "rrd")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_run_folder(parser)
    parser.add_argument(
        "--format",
        choices=FORMATS,
        required=True,
        help="tum, kitti: poses; ply: points; dense: those of the dense cloud; colmap, nerfstudio: a folder "
        "with poses, points and images; rrd: for the Rerun viewer",
    )
    parser.add_argument(
        "--part",
        type=_part,
        default="all",
        metavar="N|largest|all",
        help="part of the map; 'semcast info RUN' lists them where there are several (default: all)",
    )
    place = parser.add_mutually_exclusive_group()
    place.add_argument(
        "--align",
        type=named_path,
        metavar="PATH",
        help="export in the frame and unit of this known path of the camera: a TUM file on the same clock, "
        "or a sequence with a true path",
    )
    place.add_argument(
        "--metres",
        action="store_true",
        help="export in metres and in the frame of the marker, as the run itself found them (--marker-m of "
        "server or replay)",
    )
    place.add_argument(
        "--marker-m",
        type=float,
        metavar="SIDE",
        help="export in metres and in the frame of a printed square marker that the kept images show, whose "
        "black square has this side in metres: origin in its middle, x right, y up, z out of it",
    )
    parser.add_argument(
        "--marker-dictionary",
        metavar="NAME",
        help="the marker's family, as OpenCV names them: 4x4_50, aruco_original ... (default apriltag_36h11)",
    )
    parser.add_argument(
        "--marker-id",
        type=int,
        metavar="N",
        help="number of the marker; by default of those that tell the scale the one in most images",
    )
    parser.add_argument(
        "--out", type=named_path, required=True, metavar="PATH", help="file or folder to write"
    )


def _part(word: str) -> str:
    if not re.fullmatch(r"[0-9]+|largest|all", word):
        raise argparse.ArgumentTypeError(f"must be a number, largest or all, got {word!r}")
    return word


def _placement(arguments: argparse.Namespace) -> "FindPlacement | None":
    """Return what finds the frame to export in, None for the map's own."""
    from semcast.common.errors import ConfigError
    from semcast.server.export.placement import place_by_path, place_by_run

    if arguments.marker_m is None:
        for option in ("marker_dictionary", "marker_id"):
            if getattr(arguments, option) is not None:
                raise ConfigError(f"--{option.replace('_', '-')} needs --marker-m")
    if arguments.metres:
        return lambda data, _: place_by_run(data)
    if arguments.align is not None:
        from semcast.common.sequence import read_known_path

        known = read_known_path(arguments.align)
        return lambda data, _: place_by_path(data, known)
    if arguments.marker_m is not None:
        from semcast.server.export.markers import place_by_marker
        from semcast.server.marker_settings import DEFAULT_DICTIONARY

        dictionary = arguments.marker_dictionary or DEFAULT_DICTIONARY
        return lambda data, images: place_by_marker(
            data, images, arguments.marker_m, dictionary, arguments.marker_id
        )
    return None


def run(arguments: argparse.Namespace) -> int:
    """Write the export and name its files on stdout."""
    from semcast.server.export.formats import export_run

    files, data = export_run(
        arguments.run, arguments.format, arguments.out, arguments.part, _placement(arguments)
    )
    print(
        f"{len(data.frame_ids)} posed frames, {len(data.keyframe_ids)} keyframes, "
        f"{len(data.landmark_ids)} landmarks",
        file=sys.stderr,
    )
    for file in files:
        print(file)
    return 0
