"""A model with pictures takes the place of an earlier one in its folder, of which no picture stays."""

import contextlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from semcast.server.export.colmap import IMAGES_HEADER
from semcast.server.export.nerfstudio import POINTS_NAME

#: Format -> the file that names the pictures of a model; it comes last.
MODEL_LISTS = {"colmap": Path("sparse/0/images.txt"), "nerfstudio": Path("transforms.json")}
_IMAGES = "images"
#: In the folder while it is being filled.
_PART = ".part"


@contextlib.contextmanager
def replacing_model(out: Path, format_name: str) -> Iterator[Path]:
    """Yield an empty folder to write a model to, which is in ``out`` once the block has ended without error.

    Pictures that only the earlier model of the same format shows are then gone. Up to there everything in
    ``out`` stays as it was.

    Args:
        out: It is made where it is not there. A model of this format in it is one of ``exported_formats``.
        format_name: ``colmap`` or ``nerfstudio``.

    Raises:
        OSError: ``out`` can't be written.
    """
    is_new = not out.exists()
    part = out / _PART
    try:
        shutil.rmtree(part, ignore_errors=True)  # of one that was killed
        part.mkdir(parents=True)
        yield part
        former = _pictures(out, format_name)
        files = [path for path in sorted(part.rglob("*")) if path.is_file()]
        for path in sorted(files, key=lambda path: path.relative_to(part) == MODEL_LISTS[format_name]):
            place = out / path.relative_to(part)
            place.parent.mkdir(parents=True, exist_ok=True)
            os.replace(path, place)
        # A model of COLMAP's may name pictures that its run has not kept.
        stay = {path.name for path in files}.union(
            *(_pictures(out, f) for f in MODEL_LISTS if f != format_name)
        )
        for name in former - stay:
            (out / _IMAGES / name).unlink(missing_ok=True)
    finally:
        shutil.rmtree(part, ignore_errors=True)
        if is_new:
            with contextlib.suppress(OSError):  # there is something in it now
                out.rmdir()


def exported_formats(folder: Path) -> set[str]:
    """Return the formats of which a folder has a model that semcast exported, not another program."""
    return {format_name for format_name in MODEL_LISTS if _is_exported(folder, format_name)}


def _is_exported(folder: Path, format_name: str) -> bool:
    try:
        text = (folder / MODEL_LISTS[format_name]).read_text(encoding="utf-8")
        if format_name == "colmap":
            return text.startswith(IMAGES_HEADER)
        return bool(json.loads(text)["ply_file_path"] == POINTS_NAME)
    except (OSError, ValueError, LookupError, TypeError):
        return False


def _pictures(folder: Path, format_name: str) -> set[str]:
    """Return the names in ``images/`` itself that a model in a folder shows; none where it can't be read."""
    try:
        text = (folder / MODEL_LISTS[format_name]).read_text(encoding="utf-8")
        if format_name == "colmap":
            # Two lines each, of which the second one may be empty.
            lines = [line for line in text.splitlines() if not line.startswith("#")]
            names = {line.split()[-1] for line in lines[::2]}
            return {name for name in names if PurePosixPath(name).name == name}
        paths = [PurePosixPath(frame["file_path"]) for frame in json.loads(text)["frames"]]
    except (OSError, ValueError, LookupError, TypeError):
        return set()
    return {path.name for path in paths if path.parent == PurePosixPath(_IMAGES)}
