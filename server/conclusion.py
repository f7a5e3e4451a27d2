"""What is left to do when a stream has ended: the last adjustment and missing depth, perhaps for minutes."""

import logging
import time
from collections.abc import Callable, Sequence

from semcast.server.dense.cloud import DensePatch
from semcast.server.mapping.state import MapUpdate
from semcast.server.session import Session

logger = logging.getLogger(__name__)

#: Keyframes whose adjustment, or depth, takes so long that the log says what is going on,
_MANY = 10
#: and again after so long.
_LOG_INTERVAL_S = 10.0


def conclude(
    session: Session,
    show: Callable[[MapUpdate | None, Sequence[DensePatch]], None],
    tell: Callable[[str], None],
    depth_budget_s: float | None = None,
    gives_way: Callable[[], bool] = lambda: False,
    is_stopped: Callable[[], bool] = lambda: False,
) -> None:
    """Adjust the whole map of a stream that has ended, and complete its dense cloud.

    Args:
        session: Of the stream.
        show: Takes what changed in the map and in the cloud, as it does.
        tell: Takes what is going on in a few words, before each step.
        depth_budget_s: Depth that is still missing by then is left out; None waits for all.
        gives_way: Tells, after each depth, that the rest is left for later.
        is_stopped: Tells, after each depth, that the rest is left out.
    """
    if num_keyframes := session.num_to_adjust:
        tell(f"last adjustment of {num_keyframes} keyframes")
    if num_keyframes > _MANY:
        logger.info("last adjustment of %d keyframes", num_keyframes)
    if (update := session.conclude()) is not None:
        show(update, ())
    num_waiting = session.num_without_depth
    if num_waiting:
        tell(f"depth 0 of {num_waiting} keyframes")
    if num_waiting > _MANY:
        logger.info("the depth of %d keyframes is estimated now", num_waiting)
    logged_s = time.monotonic()
    comes_later = False
    for patches in session.complete_cloud(depth_budget_s):
        if patches:
            show(None, patches)
        how_far = f"depth {num_waiting - session.num_without_depth} of {num_waiting} keyframes"
        tell(how_far)
        if time.monotonic() - logged_s > _LOG_INTERVAL_S:
            logged_s = time.monotonic()
            logger.info("%s", how_far)
        comes_later = gives_way()
        if comes_later or is_stopped():
            break
    if not comes_later and (num_left := session.num_without_depth):
        logger.info("no time was left for the depth of %d keyframes: dense.ply is without them", num_left)
    tell("writing results")
