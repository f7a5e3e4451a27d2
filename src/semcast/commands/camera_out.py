"""What verbs share that find something out about a camera: its file, and checks before the work begins."""

import argparse
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from semcast.agent.source import is_live
from semcast.commands.paths import named_path
from semcast.commands.running import add_settings, read_settings
from semcast.common.camera import Intrinsics
from semcast.common.errors import ConfigError, SemcastError
from semcast.common.whole_file import check_writable
from semcast.evaluation.moving_images import ImagesSettings


def add_images(parser: argparse.ArgumentParser, found: str) -> None:
    """Declare which images, and ``--out`` for the camera with what was ``found``."""
    add_settings(parser, ImagesSettings)
    parser.add_argument(
        "--out",
        type=named_path,
        metavar="FILE",
        help=f"intrinsics.json to write: the camera with {found}; may be the file it was read from",
    )


def images_of(arguments: argparse.Namespace) -> ImagesSettings:
    """Return which images, after checks.

    Raises:
        ConfigError: A file is to be written that can't be.
    """
    settings = read_settings(ImagesSettings, arguments)
    _check_file(arguments.out, "out")
    _check_file(settings.json, "json")
    if is_live(settings.source):
        print(f"taking {settings.frames} images: move the camera, and turn it to and fro", file=sys.stderr)
    return settings


@contextmanager
def quiet_reconstruction(debug: bool) -> Iterator[None]:
    """Keep to itself what reconstructions say while a camera is looked for, unless for debugging."""
    server = logging.getLogger("semcast.server")
    before = server.level
    if not debug:
        server.setLevel(logging.ERROR)
    try:
        yield
    finally:
        server.setLevel(before)


def _check_file(path: Path | None, name: str) -> None:
    if path is None:
        return
    if path.suffix.lower() != ".json":
        raise ConfigError(f"{name} must be a .json file, got {path}")
    check_writable(path, name)


def write_camera(camera: Intrinsics, path: Path | None) -> None:
    """Write a camera and say where, if it is wanted.

    Raises:
        SemcastError: It can't be written.
    """
    if path is None:
        return
    try:
        camera.save(path)
    except OSError as err:
        raise SemcastError(f"{path} can't be written: {err}") from err
    print(path)
