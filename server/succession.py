"""The sessions of a server, one after another: each begins where the one before has ended and is written."""

import functools
import logging
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from semcast.common.errors import ConfigError, SemcastError, SourceError
from semcast.common.messages import CameraInfo
from semcast.common.metrics import Metrics
from semcast.common.sequence import open_sequence
from semcast.server.bundle_runner import new_bundle
from semcast.server.conclusion import conclude
from semcast.server.dense.cloud import DensePatch
from semcast.server.former_run import free_folder
from semcast.server.former_starts import FormerStarts
from semcast.server.mapping.bundle_problem import BundleRunner
from semcast.server.mapping.state import MapUpdate
from semcast.server.outbox import Outbox
from semcast.server.reference import Reference, sequence_reference
from semcast.server.session import Session
from semcast.server.settings import ServerSettings
from semcast.server.stream_end import StreamEnd
from semcast.server.stream_identity import StreamIdentity
from semcast.server.viewing import SuccessiveViews, check_viewer

logger = logging.getLogger(__name__)

#: Time for depth that is still missing where another stream waits, and where the server was stopped.
_IN_A_HURRY_S, _STOPPED_S = 2.0, 12.0


class SuccessiveSessions:
    """Begins the session of each stream, with what is shown of it, and writes what it leaves.

    Files that can't be written on the way are reported and nothing ends. Nor does anything where a stream's
    folder can't be used, or it can't be shown or compared with its reference; but the first stream of a
    server that does not keep running says so at once. Used from one thread.

    Args:
        settings: Of the server.
        metrics: Drops since a stream began are in its summary; takes what is reported.
        end_of: What is known of the end of the present stream.
        outbox: Publishes what the last adjustment changes.
        tell: Takes what the server is at besides frames, in a few words; empty when that is over.

    Attributes:
        current: Of the present stream, None before the first.
        views: What is shown of it.

    Raises:
        ConfigError: What is asked for can't be shown.
        SourceError: The reference can't be read.
    """

    def __init__(
        self,
        settings: ServerSettings,
        metrics: Metrics,
        end_of: StreamEnd,
        outbox: Outbox,
        tell: Callable[[str], None],
    ) -> None:
        self._settings = settings
        self._metrics = metrics
        self._end_of = end_of
        self._outbox = outbox
        self._tell = tell
        self.current: Session | None = None
        self.views = SuccessiveViews(settings, metrics.error)
        self._former_starts = FormerStarts()
        self._reference: Reference | None = None
        self._drops_before: dict[str, int] = {}
        if settings.reference is not None:
            open_sequence(settings.reference, settings.camera)
        check_viewer(settings)
        #: Made ahead for the first session: a process takes long to start.
        self._spare_bundle: BundleRunner | None = new_bundle(settings, metrics.error)

    def begin(self, camera: CameraInfo) -> Session:
        """Begin on a stream, ending the one before.

        Raises:
            ConfigError: It can't be shown.
            SourceError: The reference can't be read.
            OSError: The folder for outputs can't be made.
            SemcastError: It can't be written into.
        """
        identity = StreamIdentity.of(self._settings.agent_id, camera)
        former, self.current = self.current, None
        goes_on = former is not None or self._settings.keep_running
        if former is not None:
            is_restart = former.identity.agent_epoch != identity.agent_epoch
            logger.info("%sa new map is begun", "the agent was started again: " if is_restart else "")
            self._conclude(former, _IN_A_HURRY_S)
            self.views.end_stream()
            self._end_former(former)
            self._tell("")
        self._end_of.begin()
        if former is not None and former.identity.camera != identity.camera:
            self._close_reference()
        if self._reference is None:
            self._reference = self._new_reference(identity, goes_on=goes_on)
        self.current = self._new_session(identity, goes_on=goes_on)
        self._former_starts.begin(identity.agent_epoch)
        #: In the counts of the process but not of the stream; less those of its run that this one resumes.
        self._drops_before = self._metrics.drops if former is not None else {}
        for reason, num in self.current.former_drops.items():
            self._drops_before[reason] = self._drops_before.get(reason, 0) - num
        self._show(identity, self.current.resumed, goes_on=goes_on)
        logger.info(
            "stream of %s (%s): %dx%d, codec %s, %s mode",
            *(identity.agent_id, camera.source_name, *camera.image_wh, camera.codec, self._settings.mode),
        )
        return self.current

    def drops(self) -> dict[str, int]:
        """Return frames dropped since the present stream began, by reason: 0 where all were before it."""
        now, before = self._metrics.drops, self._drops_before
        return {reason: max(0, now.get(reason, 0) - before.get(reason, 0)) for reason in {**before, **now}}

    def _new_reference(self, identity: StreamIdentity, *, goes_on: bool) -> Reference | None:
        """Return the reference for a camera; a server that ``goes_on`` does without one if need be."""
        folder = self._settings.reference
        if folder is None:
            return None
        try:
            return sequence_reference(folder, identity.camera, self._settings.camera)
        except SourceError as err:
            if not goes_on:
                raise
            self.report(f"the new stream has no PSNR and no true path: {err}")
            return None

    def _new_session(self, identity: StreamIdentity, *, goes_on: bool) -> Session:
        """Return the session of a stream; a server that ``goes_on`` keeps it in memory if need be."""
        out = self._settings.out
        bundle = self._spare_bundle or new_bundle(self._settings, self._metrics.error)
        self._spare_bundle = None
        new = functools.partial(Session, self._settings, identity, on_error=self._metrics.error)
        try:
            return new(out, self._reference, bundle)
        except (OSError, SemcastError) as err:
            if not goes_on:
                raise
            self.report(_not_written(out, err))
        return new(None, self._reference, new_bundle(self._settings, self._metrics.error))

    def _show(self, identity: StreamIdentity, resumed: bool, *, goes_on: bool) -> None:
        """Show the stream; a server that ``goes_on`` tracks it unseen if need be."""
        try:
            self.views.begin_stream(identity, self._reference, resumed=resumed)
        except ConfigError as err:
            if not goes_on:
                raise
            self.report(f"the new stream is not shown: {err}")

    def report(self, text: str) -> str:
        """Log what the server goes on in spite of, show it in the status, and return it."""
        logger.error("%s", text)
        self._metrics.error(text)
        return text

    def is_straggler(self, agent_epoch: int, t_arrival_ns: int) -> bool:
        """Tell whether a frame is of a former start, while there is none of the present one yet."""
        is_first = self.current is not None and self.current.last_frame_id < 0
        return is_first and self._former_starts.is_straggler(agent_epoch, t_arrival_ns)

    def save(self) -> str:
        """Write checkpoint and results of the present stream, as far as they are; return what went wrong."""
        return "" if self.current is None else self._save(self.current)

    def _save(self, session: Session) -> str:
        session.save_checkpoint(self.drops())
        try:
            session.write_results(self._settings.out)
        except (OSError, SemcastError) as err:
            return self.report(_not_written(self._settings.out, err))
        return ""

    def write_between(self, gives_way: Callable[[], bool]) -> None:
        """Write what the present stream leaves, which has ended, and keep it: frames may come all the same.

        Args:
            gives_way: Tells, after each depth, that what is missing is left for later.
        """
        session, out = self.current, self._settings.out
        assert session is not None
        self._conclude(session, None, gives_way)
        try:
            self._write(session, out)
        except (OSError, SemcastError) as err:
            self.report(_not_written(out, err))
        else:
            if out is not None:
                logger.info("outputs are in %s, waiting for the next stream", out)
        self._tell("")

    def finish(self, stop: threading.Event) -> dict[str, Any]:
        """End the present stream and return its summary; that of a server that heard of none is empty.

        A stop leaves missing depth a little time, one that comes meanwhile none: who asks waits already.

        Raises:
            SemcastError: The outputs can't be written.
        """
        session, self.current = self.current, None
        if session is None:
            return {}
        out = self._settings.out
        try:
            was_stopped = stop.is_set()
            budget_s = _STOPPED_S if was_stopped or not self._end_of.complete else None
            self._conclude(session, budget_s, is_stopped=lambda: stop.is_set() and not was_stopped)
            summary = self._end(session, out)
        except OSError as err:
            raise SemcastError(_not_written(out, err)) from err
        finally:
            session.close()  # a second Ctrl-C may have ended the adjustment
        if out is not None:
            logger.info("outputs are in %s", out)
        return summary

    def _conclude(
        self,
        session: Session,
        depth_budget_s: float | None,
        gives_way: Callable[[], bool] = lambda: False,
        is_stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """Adjust the whole map of a stream that has ended, and tell who follows it."""
        self._save(session)  # the adjustment takes seconds, and the server may be stopped or killed meanwhile

        def show(update: MapUpdate | None, patches: Sequence[DensePatch]) -> None:
            if update is not None:
                self._outbox.put_map(session.identity.agent_epoch, update)
                if (last := session.newest_pose()) is not None:
                    self._outbox.put_metric_pose(session.identity.agent_epoch, last, session.metres.of(last))
            self.views.submit(None, update, patches)

        conclude(session, show, self._tell, depth_budget_s, gives_way, is_stopped)

    def _end_former(self, former: Session) -> None:
        """Write what the agent's start before leaves behind; that it can't be written ends no stream."""
        self._former_starts.end(former.identity.agent_epoch, had_frames=former.last_frame_id >= 0)
        out = self._settings.out
        folder = free_folder(out) if out is not None else None
        try:
            self._end(former, folder)
        except (OSError, SemcastError) as err:
            self.report(_not_written(folder, err))
        else:
            if folder is not None:
                logger.info("outputs of the stream before are in %s", folder)

    def _end(self, session: Session, folder: Path | None) -> dict[str, Any]:
        """Write what a stream leaves behind into a folder and release it."""
        try:
            return self._write(session, folder)
        finally:
            session.close()
            if folder is not None and folder != self._settings.out:
                session.move_records(folder)

    def _write(self, session: Session, folder: Path | None) -> dict[str, Any]:
        complete, num_sent = self._end_of.complete, self._end_of.num_sent(session.identity.agent_epoch)
        if not complete:
            session.save_checkpoint(self.drops())
        drops = {reason: count for reason, count in self.drops().items() if count}
        return session.write_outputs(folder, drops, complete=complete, num_sent=num_sent)

    def _close_reference(self) -> None:
        reference, self._reference = self._reference, None
        if reference is not None:
            reference.close()

    def close(self) -> None:
        """Release threads and processes. Idempotent; what a stream leaves is written by ``finish`` before."""
        bundle, self._spare_bundle = self._spare_bundle, None
        if bundle is not None:
            bundle.close()
        session, self.current = self.current, None
        if session is not None:
            session.close()
        self.views.close(leave_window=self._end_of.complete and self._settings.view.leave_open)
        self._close_reference()


def _not_written(folder: Path | None, err: Exception) -> str:
    return f"outputs can't be written to {folder}: {err}"
