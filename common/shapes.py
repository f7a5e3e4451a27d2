"""One-line shape checks for public doors."""

from typing import Protocol


class _HasShape(Protocol):
    @property
    def shape(self) -> tuple[int, ...]: ...


def check_shape(x: _HasShape, pattern: str, name: str) -> dict[str, int]:
    """Check the shape of an array or tensor against a pattern and return its named sizes.

    Args:
        x: Anything with a ``shape``.
        pattern: Blank-separated axes: an integer is a fixed size, a word binds a size (the same word
            must bind the same size twice).
        name: What to call ``x`` in the message.

    Returns:
        The size bound to each word.

    Raises:
        ValueError: The shape does not match; the message names both.

    Example:
        >>> import numpy as np
        >>> check_shape(np.zeros((2, 3, 8, 8)), "B 3 H W", "x")
        {'B': 2, 'H': 8, 'W': 8}
    """
    shape, axes = tuple(x.shape), pattern.split()
    sizes: dict[str, int] = {}
    if len(shape) != len(axes) or any(
        size != (int(axis) if axis.isdigit() else sizes.setdefault(axis, size))
        for size, axis in zip(shape, axes, strict=True)
    ):
        raise ValueError(f"{name} must have shape ({pattern}), got {shape}")
    return sizes
