"""The derivative of what is known at a few moments only."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def slope_weights(times_s: Array) -> Array:
    """Return the weights of values at some moments whose weighted sum is the derivative at time 0, ``(N,)``.

    It is that of the polynomial of degree N - 1 through the values.

    Args:
        times_s: ``(N,)``, all different.

    Example:
        >>> slope_weights(np.array([-0.5, 0.0, 0.5]))
        array([-1.,  0.,  1.])
    """
    unit_s = np.abs(times_s).max()
    powers = np.vander(times_s / unit_s, increasing=True).T
    return np.asarray(np.linalg.solve(powers, np.eye(len(times_s))[1]) / unit_s)
