"""Feeds viewers beside the tracker, which only drops its results into a queue and waits for no viewer.

Two threads: one brings what is in the queue into the scene and writes the ``.rrd`` file, one serves the live
viewer. A live viewer may be missing, frozen, killed or late: the second thread waits for it and then sends
the whole scene anew.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import ConfigError, tell_nobody
from semcast.common.trajectory import Trajectory
from semcast.common.worker_guard import WorkerGuard
from semcast.server.dense.cloud import DensePatch
from semcast.server.mapping.state import MapUpdate
from semcast.server.view.file_stream import FileStream
from semcast.server.view.frame_view import FrameView
from semcast.server.view.live_stream import LiveStream
from semcast.server.view.picture import compress_picture
from semcast.server.view.process import ViewerProcess, is_listening, rerun_binary, window_display
from semcast.server.view.rerun_viewer import RerunStream
from semcast.server.view.scene import Changes, Cursor, Scene
from semcast.server.view.settings import ViewSettings

logger = logging.getLogger(__name__)

#: What waits for the scene's thread beyond it is brought into the scene by who submits.
MAX_PENDING = 4096
PROBE_INTERVAL_S = 0.25
SUPERVISE_INTERVAL_S = 0.2
ALIGN_INTERVAL_S = 1.0
JOIN_DEADLINE_S = 5.0


def resolve_view(view: str, *, has_folder: bool) -> str:
    """Turn ``auto`` into ``native`` where a window can open, else ``file`` or ``none``; others stay."""
    if view != "auto":
        return view
    return "native" if window_display() else "file" if has_folder else "none"


def check_view(settings: ViewSettings, *, has_folder: bool) -> None:
    """Check early that what is asked for can be shown.

    Raises:
        ConfigError: ``file`` without an output folder, ``native`` without a display, or no viewer at all.
    """
    view = resolve_view(settings.view, has_folder=has_folder)
    if view == "file" and not has_folder:
        raise ConfigError("view file needs an output folder: give --out DIR")
    if view in ("native", "web"):
        rerun_binary()
    # A viewer that listens already may have its window on another machine, behind a tunnel.
    if view == "native" and window_display() is None and not is_listening(settings.port):
        raise ConfigError("no display: use --view web or --view file")


class _Pending(NamedTuple):
    """What was submitted at once."""

    view: FrameView | None
    update: MapUpdate | None
    patches: tuple[DensePatch, ...]
    new_map: bool


def _apply(scene: Scene, item: _Pending) -> None:
    """Bring what was submitted into the scene."""
    if item.new_map:
        scene.start_new_map()
    if item.update is not None:
        scene.update(item.update)
    scene.set_patches(item.patches)
    if item.view is not None:
        scene.add_frame(item.view)


class ViewerFeed:
    """Shows a run in Rerun: live, as a file, or both.

    Args:
        settings: What to show where.
        camera: Intrinsics of the decoded images.
        recording_id: Names the run; a restarted server that uses the same one continues in the same viewer.
        truth: True path, or None.
        truth_times_ns: See ``Scene``.
        file: Where the recording goes, or None for no file.
        footer: Whether that ends with an index, see ``RerunStream``.
        process: The viewer to look after, perhaps handed over; None makes one as ``settings.view`` says.
        on_error: Is told in a line, once, why the run goes on without the file.

    Raises:
        ConfigError: A viewer can't be started, or ``--view file`` has no file or can't write it.
    """

    def __init__(
        self,
        settings: ViewSettings,
        camera: Intrinsics,
        recording_id: str,
        *,
        truth: Trajectory | None = None,
        truth_times_ns: NDArray[np.int64] | None = None,
        file: Path | None = None,
        footer: bool = True,
        process: ViewerProcess | None = None,
        on_error: Callable[[str], None] = tell_nobody,
    ) -> None:
        self._settings = settings
        self._camera = camera
        self._recording_id = recording_id
        self._has_truth = truth is not None
        self._footer = footer
        self._scene = Scene(truth, truth_times_ns)
        self._scene_lock = threading.Lock()
        #: Taken from only with the scene locked, so that all comes into it in order.
        self._pending: deque[_Pending] = deque()
        self._newest: FrameView | None = None
        self._queue_lock = threading.Lock()
        self._work = threading.Event()
        self._live_work = threading.Event()
        self._stopping = threading.Event()
        self._drained = threading.Event()
        self._keeps_viewer = False
        self._last_picture_s = -1e9
        self._last_align_s = -1e9
        self._scene_guard = WorkerGuard("bringing an update into the scene")
        if process is None:
            check_view(settings, has_folder=file is not None)
        view = resolve_view(settings.view, has_folder=file is not None)
        self._file = self._open_file(file, on_error) if file is not None else None
        self._process = process
        if process is None and view in ("native", "web"):
            kind: Literal["native", "web"] = "web" if view == "web" else "native"
            self._process = ViewerProcess(kind, settings.port, settings.web_port, settings.memory_limit)
        self._live: LiveStream | None = None
        self._threads = [threading.Thread(target=self._run_scene, name="semcast-scene", daemon=True)]
        if self._process is not None:
            self._start_viewer(self._process)
            self._live = LiveStream(lambda: self._open_stream(None), self.changes_since, settings.port)
            self._threads.append(threading.Thread(target=self._run_live, name="semcast-viewer", daemon=True))
        for thread in self._threads:
            thread.start()

    @property
    def num_connections(self) -> int:
        """Live viewers that were connected to."""
        return self._live.num_connections if self._live is not None else 0

    @property
    def url(self) -> str | None:
        """Where the live viewer is, None without one."""
        return self._process.url if self._process is not None else None

    def changes_since(self, cursor: Cursor) -> Changes:
        """Return what a viewer has not seen of what is in the scene by now, and move its cursor on."""
        with self._scene_lock:
            return self._scene.changes_since(cursor)

    def submit(
        self,
        view: FrameView | None,
        update: MapUpdate | None = None,
        patches: Sequence[DensePatch] = (),
        *,
        new_map: bool = False,
    ) -> None:
        """Show a frame and what changed in the map before it. Never waits for a viewer or the disk.

        Of images waiting to be shown only the newest is kept; poses, plot values and map changes all are.
        Where more than ``MAX_PENDING`` wait, each call brings the oldest into the scene itself.

        Args:
            view: The processed frame; None when the map alone has changed.
            update: Map changes up to and including this frame.
            patches: The same of the dense cloud.
            new_map: The map was started anew just before this frame.
        """
        with self._queue_lock:
            light = None if view is None else view.without_image()
            self._pending.append(_Pending(light, update, tuple(patches), new_map))
            if view is not None and view.image is not None:
                self._newest = view
            is_behind = len(self._pending) > MAX_PENDING
        self._work.set()
        if is_behind:
            with self._scene_lock:
                self._take(1)

    def _take(self, most: int | None = None) -> int:
        """Bring what waits into the scene, the oldest first; the scene is locked. Return how much it was."""
        with self._queue_lock:
            count = len(self._pending) if most is None else min(most, len(self._pending))
            items = [self._pending.popleft() for _ in range(count)]
        for item in items:
            with self._scene_guard:
                _apply(self._scene, item)
        return count

    def _open_stream(self, file: Path | None) -> RerunStream:
        return RerunStream(
            recording_id=self._recording_id,
            camera=self._camera,
            has_truth=self._has_truth,
            has_confidence=True,
            file=file,
            footer=self._footer,
            port=self._settings.port,
        )

    def _open_file(self, file: Path, on_error: Callable[[str], None]) -> FileStream:
        try:
            return FileStream(self._open_stream(file), file, self.changes_since, on_error)
        except RuntimeError as err:
            raise ConfigError(f"{file} can't be written: {err}") from err

    def _start_viewer(self, process: ViewerProcess) -> None:
        try:
            process.start()
        except ConfigError:
            process.close()
            if self._file is not None:
                self._file.close()
            raise

    def _run_scene(self) -> None:
        """Own the scene: take what was submitted, compress images, write the file."""
        guard = WorkerGuard("writing what is shown")
        while True:
            self._work.wait(0.2)
            self._work.clear()
            last_round = self._stopping.is_set()
            with guard:
                self._take_pending(last_round)
                if self._file is not None:
                    self._file.write()
            self._live_work.set()
            if last_round:
                self._drained.set()
                return

    def _take_pending(self, force: bool) -> None:
        """Apply what was submitted; ``force`` shows the last image even when it is early."""
        with self._queue_lock:
            newest = self._newest
            now = time.monotonic()
            if newest is not None and not force and now - self._last_picture_s < self._image_interval_s:
                newest = None
            elif newest is not None:
                self._newest = None
        picture = None
        if newest is not None and newest.image is not None:
            self._last_picture_s = now
            picture = compress_picture(newest, self._settings.jpeg_quality)
        with self._scene_lock:
            num_taken = self._take()
            if picture is not None:
                self._scene.set_picture(picture)
            if self._has_truth and num_taken and (force or now - self._last_align_s > ALIGN_INTERVAL_S):
                self._last_align_s = now
                self._scene.align_truth()

    @property
    def _image_interval_s(self) -> float:
        return 1.0 / self._settings.image_rate_hz

    def _run_live(self) -> None:
        """Look after the live viewer, and serve it."""
        live, process = self._live, self._process
        assert live is not None
        assert process is not None
        looking_after = WorkerGuard("looking after the viewer")
        # Who is connected to anew gets all that the failed round may have kept back.
        showing = WorkerGuard("showing the run", lambda text: live.let_go())
        last_supervised_s = -1e9
        while True:
            last_round = self._drained.is_set()
            if time.monotonic() - last_supervised_s > SUPERVISE_INTERVAL_S:
                last_supervised_s = time.monotonic()
                with looking_after:
                    self._supervise()
            with showing:
                live.serve(may_connect=not last_round)
            if last_round:
                break
            self._live_work.wait(self._image_interval_s if live.is_connected else PROBE_INTERVAL_S)
            self._live_work.clear()
        if live.is_stalled and not self._keeps_viewer:
            process.close()
        live.close()

    def _supervise(self) -> None:
        assert self._process is not None
        try:
            self._process.supervise()
        except ConfigError as err:
            logger.warning("%s", err)

    def hand_over(self) -> ViewerProcess | None:
        """Write what is pending and finish the file, but leave the viewer to the feed of another run.

        Returns:
            The viewer as it is, perhaps closed by the user; None where nothing was shown live.
        """
        self._keeps_viewer = True
        self._end()
        return self._process

    def close(self, *, leave_window: bool = False) -> None:
        """Write what is pending, finish the file and end the viewer. Idempotent.

        Args:
            leave_window: Leave a native window open so that the result can be looked at.
        """
        if self._stopping.is_set():
            return
        self._end()
        if self._process is not None:
            if leave_window and self._process.kind == "native":
                self._process.release()
            self._process.close()

    def _end(self) -> None:
        """End both threads and finish the file."""
        self._stopping.set()
        self._work.set()
        for thread in self._threads:
            thread.join(JOIN_DEADLINE_S)
        if self._file is not None:
            self._file.close()
