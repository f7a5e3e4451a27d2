"""Where bundle adjustment runs: in a process of its own, or in the caller's thread."""

from collections.abc import Callable

from semcast.common.errors import tell_nobody
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.bundle_problem import BundleRunner
from semcast.server.mapping.bundle_process import ProcessBundle
from semcast.server.settings import ServerSettings


def new_bundle(settings: ServerSettings, on_give_up: Callable[[str], None] = tell_nobody) -> BundleRunner:
    """Return a runner of bundle adjustments as the settings want it.

    Args:
        settings: Of the server.
        on_give_up: Is told why, when nothing will be adjusted any more.
    """
    if settings.bundle == "inline":
        return InlineBundle()
    return ProcessBundle(lossless=settings.mode == "replay", on_give_up=on_give_up)
