"""``semcast shutter``: how long a rolling shutter takes, from images of the camera alone."""

import argparse
import logging
import sys
from pathlib import Path

from semcast.agent.source import is_camera_number
from semcast.commands.paths import named_path
from semcast.commands.running import add_settings, read_settings
from semcast.common.errors import ConfigError, SemcastError
from semcast.common.whole_file import check_writable
from semcast.evaluation.readout import ReadoutEstimate, ReadoutSettings, Trial, find_readout


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_settings(parser, ReadoutSettings)
    parser.add_argument(
        "--out",
        type=named_path,
        metavar="FILE",
        help="intrinsics.json to write: the camera with the readout found; may be the file it was read from",
    )


def _check_file(path: Path | None, name: str) -> None:
    if path is None:
        return
    if path.suffix.lower() != ".json":
        raise ConfigError(f"{name} must be a .json file, got {path}")
    check_writable(path, name)


def _show(trial: Trial) -> None:
    error = f", reprojection error {trial.mean_px:.3f} px" if trial.num_frames else ""
    what = f"{trial.readout!s:>20}: {trial.num_frames} frames with a pose{error}"
    print(what, file=sys.stderr, flush=True)


def _answer(found: ReadoutEstimate) -> str:
    """Return the result in words."""
    low_ms, high_ms = sorted((found.low_ms, found.high_ms), key=abs)
    if found.is_global:
        return f"global shutter, or as good as one ({found.low_ms:.1f} to {found.high_ms:.1f} ms)"
    return (
        f"rolling shutter: {found.readout} ({abs(low_ms):.1f} to {abs(high_ms):.1f})\n"
        f"--readout-ms {found.camera.readout_ms:g} --readout-from {found.camera.readout_from}"
    )


def run(arguments: argparse.Namespace) -> int:
    """Try readout times, one line on stderr each; then print the one that fits, and write the camera."""
    settings = read_settings(ReadoutSettings, arguments)
    _check_file(arguments.out, "out")
    _check_file(settings.json, "json")
    if "://" in settings.source or is_camera_number(settings.source):
        print(f"taking {settings.frames} images: move the camera, and turn it to and fro", file=sys.stderr)
    if not arguments.debug:
        logging.getLogger("semcast.server").setLevel(logging.WARNING)
    found = find_readout(settings, _show)
    print(_answer(found))
    if arguments.out is not None:
        try:
            found.camera.save(arguments.out)
        except OSError as err:
            raise SemcastError(f"{arguments.out} can't be written: {err}") from err
        print(arguments.out)
    return 0
