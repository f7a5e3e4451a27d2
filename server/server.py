"""The server process: receives, decodes, tracks and maps one stream, shows it and keeps the results."""

import contextlib
import functools
import logging
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from semcast.common.codec import Codec, Modulation
from semcast.common.codecs import named_weights
from semcast.common.config import to_toml
from semcast.common.errors import ConfigError, SemcastError
from semcast.common.messages import CameraInfo
from semcast.common.metrics import Metrics
from semcast.common.sequence import open_sequence
from semcast.common.status_beat import StatusBeat
from semcast.common.transport import Session as NetworkSession
from semcast.common.transport import open_session
from semcast.common.wire import pack
from semcast.server.announcement import Announcement
from semcast.server.bundle_runner import new_bundle
from semcast.server.conclusion import conclude
from semcast.server.control import Control
from semcast.server.decode_ahead import DecodeAhead
from semcast.server.decoder import Arrival, DecodedArrival, FrameDecoder, codec_loader
from semcast.server.dense.cloud import DensePatch
from semcast.server.false_start import FalseStart
from semcast.server.former_run import free_folder, output_folder
from semcast.server.former_starts import FormerStarts
from semcast.server.frame_views import missing_view
from semcast.server.mapping.bundle_problem import BundleRunner
from semcast.server.mapping.state import FrameResult, MapUpdate
from semcast.server.outbox import Outbox, map_message
from semcast.server.receiver import ReceivedFrame, Receiver
from semcast.server.record import recording
from semcast.server.reference import Reference, sequence_reference
from semcast.server.session import Outcome, Session
from semcast.server.settings import ServerSettings
from semcast.server.stream_end import StreamEnd
from semcast.server.stream_identity import StreamIdentity
from semcast.server.viewing import SuccessiveViews, check_viewer

logger = logging.getLogger(__name__)

POLL_S = 0.1
#: The same while an adjustment is under way, which is applied when it is done and no frame waits.
_BRIEF_S = 0.01
WARM_UP_SHAPE_HW = (256, 384)
#: Time for depth that is still missing where another stream waits, and where the server was stopped.
_IN_A_HURRY_S, _STOPPED_S = 2.0, 12.0


class Server:
    """Serves one agent. Build, ``run`` once, ``close``.

    A restarted agent begins a new map in the same folder; what the former one left is moved to
    ``previous-<n>/``. A restarted server goes on with the map of its checkpoint if the agent is the same.
    Files that can't be written are reported and the stream goes on; they are an error at the end of ``run``.

    One that keeps running writes the outputs of a stream when it ends and waits for the next one.

    Args:
        settings: What to do.
        session: An open network session, which the server declares itself on.
        load: Returns a codec by name and modulation; None takes the installed ones.

    Attributes:
        metrics: What it counts about itself.
    """

    def __init__(
        self,
        settings: ServerSettings,
        session: NetworkSession,
        load: Callable[[str, Modulation], Codec] | None = None,
    ) -> None:
        self._settings = settings
        self._agent_id = settings.agent_id
        self.metrics = Metrics("server")
        self._codec: str | None = None
        own: Path | None = None
        if settings.codec is not None:
            self._codec, own = named_weights(settings.codec)
        installed = codec_loader(settings.threads, settings.device, own, only_of=self._codec)
        self._decoder = FrameDecoder(load if load is not None else installed)
        self._session: Session | None = None
        self._views = SuccessiveViews(settings, self.metrics.error)
        self._reference: Reference | None = None
        self._former_starts = FormerStarts()
        self._false_start = FalseStart()
        self._drops_before: dict[str, int] = {}
        self._spare_bundle: BundleRunner | None = None
        self._new_map = False
        self._resources = contextlib.ExitStack()
        with contextlib.ExitStack() as stack:
            stack.enter_context(output_folder(settings.out))
            if settings.record is not None:
                record, told = settings.record, self.metrics.error
                stack.enter_context(recording(session, self._agent_id, record, to_toml(settings), told))
            self._receiver = stack.enter_context(
                Receiver(session, self._agent_id, settings.mode, self.metrics, settings.max_age_ms)
            )
            self._end_of = StreamEnd(session, self._agent_id)
            self._outbox = Outbox(session, self._agent_id, self.metrics)
            stack.callback(self._outbox.close)
            self._beat = StatusBeat(
                session, self._agent_id, "server", self.metrics, lambda: self._receiver.agent_epoch
            )
            stack.callback(self._beat.close)
            self._control = Control(session, settings)
            stack.callback(self._control.close)
            stack.callback(self._close_spare)
            self._make_ready()
            self._announced = Announcement(session, self._agent_id)
            self._ahead = DecodeAhead(
                self._receiver.next,
                self._decoder.decode,
                self._on_failure,
                lambda decoded: self._receiver.is_too_old(decoded.arrival.message),
            )
            stack.callback(self._ahead.close)
            session.declare_alive(self._agent_id, "server")
            self._resources = stack.pop_all()

    def _make_ready(self) -> None:
        """Do what takes long, or may fail, before others see that the server is there."""
        settings = self._settings
        if settings.reference is not None:
            open_sequence(settings.reference, settings.camera)
        self._spare_bundle = new_bundle(self._settings, self.metrics.error)
        check_viewer(settings)
        if self._codec is not None:
            codec = self._decoder.load(self._codec, settings.modulation)
            self._decoder.warm_up(codec.name, settings.modulation, codec.digest, WARM_UP_SHAPE_HW)

    def _close_spare(self) -> None:
        bundle, self._spare_bundle = self._spare_bundle, None
        if bundle is not None:
            bundle.close()

    def _on_failure(self, arrival: ReceivedFrame, reason: str) -> None:
        self.metrics.drop(reason)
        self.metrics.error(f"frame {arrival.message.frame_id} dropped: {reason}")
        self._receiver.done(arrival.message)

    def run(self, stop: threading.Event) -> dict[str, Any]:
        """Serve until the source ends, ``stop`` is set or a time limit passes; outputs are always written.

        Returns:
            The summary of the newest stream, which is also in ``summary.json``.

        Raises:
            ConfigError: The viewer can't be started.
            SourceError: The reference can't be read.
            SemcastError: The outputs can't be written.
        """
        started_s = active_s = time.monotonic()
        try:
            while not stop.is_set():
                decoded = self._next_decoded()
                now_s = time.monotonic()
                self._serve_requests()
                if self._prepare():
                    active_s = now_s = time.monotonic()
                self._say_ready()
                if decoded is not None:
                    active_s = now_s
                    self._take(decoded)
                    self._receiver.done(decoded.arrival.message)
                elif self._ended(now_s - active_s):
                    if not self._settings.keep_running:
                        break
                    self._write_between(stop)
                if self._settings.duration_s is not None and now_s - started_s >= self._settings.duration_s:
                    break
        finally:
            self._control.close()
            summary = self._finish(is_stopped=stop.is_set())
        return summary

    def _next_decoded(self) -> DecodedArrival | None:
        """Return the next decoded frame, None when there was none in time; then the map may be adjusted."""
        session = self._session
        is_adjusting = session is not None and session.is_adjusting
        decoded = self._ahead.get(_BRIEF_S if is_adjusting else POLL_S)
        if decoded is None and session is not None:
            session.use_time()
        return decoded

    def _ended(self, idle_s: float) -> bool:
        """Tell whether nothing more is to come, ``idle_s`` after a stream's beginning or last frame; once."""
        if self._session is None or self._session.is_concluded:
            return False
        epoch, is_there = self._session.identity.agent_epoch, "agent" in self._receiver.roles_alive
        if self._end_of.has_come(epoch, idle_s, agent_is_there=is_there, is_busy=self._ahead.is_busy):
            self._receiver.count_missing(epoch, self._end_of.num_sent(epoch))
            return True
        limit_s = self._settings.idle_timeout_s
        if limit_s is None or self._settings.keep_running or not self._end_of.has_begun:
            return False
        return idle_s >= limit_s

    def _write_between(self, stop: threading.Event) -> None:
        """Write what the stream that has ended leaves, and go on: frames of it may come all the same."""
        session, out = self._session, self._settings.out
        assert session is not None
        # Depth missing when the agent is started again, or the server stopped, gets a little time then.
        epoch = session.identity.agent_epoch
        self._conclude(session, None, lambda: stop.is_set() or self._announced.is_newer(epoch))
        try:
            self._write(session, out)
        except (OSError, SemcastError) as err:
            self._tell_not_written(out, err)
        else:
            if out is not None:
                logger.info("outputs are in %s, waiting for the next stream", out)
        self._be_at("")

    def _serve_requests(self) -> None:
        session = self._session
        self._control.serve(
            reset=lambda: self._reset(session),
            save=lambda: self._save(session),
            whole_map=lambda: self._whole_map(session),
        )

    def _reset(self, session: Session | None) -> str:
        if session is None:
            return ""
        logger.info("map reset on request")
        session.restart_map()
        self._new_map = True
        return ""

    def _save(self, session: Session | None) -> str:
        """Write checkpoint and results now, as far as they are; return what went wrong."""
        if session is None:
            return ""
        session.save_checkpoint()
        try:
            session.write_results(self._settings.out)
        except (OSError, SemcastError) as err:
            return self._tell_not_written(self._settings.out, err)
        return ""

    def _whole_map(self, session: Session | None) -> bytes | None:
        return pack(map_message(session.identity.agent_epoch, session.whole_map())) if session else None

    def _tell_not_written(self, folder: Path | None, err: Exception) -> str:
        """Report outputs that the stream goes on without."""
        return self._tell(_not_written(folder, err))

    def _tell(self, text: str) -> str:
        """Log what the stream goes on in spite of, and show it in the status."""
        logger.error("%s", text)
        self.metrics.error(text)
        return text

    def _prepare(self) -> bool:
        """Begin on an announced stream, so that all is ready for its first frame; tell if there was one."""
        camera = self._announced.take()
        if camera is None or (
            self._session is not None and camera.agent_epoch <= self._session.identity.agent_epoch
        ):
            return False
        self._begin(camera)
        width, height = camera.image_wh
        try:
            self._decoder.warm_up(camera.codec, camera.modulation, camera.digest, (height, width))
        except SemcastError as err:
            logger.warning("%s", err)
        return True

    def _say_ready(self) -> None:
        """Let a live agent begin once all is prepared; repeated until its first frame is there."""
        session = self._session
        if session is not None and session.last_frame_id < 0 and self._settings.mode == "live":
            self._receiver.announce_ready(session.identity.agent_epoch)

    def _take(self, decoded: DecodedArrival) -> None:
        """Track one frame, send and show what came of it. One bad frame never stops the stream."""
        message = decoded.arrival.message
        session = self._session
        is_first = session is not None and session.last_frame_id < 0
        if is_first and self._former_starts.is_straggler(message.agent_epoch, decoded.arrival.t_arrival_ns):
            self.metrics.drop("epoch")
            return
        if session is None or session.identity.agent_epoch != message.agent_epoch:
            session = self._begin(decoded.arrival.camera)
        newest_seq = session.last_seq
        session.note_arrival(message.frame_id, message.seq, final=message.final)
        self._end_of.note(message, decoded.arrival.camera)
        if decoded.frame is None:
            self.metrics.drop("lost_on_air" if decoded.arrival.received is None else "outage")
            self._views.submit(missing_view(decoded, self.metrics.drops))
            return
        if message.frame_id <= session.last_frame_id:
            self.metrics.drop("processed")
            if not self._false_start.is_shown_by(message.frame_id, message.seq, newest_seq):
                return
            self._tell(f"frame {session.last_frame_id} was wrong: the stream is at {message.frame_id}")
            session = self._begin(decoded.arrival.camera)
            session.note_arrival(message.frame_id, message.seq, final=message.final)
        self._false_start.note_followed()

        def tell(found: FrameResult) -> None:
            self._outbox.put_pose(decoded.arrival, found)
            self._outbox.put_metric_pose(message.agent_epoch, found, session.metres.of(found))

        try:
            outcome = session.process(decoded.frame, Arrival.of(decoded, self.metrics.drops), tell)
        except Exception as err:
            logger.exception("frame %d could not be tracked and is left out", message.frame_id)
            self.metrics.drop("track")
            self.metrics.error(f"frame {message.frame_id}: {err}")
            return
        self._spread(decoded, outcome)

    def _spread(self, decoded: DecodedArrival, outcome: Outcome) -> None:
        """Publish what a frame did to the map, show and count what it led to; its pose is on its way."""
        result = outcome.result
        if outcome.update is not None:
            self._outbox.put_map(decoded.arrival.message.agent_epoch, outcome.update)
        self.metrics.count("tracked")
        if result.T_world_cam is not None:
            self.metrics.count("posed")
        for stage, duration_ms in (("decode", decoded.decode_ms), *result.stage_ms.items()):
            self.metrics.observe(stage, duration_ms)
        if self._views.is_shown:
            started_ns = time.perf_counter_ns()
            self._views.submit(outcome.view, outcome.update, outcome.patches, new_map=self._new_map)
            self.metrics.observe("view", (time.perf_counter_ns() - started_ns) * 1e-6)
        self._new_map = False

    def _begin(self, camera: CameraInfo) -> Session:
        """Start on the stream of an agent heard for the first time, ending that of the one before."""
        identity = StreamIdentity.of(self._agent_id, camera)
        former, self._session = self._session, None
        if former is not None:
            is_restart = former.identity.agent_epoch != identity.agent_epoch
            logger.info("%sa new map is begun", "the agent was started again: " if is_restart else "")
            self._conclude(former, _IN_A_HURRY_S)
            self._views.end_stream()
            self._end_former(former)
            self._be_at("")
        self._end_of.begin()
        other_camera = former is not None and former.identity.camera != identity.camera
        if other_camera and self._reference is not None:
            self._reference.close()
            self._reference = None
        if self._settings.reference is not None and self._reference is None:
            self._reference = sequence_reference(
                self._settings.reference, identity.camera, self._settings.camera
            )
        self._session = self._new_session(identity, goes_on=former is not None)
        self._former_starts.begin(identity.agent_epoch)
        self._drops_before = self.metrics.drops if former is not None else {}
        self._show(identity, self._session.resumed, goes_on=former is not None)
        logger.info(
            "stream of %s (%s): %dx%d, codec %s, %s mode",
            *(self._agent_id, camera.source_name, *camera.image_wh, camera.codec, self._settings.mode),
        )
        return self._session

    def _new_session(self, identity: StreamIdentity, *, goes_on: bool) -> Session:
        """Return the session of a stream; a server that ``goes_on`` keeps it in memory if need be."""
        out = self._settings.out
        bundle = self._spare_bundle or new_bundle(self._settings, self.metrics.error)
        self._spare_bundle = None
        new = functools.partial(Session, self._settings, identity, on_error=self.metrics.error)
        try:
            return new(out, self._reference, bundle)
        except (OSError, SemcastError) as err:
            if not goes_on:
                raise
            self._tell_not_written(out, err)
        return new(None, self._reference, new_bundle(self._settings, self.metrics.error))

    def _show(self, identity: StreamIdentity, resumed: bool, *, goes_on: bool) -> None:
        """Show the stream; a server that ``goes_on`` tracks it unseen if need be."""
        try:
            self._views.begin_stream(identity, self._reference, resumed=resumed)
        except ConfigError as err:
            if not goes_on:
                raise
            self._tell(f"the new stream is not shown: {err}")

    def _conclude(
        self, session: Session, depth_budget_s: float | None, gives_way: Callable[[], bool] = lambda: False
    ) -> None:
        """Adjust the whole map of a stream that has ended, and tell who follows it."""
        self._save(session)  # the adjustment takes seconds, and the server may be stopped or killed meanwhile

        def show(update: MapUpdate | None, patches: Sequence[DensePatch]) -> None:
            if update is not None:
                self._outbox.put_map(session.identity.agent_epoch, update)
                if (last := session.newest_pose()) is not None:
                    self._outbox.put_metric_pose(session.identity.agent_epoch, last, session.metres.of(last))
            self._views.submit(None, update, patches)

        conclude(session, show, self._be_at, depth_budget_s, gives_way)

    def _be_at(self, activity: str) -> None:
        """Let the status say at once what the server is at; see ``Metrics.be_at``."""
        self.metrics.be_at(activity)
        self._beat.send()

    def _drops(self) -> dict[str, int]:
        """Drops since the present stream began."""
        now = self.metrics.drops
        return {reason: n for reason in now if (n := now[reason] - self._drops_before.get(reason, 0)) > 0}

    def _end_former(self, former: Session) -> None:
        """Write what the agent's start before leaves behind; that it can't be written ends no stream."""
        self._former_starts.end(former.identity.agent_epoch, had_frames=former.last_frame_id >= 0)
        out = self._settings.out
        folder = free_folder(out) if out is not None else None
        try:
            self._end(former, folder)
        except (OSError, SemcastError) as err:
            self._tell_not_written(folder, err)

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
            session.save_checkpoint()
        return session.write_outputs(folder, self._drops(), complete=complete, num_sent=num_sent)

    def _finish(self, *, is_stopped: bool) -> dict[str, Any]:
        """End the present stream; a server that heard of none has an empty summary."""
        session, self._session = self._session, None
        if session is None:
            return {}
        try:
            self._conclude(session, _STOPPED_S if is_stopped or not self._end_of.complete else None)
            summary = self._end(session, self._settings.out)
        except OSError as err:
            raise SemcastError(_not_written(self._settings.out, err)) from err
        finally:
            session.close()  # a second Ctrl-C may have ended the adjustment
        if self._settings.out is not None:
            logger.info("outputs are in %s", self._settings.out)
        return summary

    def close(self) -> None:
        """Release threads, processes and ports. Idempotent.

        Raises:
            SourceError: The recording could not be written to its end.
        """
        try:
            self._resources.close()
        finally:
            session, self._session = self._session, None
            if session is not None:
                session.close()
            self._views.close(leave_window=self._end_of.complete and self._settings.view.leave_open)
            reference, self._reference = self._reference, None
            if reference is not None:
                reference.close()


def _not_written(folder: Path | None, err: Exception) -> str:
    return f"outputs can't be written to {folder}: {err}"


def run_server(settings: ServerSettings, stop_event: threading.Event) -> dict[str, Any]:
    """Serve one agent until its source ends, ``stop_event`` is set or a time limit passes.

    Args:
        settings: What to do.
        stop_event: Ends the run early; outputs are written all the same.

    Returns:
        The summary, which is also in ``summary.json``; empty when no stream was heard.

    Raises:
        TransportError: The port is taken, or no hub was found.
        ConfigError: The viewer can't be started or a codec is unknown.
        SourceError: The reference can't be read, or the recording could not be written to its end.
        SemcastError: The outputs can't be written.
    """
    network = open_session(settings.network, stop_event)
    if network is None:
        return {}
    with network, contextlib.closing(Server(settings, network)) as server:
        logger.info("%s, waiting for agent '%s'", settings.network.where, settings.agent_id)
        return server.run(stop_event)
