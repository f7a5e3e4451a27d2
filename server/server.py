"""The server process: receives, decodes, tracks and maps one stream, shows it and keeps the results."""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from semcast.common.codec import Codec, Modulation
from semcast.common.codecs import named_weights
from semcast.common.config import to_toml
from semcast.common.errors import SemcastError, TransportError
from semcast.common.metrics import Metrics
from semcast.common.status_beat import StatusBeat
from semcast.common.transport import Session as NetworkSession
from semcast.common.transport import open_session
from semcast.common.wire import pack
from semcast.common.worker_guard import WorkerGuard
from semcast.server.announcement import Announcement
from semcast.server.control import Control
from semcast.server.decode_ahead import DecodeAhead
from semcast.server.decoder import Arrival, DecodedArrival, FrameDecoder, codec_loader
from semcast.server.false_start import FalseStart
from semcast.server.former_run import output_folder
from semcast.server.frame_views import missing_view
from semcast.server.mapping.state import FrameResult
from semcast.server.outbox import Outbox, map_message
from semcast.server.receiver import ReceivedFrame, Receiver
from semcast.server.record import recording
from semcast.server.session import Outcome
from semcast.server.settings import ServerSettings
from semcast.server.stream_end import StreamEnd
from semcast.server.succession import SuccessiveSessions

logger = logging.getLogger(__name__)

POLL_S = 0.1
#: The same while an adjustment is under way, which is applied when it is done and no frame waits.
_BRIEF_S = 0.01
WARM_UP_SHAPE_HW = (256, 384)


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
        agent_id = settings.agent_id
        self.metrics = Metrics("server")
        codec: str | None = None
        own: Path | None = None
        if settings.codec is not None:
            codec, own = named_weights(settings.codec)
        installed = codec_loader(
            settings.threads, settings.device, own, only_of=codec, precision=settings.precision
        )
        self._decoder = FrameDecoder(load if load is not None else installed)
        self._false_start = FalseStart()
        self._tracking = WorkerGuard("tracking a frame", self.metrics.error)
        self._new_map = False
        self._resources = contextlib.ExitStack()
        with contextlib.ExitStack() as stack:
            stack.enter_context(output_folder(settings.out))
            if settings.record is not None:
                record, told = settings.record, self.metrics.error
                stack.enter_context(
                    recording(session, agent_id, record, to_toml(settings), told, results=settings.out)
                )
            self._receiver = stack.enter_context(
                Receiver(session, agent_id, settings.mode, self.metrics, settings.max_age_ms)
            )
            self._end_of = StreamEnd(session, agent_id)
            self._outbox = Outbox(session, agent_id, self.metrics)
            stack.callback(self._outbox.close)
            self._beat = StatusBeat(
                session, agent_id, "server", self.metrics, lambda: self._receiver.agent_epoch
            )
            stack.callback(self._beat.close)
            self._control = Control(session, settings)
            stack.callback(self._control.close)
            # What takes long, or may fail, comes before others see that the server is there.
            self._sessions = SuccessiveSessions(
                settings, self.metrics, self._end_of, self._outbox, self._be_at
            )
            stack.callback(self._sessions.close)
            if codec is not None:
                ready = self._decoder.load(codec, settings.modulation)
                self._decoder.warm_up(ready.name, settings.modulation, ready.digest, WARM_UP_SHAPE_HW)
            self._announced = Announcement(session, agent_id)
            self._ahead = DecodeAhead(
                self._receiver.next,
                self._decoder.decode,
                self._on_failure,
                lambda decoded: self._receiver.is_too_old(decoded.arrival.message),
            )
            stack.callback(self._ahead.close)
            session.declare_alive(agent_id, "server")
            self._resources = stack.pop_all()

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
                self._control.serve(reset=self._reset, save=self._sessions.save, whole_map=self._whole_map)
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
                    # Depth missing when the agent is started again, or the server stopped, gets a little
                    # time then.
                    self._sessions.write_between(lambda: stop.is_set() or self._is_another_announced())
                if self._settings.duration_s is not None and now_s - started_s >= self._settings.duration_s:
                    break
        finally:
            self._control.close()
            summary = self._sessions.finish(stop)
        return summary

    def _next_decoded(self) -> DecodedArrival | None:
        """Return the next decoded frame, None when there was none in time; then the map may be adjusted."""
        session = self._sessions.current
        is_adjusting = session is not None and session.is_adjusting
        decoded = self._ahead.get(_BRIEF_S if is_adjusting else POLL_S)
        if decoded is None and session is not None:
            session.use_time()
        return decoded

    def _ended(self, idle_s: float) -> bool:
        """Tell whether nothing more is to come, ``idle_s`` after a stream's beginning or last frame; once."""
        session = self._sessions.current
        if session is None or session.is_concluded:
            return False
        epoch, is_there = session.identity.agent_epoch, "agent" in self._receiver.roles_alive
        # One that arrived just now may be on its way to the decoder, of which that does not know yet.
        quiet_s = min(idle_s, self._receiver.quiet_s)
        if self._end_of.has_come(epoch, quiet_s, agent_is_there=is_there, is_busy=self._ahead.is_busy):
            self._receiver.count_missing(epoch, self._end_of.num_sent(epoch))
            return True
        limit_s = self._settings.idle_timeout_s
        if limit_s is None or self._settings.keep_running or not self._end_of.has_begun:
            return False
        return idle_s >= limit_s

    def _is_another_announced(self) -> bool:
        session = self._sessions.current
        return session is not None and self._announced.is_newer(session.identity.agent_epoch)

    def _reset(self) -> str:
        if self._sessions.current is not None:
            logger.info("map reset on request")
            self._sessions.current.restart_map()
            self._new_map = True
        return ""

    def _whole_map(self) -> bytes | None:
        session = self._sessions.current
        return pack(map_message(session.identity.agent_epoch, session.whole_map())) if session else None

    def _prepare(self) -> bool:
        """Begin on an announced stream, so that all is ready for its first frame; tell if there was one."""
        camera, session = self._announced.take(), self._sessions.current
        if camera is None or (session is not None and camera.agent_epoch <= session.identity.agent_epoch):
            return False
        if not self._receiver.takes(camera):
            return False  # nor is it told that all is ready: it would wait without a word
        self._sessions.begin(camera)
        width, height = camera.image_wh
        try:
            self._decoder.warm_up(camera.codec, camera.modulation, camera.digest, (height, width))
        except SemcastError as err:
            logger.warning("%s", err)
        return True

    def _say_ready(self) -> None:
        """Let a live agent begin once all is prepared; repeated until its first frame is there."""
        session = self._sessions.current
        if session is not None and session.last_frame_id < 0 and self._settings.mode == "live":
            self._receiver.announce_ready(session.identity.agent_epoch)

    def _take(self, decoded: DecodedArrival) -> None:
        """Track one frame, send and show what came of it. One bad frame never stops the stream."""
        message = decoded.arrival.message
        if self._sessions.is_straggler(message.agent_epoch, decoded.arrival.t_arrival_ns):
            self.metrics.drop("epoch")
            return
        session = self._sessions.current
        if session is None or session.identity.agent_epoch != message.agent_epoch:
            session = self._sessions.begin(decoded.arrival.camera)
        newest_seq = session.last_seq
        session.note_arrival(message.frame_id, message.seq, final=message.final)
        self._end_of.note(message, decoded.arrival.camera)
        if decoded.frame is None:
            self.metrics.drop("lost_on_air" if decoded.arrival.received is None else "outage")
            self._sessions.views.submit(missing_view(decoded, self._sessions.drops()))
            return
        if message.frame_id <= session.last_frame_id:
            self.metrics.drop("processed")
            if not self._false_start.is_shown_by(message.frame_id, message.seq, newest_seq):
                return
            newest_id = session.last_frame_id
            self._sessions.report(f"frame {newest_id} was wrong: the stream is at {message.frame_id}")
            session = self._sessions.begin(decoded.arrival.camera)
            session.note_arrival(message.frame_id, message.seq, final=message.final)
        self._false_start.note_followed()

        def tell(found: FrameResult) -> None:
            self._outbox.put_pose(decoded.arrival, found)
            self._outbox.put_metric_pose(message.agent_epoch, found, session.metres.of(found))

        outcome = None
        with self._tracking:
            outcome = session.process(decoded.frame, Arrival.of(decoded, self._sessions.drops()), tell)
        if outcome is None:
            self.metrics.drop("track")
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
        if self._sessions.views.is_shown:
            started_ns = time.perf_counter_ns()
            self._sessions.views.submit(outcome.view, outcome.update, outcome.patches, new_map=self._new_map)
            self.metrics.observe("view", (time.perf_counter_ns() - started_ns) * 1e-6)
        self._new_map = False

    def _be_at(self, activity: str) -> None:
        """Let the status say at once what the server is at; see ``Metrics.be_at``."""
        self.metrics.be_at(activity)
        self._beat.send()

    def close(self) -> None:
        """Release threads, processes and ports. Idempotent.

        Raises:
            SourceError: The recording could not be written to its end.
        """
        self._resources.close()


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
    settings.warn()
    network = open_session(settings.network, stop_event)
    if network is None:
        return {}
    with network, _closing(Server(settings, network)) as server:
        logger.info("%s, waiting for agent '%s'", settings.network.where, settings.agent_id)
        summary = server.run(stop_event)
        if settings.network.listens_on:
            _warn_of_others(network, settings.agent_id)
        return summary


@contextlib.contextmanager
def _closing(server: Server) -> Iterator[Server]:
    """Close a server in the end; what goes wrong then does not hide what went wrong before."""
    with contextlib.closing(server):
        try:
            yield server
        except SemcastError as err:
            try:
                server.close()
            except SemcastError as another:
                raise SemcastError(f"{err}; {another}") from err
            raise


def _warn_of_others(hub: NetworkSession, agent_id: str) -> None:
    """Tell whose processes met at the hub that is about to close."""
    with contextlib.suppress(TransportError):  # results are written, and nothing else is asked for
        others = [name for name in hub.alive_agents() if name != agent_id]
        if others:
            logger.warning(
                "%s met at this server and can't go on without it: start it again, with --keep-running it "
                "stays; or let the server of each agent listen on a port of its own",
                ", ".join(others),
            )
