"""Decoded images side by side, each under its name (Fig. 6 of the paper)."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.errors import SemcastError
from semcast.common.whole_file import write_whole

_CELL_WIDTH_PX = 384
_LABEL_HEIGHT_PX = 26
_LABEL_MARGIN_PX = 4
_GAP_PX = 4
#: More cells side by side are too small to be judged on a page.
_MAX_COLUMNS = 4
_FONT = cv2.FONT_HERSHEY_SIMPLEX
#: That of a label which fits; of longer ones less.
_FONT_SIZE = 0.5


def _cell(image: NDArray[np.uint8], label: str) -> NDArray[np.uint8]:
    height = max(1, round(image.shape[0] * _CELL_WIDTH_PX / image.shape[1]))
    scaled = cv2.resize(image, (_CELL_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    cell = np.full((height + _LABEL_HEIGHT_PX, _CELL_WIDTH_PX, 3), 255, dtype=np.uint8)
    cell[_LABEL_HEIGHT_PX:] = scaled
    (width, _), _ = cv2.getTextSize(label, _FONT, _FONT_SIZE, 1)
    size = _FONT_SIZE * min(1.0, (_CELL_WIDTH_PX - 2 * _LABEL_MARGIN_PX) / max(width, 1))
    at = (_LABEL_MARGIN_PX, _LABEL_HEIGHT_PX - 8)
    cv2.putText(cell, label, at, _FONT, size, (0, 0, 0), 1, cv2.LINE_AA)
    return cell


def picture_strip(rows: Sequence[Mapping[str, NDArray[np.uint8]]]) -> NDArray[np.uint8]:
    """Lay out images in rows of equal cells, four at most side by side; a longer row goes on below.

    Args:
        rows: Per row, label to ``(H, W, 3)`` uint8 RGB image; all images of a row have one shape.

    Returns:
        ``(H, W, 3)`` uint8 RGB.

    Raises:
        ValueError: There is no image.
    """
    if not rows or not all(rows):
        raise ValueError("a picture strip needs at least one image in each row")
    gap = _GAP_PX
    lines = []
    for row in rows:
        cells = [_cell(image, label) for label, image in row.items()]
        lines += [cells[k : k + _MAX_COLUMNS] for k in range(0, len(cells), _MAX_COLUMNS)]
    columns = max(len(line) for line in lines)
    height = sum(line[0].shape[0] + gap for line in lines) - gap
    strip = np.full((height, columns * (_CELL_WIDTH_PX + gap) - gap, 3), 255, dtype=np.uint8)
    top = 0
    for line in lines:
        for k, cell in enumerate(line):
            left = k * (_CELL_WIDTH_PX + gap)
            strip[top : top + cell.shape[0], left : left + _CELL_WIDTH_PX] = cell
        top += line[0].shape[0] + gap
    return strip


def write_picture_strip(path: Path, rows: Sequence[Mapping[str, NDArray[np.uint8]]]) -> None:
    """Save ``picture_strip(rows)`` as PNG or JPEG.

    Raises:
        ValueError: See ``picture_strip``.
        SemcastError: The file can't be written.
    """
    write_picture(path, picture_strip(rows))


def write_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """Save a picture as PNG or JPEG, as its name says, making the folder; it is whole or as it was.

    Args:
        path: ``.png`` or ``.jpg``.
        picture: ``(H, W, 3)`` uint8 RGB.

    Raises:
        SemcastError: The file can't be written.
    """
    picture_bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        done, data = cv2.imencode(path.suffix, picture_bgr)
        if not done:
            raise SemcastError(f"{path} can't be written as a picture")
        write_whole(path, data.tobytes())
    except (OSError, cv2.error) as err:
        raise SemcastError(f"{path} can't be written as a picture: {err}") from err
