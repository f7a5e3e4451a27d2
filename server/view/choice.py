"""Whether a run is shown, where, and under which name; Rerun is imported only when something is shown."""

import logging
from typing import TYPE_CHECKING

from semcast.common.former_file import keep_former
from semcast.common.run_folder import VIEWER_NAME
from semcast.common.trajectory import Trajectory
from semcast.server.session import StreamIdentity
from semcast.server.settings import ServerSettings

if TYPE_CHECKING:
    from semcast.server.view.feed import ViewerFeed

logger = logging.getLogger(__name__)


def check_viewer(settings: ServerSettings) -> None:
    """Check early that what is asked for can be shown.

    Raises:
        ConfigError: ``file`` without an output folder, or no viewer is installed.
    """
    if settings.view.view != "none":
        from semcast.server.view.feed import check_view

        check_view(settings.view, has_folder=settings.out is not None)


def open_viewer(
    settings: ServerSettings, identity: StreamIdentity, truth: Trajectory | None, *, resumed: bool = False
) -> "ViewerFeed | None":
    """Open what the settings ask for; None where nothing is shown.

    Args:
        settings: ``view`` and ``out``.
        identity: Of the stream; names the viewer's recording.
        truth: True path, or None.
        resumed: Keep the ``run.rrd`` that is there under another name.
    """
    file = settings.out / VIEWER_NAME if settings.out is not None else None
    if not _is_shown(settings):
        return None
    from semcast.server.view.feed import ViewerFeed

    if file is not None and resumed:
        keep_former(file)
    viewer = ViewerFeed(
        settings.view, identity.camera, f"{identity.agent_id}-{identity.agent_epoch}", truth=truth, file=file
    )
    if viewer.url is not None:
        logger.info("viewer: %s", viewer.url)
    return viewer


def _is_shown(settings: ServerSettings) -> bool:
    if settings.view.view == "none":
        return False
    from semcast.server.view.feed import resolve_view

    return resolve_view(settings.view.view, has_folder=settings.out is not None) != "none"
