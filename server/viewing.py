"""Whether a run is shown, where, and under which name; Rerun is imported only when something is shown."""

import logging
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from semcast.common.errors import ConfigError, tell_nobody
from semcast.common.former_file import keep_former
from semcast.common.run_folder import VIEWER_NAME
from semcast.server.dense.cloud import DensePatch
from semcast.server.mapping.state import MapUpdate
from semcast.server.reference import Reference
from semcast.server.settings import ServerSettings
from semcast.server.stream_identity import StreamIdentity
from semcast.server.view.frame_view import FrameView

if TYPE_CHECKING:
    from semcast.server.view.feed import ViewerFeed
    from semcast.server.view.process import ViewerProcess

logger = logging.getLogger(__name__)

#: A footer of the file costs memory with every frame: longer streams, and those without end, get none.
MAX_FRAMES_WITH_FOOTER = 3000


def check_viewer(settings: ServerSettings) -> None:
    """Check early that what is asked for can be shown.

    Raises:
        ConfigError: ``file`` without an output folder, no viewer is installed, or another program has the
            port of its page.
    """
    if settings.view.view != "none":
        from semcast.server.view.feed import check_view

        check_view(settings.view, has_folder=settings.out is not None)
    if settings.view.view == "web":
        from semcast.server.view.process import is_listening

        # A viewer that listens already serves the page, too.
        if not is_listening(settings.view.port) and is_listening(settings.view.web_port):
            raise ConfigError(
                f"the viewer's page can't be served on port {settings.view.web_port}, where another program "
                "listens: choose another port with --web-port"
            )


def open_viewer(
    settings: ServerSettings,
    identity: StreamIdentity,
    reference: Reference | None,
    *,
    resumed: bool = False,
    process: "ViewerProcess | None" = None,
    on_error: Callable[[str], None] = tell_nobody,
) -> "ViewerFeed | None":
    """Open what the settings ask for; None where nothing is shown.

    Args:
        settings: ``view`` and ``out``.
        identity: Of the stream; names the viewer's recording.
        reference: Whose true path is shown, or None.
        resumed: Keep the ``run.rrd`` that is there under another name.
        process: The viewer that showed the stream before this one, or None.
        on_error: Is told in a line, once, why the run goes on without ``run.rrd``.

    Raises:
        ConfigError: The viewer can't be started or ``run.rrd`` can't be written.
    """
    file = settings.out / VIEWER_NAME if settings.out is not None else None
    if not _is_shown(settings):
        return None
    from semcast.server.view.feed import ViewerFeed

    if file is not None and resumed:
        keep_former(file)
    viewer = ViewerFeed(
        settings.view,
        identity.camera,
        f"{identity.agent_id}-{identity.agent_epoch}",
        truth=reference.truth if reference is not None else None,
        truth_times_ns=reference.times_ns if reference is not None else None,
        file=file,
        footer=identity.num_frames is not None and identity.num_frames <= MAX_FRAMES_WITH_FOOTER,
        process=process,
        on_error=on_error,
    )
    if viewer.url is not None:
        logger.info("viewer: %s", viewer.url)
    return viewer


class SuccessiveViews:
    """What is shown of one stream after the other, each in a recording and file of its own, in one viewer.

    Args:
        settings: ``view`` and ``out``.
        on_error: See ``open_viewer``.
    """

    def __init__(self, settings: ServerSettings, on_error: Callable[[str], None]) -> None:
        self._settings = settings
        self._on_error = on_error
        self._feed: ViewerFeed | None = None
        self._process: ViewerProcess | None = None

    @property
    def is_shown(self) -> bool:
        """Whether the present stream is."""
        return self._feed is not None

    def begin_stream(self, identity: StreamIdentity, reference: Reference | None, *, resumed: bool) -> None:
        """Show a stream, after ``end_stream`` of the one before.

        Args:
            identity: Of the stream.
            reference: Whose true path is shown, or None.
            resumed: Keep the ``run.rrd`` that is there under another name.

        Raises:
            ConfigError: The viewer can't be started or ``run.rrd`` can't be written.
        """
        process = self._process
        self._feed = open_viewer(
            self._settings,
            identity,
            reference,
            resumed=resumed,
            process=process,
            on_error=self._on_error,
        )
        self._process = None

    def submit(
        self,
        view: FrameView | None,
        update: MapUpdate | None = None,
        patches: Sequence[DensePatch] = (),
        *,
        new_map: bool = False,
    ) -> None:
        """Show a frame or what changed in the map, as ``ViewerFeed.submit`` does, where anything is shown."""
        if self._feed is not None:
            self._feed.submit(view, update, patches, new_map=new_map)

    def end_stream(self) -> None:
        """Finish recording and file of the present stream; the viewer waits for the next one."""
        feed, self._feed = self._feed, None
        if feed is not None:
            self._process = feed.hand_over()

    def close(self, *, leave_window: bool) -> None:
        """End what is shown and the viewer, unless its window is to be left open. Idempotent."""
        feed, self._feed = self._feed, None
        if feed is not None:
            feed.close(leave_window=leave_window)
        process, self._process = self._process, None
        if process is not None:
            process.close()


def _is_shown(settings: ServerSettings) -> bool:
    if settings.view.view == "none":
        return False
    from semcast.server.view.feed import resolve_view

    return resolve_view(settings.view.view, has_folder=settings.out is not None) != "none"
