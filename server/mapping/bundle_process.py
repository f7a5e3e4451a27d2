"""Bundle adjustment in a process of its own: no frame waits for it, nor for the lock that GTSAM holds."""

from collections.abc import Callable

from semcast.common.errors import tell_nobody
from semcast.server.mapping.bundle_problem import BundleProblem, BundleResult
from semcast.server.worker import MAX_FAILURES, Worker

_WHAT = "the bundle adjustment process"
GIVEN_UP = f"{_WHAT} failed {MAX_FAILURES} times in a row: the map is no longer adjusted"


def _adjust(problem: BundleProblem) -> BundleResult:
    from semcast.server.mapping.bundle import optimise

    return optimise(problem)


class ProcessBundle(Worker[BundleProblem, BundleResult]):
    """Adjusts in a child process; scripts take ``InlineBundle``, see ``Worker``.

    Args:
        lossless: ``take`` always waits for the result, so the same input gives the same map; otherwise it
            returns at once and the result is applied when it is ready.
        on_give_up: Is told why, once, when the child dies so often that it is not started again.
    """

    def __init__(self, *, lossless: bool = False, on_give_up: Callable[[str], None] = tell_nobody) -> None:
        super().__init__(
            _adjust, name="bundle", what=_WHAT, given_up=GIVEN_UP, lossless=lossless, on_give_up=on_give_up
        )
