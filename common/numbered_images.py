"""Which lines of a file belong to the images of a recording, which may be cut out of a longer one."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def numbers_in_names(images: Sequence[Path]) -> list[int]:
    """Return the numbers that images are named by; empty where any has another name."""
    names = [image.stem for image in images]
    return [int(name) for name in names] if all(n.isascii() and n.isdecimal() for n in names) else []


def lines_of_images(images: Sequence[Path], num_lines: int) -> NDArray[np.int64] | None:
    """Return the indices of the lines that belong to images, one for each.

    Args:
        images: In order.
        num_lines: Lines there are: as many as images, or those of the whole recording, whose images are
            numbered from 0.

    Returns:
        ``(N,)`` indices; None where there are not as many lines as images and the names don't number them.
    """
    if num_lines == len(images):
        return np.arange(num_lines, dtype=np.int64)
    numbers = numbers_in_names(images)
    if not numbers or len(set(numbers)) < len(images) or max(numbers) >= num_lines:
        return None
    return np.array(numbers, dtype=np.int64)
