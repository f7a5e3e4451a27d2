"""Where depth maps are estimated: in a process behind all others, or in the caller's thread."""

from collections.abc import Callable

import cv2

from semcast.common.errors import tell_nobody
from semcast.server.dense.depth_map import DepthMap, DepthProblem, estimate_depth
from semcast.server.worker import MAX_FAILURES, Inline, Worker

#: A busy machine leaves a hundredth of its time.
_DEADLINE_S = 120.0
_WHAT = "the process that estimates dense depth"
GIVEN_UP = f"{_WHAT} failed {MAX_FAILURES} times in a row: the dense cloud no longer grows"


def _estimate(problem: DepthProblem) -> DepthMap:
    cv2.setNumThreads(1)
    return estimate_depth(problem)


class InlineDepth(Inline[DepthProblem, DepthMap]):
    """Estimates depth maps in the caller's thread."""

    def __init__(self) -> None:
        super().__init__(estimate_depth)


class ProcessDepth(Worker[DepthProblem, DepthMap]):
    """Estimates depth maps in a child process, see ``Worker``.

    Args:
        lossless: ``take`` always waits for the result, so the same input gives the same cloud.
        on_give_up: Is told why, once, when the child dies so often that it is not started again.
    """

    def __init__(self, *, lossless: bool = False, on_give_up: Callable[[str], None] = tell_nobody) -> None:
        super().__init__(
            _estimate,
            name="depth",
            what=_WHAT,
            given_up=GIVEN_UP,
            lossless=lossless,
            on_give_up=on_give_up,
            stands_back=True,  # poses come first: depth has what time they leave
            start_early=False,
            deadline_s=_DEADLINE_S,
        )
