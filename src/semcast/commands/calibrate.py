"""``semcast calibrate``: a camera's intrinsics from a chessboard, in pictures, a video or live."""

import argparse
import itertools
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from semcast.commands.console import passing_progress
from semcast.commands.paths import named_path
from semcast.common.errors import ConfigError, SemcastError, SourceError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from semcast.agent.calibrate import BoardView

#: A live view is tried every this many frames: finding the board takes longer than a frame.
LIVE_STRIDE = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "images",
        type=named_path,
        nargs="*",
        metavar="PATH",
        help="pictures of the board, folders of them, or a video",
    )
    parser.add_argument("--camera", metavar="N|DEVICE|URL", help="take views from this live camera instead")
    parser.add_argument(
        "--board",
        default="9x6",
        metavar="CxR",
        help="inner corners of the chessboard, columns x rows: one less than its squares (default 9x6)",
    )
    parser.add_argument(
        "--distortion",
        choices=("radtan5", "radtan4", "none", "equidistant"),
        default="radtan5",
        help="lens model: k1 k2 p1 p2 k3, without k3, none, or k1 k2 k3 k4 of a fisheye (default radtan5)",
    )
    parser.add_argument(
        "--views",
        type=int,
        default=20,
        metavar="N",
        help="views to take from a video or a live camera (default 20)",
    )
    parser.add_argument(
        "--out",
        type=named_path,
        default=Path("intrinsics.json"),
        metavar="FILE",
        help="result (default intrinsics.json)",
    )
    parser.add_argument(
        "--picture",
        type=named_path,
        metavar="FILE",
        help="picture to judge the result by (default beside --out)",
    )


def parse_board(text: str) -> tuple[int, int]:
    """Read ``9x6``.

    Raises:
        ConfigError: It is not two numbers of at least 3.
    """
    columns, _, rows = text.lower().partition("x")
    try:
        board = (int(columns), int(rows))
    except ValueError as err:
        raise ConfigError(f"board must look like 9x6, got {text!r}") from err
    if min(board) < 3:
        raise ConfigError(f"board must have at least 3 inner corners a side, got {text!r}")
    return board


def image_files(paths: list[Path]) -> list[Path]:
    """Return the pictures among files and folders.

    Raises:
        SourceError: A path does not exist, or there is no picture.
    """
    from semcast.common.layouts.files import images_in

    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            files += images_in(path)
        elif path.is_file():
            files.append(path)
        else:
            raise SourceError(f"{path} does not exist")
    if not files:
        raise SourceError("there is no picture; give pictures of a chessboard, a folder of them, or --camera")
    return files


def read_pictures(files: list[Path]) -> Iterator[tuple[str, "NDArray[np.uint8]"]]:
    """Yield name and RGB image of each file, turned as a sequence of them would be; all must have one size.

    Raises:
        SourceError: A file is no picture, or sizes differ.
    """
    from semcast.common.image_file import read_image

    size = None
    for file in files:
        image = read_image(file)
        if size is not None and image.shape[:2] != size:
            raise SourceError(
                f"{file} is {image.shape[1]}x{image.shape[0]}, the ones before are {size[1]}x{size[0]}: "
                "all pictures must come from one camera held one way"
            )
        size = image.shape[:2]
        yield file.name, image


def is_video(path: Path) -> bool:
    """Tell whether a file is to be read as a video: one that is not named as a picture."""
    from semcast.common.layouts.files import IMAGE_SUFFIXES

    return path.is_file() and path.suffix.lower() not in IMAGE_SUFFIXES


def camera_pictures(camera: str) -> Iterator[tuple[str, "NDArray[np.uint8]"]]:
    """Yield every few frames of a live camera, or of a video, until it ends.

    Raises:
        SourceError: The camera can't be opened or stops.
    """
    import cv2
    import numpy as np

    from semcast.agent.source import is_camera_number, is_live
    from semcast.agent.video import open_capture, public_name

    capture = open_capture(camera, live=is_live(camera) or is_camera_number(camera))
    try:
        for number in range(sys.maxsize):
            if not capture.grab():
                if number == 0:
                    raise SourceError(f"camera {public_name(camera)} gives no picture")
                return
            if number % LIVE_STRIDE == 0:
                good, bgr = capture.retrieve()
                if good:
                    yield f"frame {number}", np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)
    finally:
        capture.release()


def are_squares(board: tuple[int, int], files: list[Path]) -> bool:
    """Tell whether squares were counted instead of inner corners, by the first few pictures."""
    from semcast.agent.calibrate import find_board

    corners = (board[0] - 1, board[1] - 1)
    first = itertools.islice(read_pictures(files), 3)
    return min(corners) >= 3 and any(find_board(image, corners) is not None for _, image in first)


def _collect(
    arguments: argparse.Namespace, board: tuple[int, int]
) -> tuple[list["BoardView"], "NDArray[np.uint8]"]:
    from semcast.agent.calibrate import BoardView, find_board, is_new_view

    views: list[BoardView] = []
    sample = None
    num_seen = 0
    with passing_progress() as progress:
        if arguments.camera is not None:
            total, pictures = arguments.views, camera_pictures(arguments.camera)
            what = "show the board from all sides, tilted too (Ctrl-C: enough)"
        else:
            files = image_files(arguments.images)
            total, pictures = len(files), read_pictures(files)
            what = "looking for the board"
        task = progress.add_task(what, total=total)
        try:
            for name, image in pictures:
                num_seen += 1
                corners_xy = find_board(image, board)
                live = arguments.camera is not None
                if corners_xy is not None and (not live or is_new_view(corners_xy, views, image.shape[1])):
                    views.append(BoardView(name, corners_xy))
                    sample = image
                elif not live:
                    progress.console.print(f"no {board[0]}x{board[1]} board found in {name}")
                progress.update(task, completed=len(views) if live else num_seen)
                if live and len(views) >= arguments.views:
                    break
        except KeyboardInterrupt:
            if arguments.camera is None:
                raise
    if sample is None:
        why = "show all of it with a white border, and count inner corners: 10x7 squares are --board 9x6"
        if arguments.camera is None and are_squares(board, files):
            why = f"these are its squares, give --board {board[0] - 1}x{board[1] - 1}"
        raise SourceError(
            f"no board with {board[0]}x{board[1]} inner corners was found in {num_seen} pictures: {why}"
        )
    return views, sample


def _check_outputs(out: Path, picture: Path) -> None:
    from semcast.common.layouts.files import IMAGE_SUFFIXES
    from semcast.common.whole_file import check_writable

    if out.suffix.lower() != ".json":
        raise ConfigError(f"out must be a .json file, got {out}")
    if picture.suffix.lower() not in IMAGE_SUFFIXES:
        raise ConfigError(f"picture must be an image file ({', '.join(IMAGE_SUFFIXES)}), got {picture}")
    check_writable(out, "out")
    check_writable(picture, "picture")


def run(arguments: argparse.Namespace) -> int:
    """Calibrate, write intrinsics and picture, and print the result."""
    board = parse_board(arguments.board)
    if (arguments.camera is None) == (not arguments.images):
        raise ConfigError("give either pictures of a chessboard or --camera")
    if len(arguments.images) == 1 and is_video(arguments.images[0]):
        arguments.camera = str(arguments.images[0])
    if arguments.views < 4:
        raise ConfigError(f"views must be at least 4, got {arguments.views}")
    picture = arguments.picture or arguments.out.with_suffix(".png")
    _check_outputs(arguments.out, picture)
    from semcast.agent.calibrate import calibrate, calibration_picture
    from semcast.evaluation.picture_strip import write_picture

    views, sample = _collect(arguments, board)
    result = calibrate(views, board, (sample.shape[1], sample.shape[0]), arguments.distortion)
    try:
        result.intrinsics.save(arguments.out)
    except OSError as err:
        raise SemcastError(f"{arguments.out} can't be written: {err}") from err
    write_picture(picture, calibration_picture(result, sample))
    c, deviation = result.intrinsics, result.deviations
    print(f"{c.width}x{c.height}, {len(result.views)} views, reprojection error {result.rms_px:.3f} px rms")
    print(f"fx {c.fx:.2f} +- {deviation[0]:.2f} px, fy {c.fy:.2f} +- {deviation[1]:.2f} px")
    print(f"cx {c.cx:.2f} +- {deviation[2]:.2f} px, cy {c.cy:.2f} +- {deviation[3]:.2f} px")
    what = "equidistant distortion " if c.distortion_model == "equidistant" else "distortion "
    print(what + (" ".join(f"{k:.5f}" for k in c.distortion) or "none"))
    print(f"{arguments.out}\n{picture}")
    for name in result.rejected:
        print(f"left out: {name} fits far worse than the other views", file=sys.stderr)
    for warning in result.warnings():
        print(f"doubtful: {warning}", file=sys.stderr)
    return 0
