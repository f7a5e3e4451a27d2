"""Whether a camera that went steadily jumped from one frame to the next, as poor poses make it seem.

In front of a bare wall a pose rests on a dozen corners, half of which are none. It is off by half a step
then, and the landmarks that are made by it hand a wrong unit of length on to all that comes after.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from semcast.server.geometry.whereabouts import Step

Array = NDArray[np.float64]

#: A step is a jump where it is further from the one before than so many times what is usual, and than this
#: share of a step. In front of bare walls, poses off by less were as good as others.
_TIMES_USUAL, _SHARE = 6.0, 0.4
#: Steps that tell what is usual.
_NUM_STEPS = 20
#: A step of more than so many times the usual interval can be any.
_INTERVALS = 1.5
#: A camera goes steadily where its steps add up to this share of their lengths: a hand that waves does not.
_STEADY_SHARE = 0.7


def is_jump(steps: Sequence[Step], elapsed_s: float, T_before_now: Array) -> bool:
    """Tell whether a camera that went steadily would hardly go on by this step.

    Args:
        steps: Its last ones, oldest first.
        elapsed_s: Time of the new one, more than 0.
        T_before_now: ``(4, 4)`` the new one.

    Returns:
        False also where too few are known, and where the camera did not go steadily.
    """
    if len(steps) < _NUM_STEPS:
        return False
    took_s = np.array([step_s for step_s, _, _ in steps[-_NUM_STEPS:]])
    ways = np.array([way for _, _, way in steps[-_NUM_STEPS:]])
    way, lengths = np.linalg.norm(ways.sum(axis=0)), np.linalg.norm(ways, axis=1)
    is_steady = way > _STEADY_SHARE * lengths.sum()  # which a camera at rest is not: it may set off
    if not is_steady or elapsed_s > _INTERVALS * np.median(took_s):
        return False
    went = np.array([T[:3, 3] for _, T, _ in steps[-_NUM_STEPS:]])
    usual = np.median(np.linalg.norm(went[1:] - went[:-1] * (took_s[1:] / took_s[:-1])[:, None], axis=1))
    off = np.linalg.norm(T_before_now[:3, 3] - went[-1] * elapsed_s / took_s[-1])
    return bool(off > max(_TIMES_USUAL * usual, _SHARE * lengths.mean()))
