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
#: share of a step. At a corridor's bare corner, 3.5 and 0.3 refuse one more pose, and paths are no better.
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
        steps: Its last ones, oldest first, map units.
        elapsed_s: Seconds that the new one took, more than 0.
        T_before_now: ``(4, 4)`` the new one, from the camera's frame now to that before.

    Returns:
        False also where too few are known, and where the camera did not go steadily.
    """
    if len(steps) < _NUM_STEPS:
        return False
    took_s, moves, ways = zip(*steps[-_NUM_STEPS:], strict=True)
    way, lengths = np.linalg.norm(np.sum(ways, axis=0)), np.linalg.norm(ways, axis=1)
    is_steady = way > _STEADY_SHARE * lengths.sum()  # which a camera at rest is not: it may set off
    if not is_steady or elapsed_s > _INTERVALS * np.median(took_s):
        return False
    times_s = np.array([*took_s, elapsed_s])
    went = np.array([T[:3, 3] for T in (*moves, T_before_now)])
    off = np.linalg.norm(went[1:] - went[:-1] * (times_s[1:] / times_s[:-1])[:, None], axis=1)
    return bool(off[-1] > max(_TIMES_USUAL * np.median(off[:-1]), _SHARE * lengths.mean()))
