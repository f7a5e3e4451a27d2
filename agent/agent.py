"""The agent process: captures, encodes and publishes, in live or lossless service."""

import contextlib
import logging
import sys
import threading
import time
from typing import Any

from semcast.agent.capture import Capture
from semcast.agent.encoder import FrameEncoder, LinkFeedback
from semcast.agent.originals import OriginalSharer
from semcast.agent.pace_control import PaceControl
from semcast.agent.peers import READY_S, wait_for_peers, wait_until_ready
from semcast.agent.replay_window import ReplayWindow
from semcast.agent.settings import AgentSettings
from semcast.agent.source import Source, SourceFrame, open_source
from semcast.common.codec import Codec
from semcast.common.codecs import is_conventional, load_codec
from semcast.common.complaints import Complaints
from semcast.common.errors import SourceError, TransportError
from semcast.common.heap import keep_freed_memory
from semcast.common.keys import camera_key, flow_key, link_key, role_of, status_keys, tx_key
from semcast.common.message_fields import sendable
from semcast.common.messages import CameraInfo, FlowMessage, LinkReport, StatusMessage, SymbolFrame
from semcast.common.metrics import Metrics
from semcast.common.rate import RateControl
from semcast.common.status_beat import StatusBeat
from semcast.common.transport import Session, open_session
from semcast.common.wire import WireError, pack, unpack
from semcast.common.worker_guard import WorkerGuard

logger = logging.getLogger(__name__)

ROLE = "agent"
_PEERS = frozenset({"channel", "server"})
_POLL_S = 0.1
_FLOW_POLL_S = 0.05
_BUSY_POLL_S = 0.005
#: Frames sent before it is said that encoding them takes too long: the first ones of a process take longer.
_MIN_SENT = 10
#: Live: the last frame is repeated until the receiver reports on it, for at most this long.
_FAREWELL_S = 2.0
_REPEAT_S = 0.2


def camera_info(settings: AgentSettings, source: Source, codec: Codec, agent_epoch: int) -> CameraInfo:
    """Return what a receiver must know about this agent."""
    camera = source.intrinsics
    return CameraInfo(
        agent_id=settings.agent_id,
        agent_epoch=agent_epoch,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        image_wh=(camera.width, camera.height),
        nominal_rate_hz=source.rate_hz,
        codec=codec.name,
        digest=codec.digest,
        modulation=codec.modulation,
        source_name=sendable(source.name, 200),
        num_frames=source.num_frames,
        last_frame_id=source.last_frame_id,
        lossless=settings.mode == "replay",
        readout_ms=camera.readout_ms,
        readout_from=camera.readout_from,
    )


class _Sending:
    """What both services share: one start of the agent on an open session."""

    def __init__(
        self,
        session: Session,
        settings: AgentSettings,
        source: Source,
        codec: Codec,
        metrics: Metrics,
        stop: threading.Event,
        agent_epoch: int,
    ) -> None:
        self.agent_epoch = agent_epoch
        self.metrics = metrics
        self.complaints = Complaints(metrics)
        self.lossless = settings.mode == "replay"
        self.feedback = LinkFeedback(self.agent_epoch, settings.snr_db)
        follows = settings.follow_server and not self.lossless
        self._pace = PaceControl(self.agent_epoch, source.rate_hz) if follows else None
        self._settings = settings
        self._last_seq = self._last_frame_id = -1
        self._is_slow = False
        self._rate = RateControl(settings.rate, source.intrinsics.shape_hw)
        self._encoder = FrameEncoder(codec, self.agent_epoch, self.lossless)
        agent_id = settings.agent_id
        camera = pack(camera_info(settings, source, codec, self.agent_epoch))
        session.answer(camera_key(agent_id), lambda request: camera)
        session.subscribe(link_key(agent_id), "newest", self._on_link)
        session.subscribe_keyed(status_keys(agent_id), self._on_status)
        self._symbols = session.publisher(tx_key(agent_id), "every" if self.lossless else "newest")
        session.publisher(camera_key(agent_id), "every").put(camera)
        self._originals = (
            OriginalSharer(
                session, agent_id, self.agent_epoch, settings.share_source, self.lossless, metrics, stop
            )
            if settings.share_source != "off"
            else None
        )

    def _on_link(self, payload: bytes) -> None:
        try:
            report = unpack(payload, LinkReport)
        except WireError as err:
            self.complaints.refuse(err)
            return
        if report.agent_epoch == self.agent_epoch and report.frame_id > self._last_frame_id:
            # Believed, it would be the newest for good.
            text = f"a report must be of a frame that was sent, got {report.frame_id}"
            self.complaints.refuse(WireError("range", text))
            return
        if report.agent_epoch > self.agent_epoch and self._last_frame_id >= 0:
            self.complaints.tell(
                "another",
                f"the server takes the frames of another agent {self._settings.agent_id!r}, started after "
                "this one: stop one of the two or give it another --agent-id",
            )
        self.feedback.update(report)
        if self._pace is not None:
            self._pace.on_report(report)
        self.metrics.count("link_reports")

    def _on_status(self, key: str, payload: bytes) -> None:
        """Say where a channel or server is of another version: it takes no frame, and so reports on none."""
        try:
            unpack(payload, StatusMessage)
        except WireError as err:
            if err.reason == "version" and (role := role_of(key)) in _PEERS:
                self.complaints.tell("version", f"the {role} takes no frames of this agent: {err}")

    @property
    def channel_uses(self) -> str:
        """How many a frame takes, for people."""
        return " to ".join(map(str, sorted(set(self._rate.num_uses))))

    @property
    def is_heard(self) -> bool:
        """Whether anybody takes frames now, a channel or a recorder; told not to wait, it is not asked."""
        return not self._settings.wait or self._symbols.has_receiver

    def wants(self, frame: SourceFrame) -> bool:
        """Tell whether a frame of the source is to be sent; in replay all are."""
        return self._pace is None or self._pace.wants(frame.t_capture_ns)

    def encode(self, frame: SourceFrame) -> SymbolFrame:
        """Encode for the link as it is now; in replay for a fixed SNR, so that runs repeat exactly."""
        if self._originals is not None:
            self._originals.put(frame)
        snr_db = self._settings.snr_db if self.lossless else self.feedback.snr_db()
        with self.metrics.stage("encode"):
            return self._encoder.encode(frame, snr_db, self._rate.choose(snr_db))

    def send(self, message: SymbolFrame) -> None:
        """Publish a frame, which is counted and timed once however often it is sent."""
        self._last_frame_id = max(self._last_frame_id, message.frame_id)  # it may be reported on at once
        with self.metrics.stage("send"):
            self._symbols.put(pack(message))
        if message.seq <= self._last_seq:
            self.metrics.count("sent_again")
            return
        self._last_seq = message.seq
        if self._pace is not None:
            self._pace.on_sent()
        self.metrics.count("sent")
        if self._settings.rate == "auto":
            uses = message.num_slots * message.uses_per_slot
            self.metrics.be_at(f"sending {uses} channel uses a frame")
        self.metrics.observe("capture_to_sent", (time.monotonic_ns() - message.t_capture_ns) * 1e-6)
        self._say_if_slow()

    def _say_if_slow(self) -> None:
        """Say once where more frames are left out, as the encoder was busy, than are sent."""
        if self._is_slow:
            return
        sent, left_out = self.metrics.counts["sent"], self.metrics.drops.get("superseded", 0)
        if sent < _MIN_SENT or left_out < sent:
            return
        self._is_slow = True
        usual_ms = self.metrics.stages_ms()["encode"]["p50"]
        other = "" if is_conventional(self._settings.codec) else ", a conventional codec such as jpeg-amc"
        text = (
            f"encoding a frame takes {usual_ms:.0f} ms, so that one in {1 + left_out / sent:.0f} is sent: "
            f"a smaller --resize{other} or a less busy machine encodes more"
        )
        self.metrics.error(text)
        logger.warning("%s", text)

    def leave_out(self, frame_id: int, why: Exception) -> None:
        """Count a frame that can't be sent, and say why."""
        self.metrics.drop("encode")
        self.complaints.tell("encode", f"frame {frame_id} is left out: {why}")

    def close(self) -> None:
        """Let the originals that wait be sent. Idempotent."""
        if self._originals is not None:
            self._originals.close()


def _send_live(sending: _Sending, capture: Capture, stop: threading.Event) -> None:
    """Send the newest frame, over and over; while nobody takes it none is encoded, but a source's last one.

    That one is repeated, so whoever comes in time has it.
    """
    last: SymbolFrame | None = None

    def on_unforeseen(text: str) -> None:
        sending.metrics.drop("encode")
        sending.metrics.error(text)

    encoding = WorkerGuard("encoding a frame", on_unforeseen)  # as where there is no memory for a moment
    while not stop.is_set() and not capture.ended:
        frame = capture.get(_POLL_S)
        if frame is None:
            continue
        if not frame.final and not sending.is_heard:
            sending.metrics.drop("unheard")
            sending.metrics.be_at("")
            continue
        encoded = None
        with encoding:
            try:
                encoded = sending.encode(frame)
            except ValueError as err:
                sending.leave_out(frame.frame_id, err)
        if encoded is None:
            continue
        try:
            sending.send(encoded)
            last = encoded
        except WireError as err:
            sending.leave_out(frame.frame_id, err)
    if last is None or not last.final:
        return
    until_s = time.monotonic() + _FAREWELL_S
    while not stop.wait(_REPEAT_S) and time.monotonic() < until_s:
        if sending.feedback.reported_frame_id >= last.frame_id:
            return
        sending.send(last)


def _send_lossless(
    sending: _Sending,
    capture: Capture,
    session: Session,
    agent_id: str,
    stop: threading.Event,
) -> None:
    """Send every frame when the receiver wants it, until it has all of them.

    Raises:
        SourceError: A frame can't be encoded.
    """
    window = ReplayWindow(sending.agent_epoch)
    changed = threading.Condition()

    def on_flow(payload: bytes) -> None:
        try:
            flow = unpack(payload, FlowMessage)
        except WireError as err:
            sending.complaints.refuse(err)
            return
        with changed:
            window.on_flow(flow)
            changed.notify()

    session.subscribe(flow_key(agent_id), "newest", on_flow)
    encoded: SymbolFrame | None = None
    expected_s = time.monotonic() + READY_S
    told = set[str]()
    while not stop.is_set():
        if not window.is_wanted and time.monotonic() > expected_s:
            expected_s = time.monotonic() + READY_S
            why = (
                "one in live mode takes none of an agent in replay mode (--mode)"
                if "server" in session.alive_roles(agent_id)
                else f"there is none of the name {agent_id!r} (another --agent-id?)"
            )
            if why not in told:
                logger.warning("no server asks for frames: %s", why)
            told.add(why)
        if encoded is None and not capture.ended:
            # While the receiver is busy, one frame is encoded ahead.
            frame = capture.get(_FLOW_POLL_S if window.all_taken else _BUSY_POLL_S)
            encoded = _encoded(sending, frame) if frame is not None else None
        with changed:
            if encoded is not None and window.has_room:
                window.add(encoded)
                encoded = None
            due = window.due()
            if not due and (encoded is not None or capture.ended):
                changed.wait(_FLOW_POLL_S)
            done = capture.ended and encoded is None and window.all_taken
        for message in due:
            sending.send(message)
        if done:
            return


def _encoded(sending: _Sending, frame: SourceFrame) -> SymbolFrame:
    try:
        return sending.encode(frame)
    except ValueError as err:
        raise SourceError(
            f"frame {frame.frame_id} can't be encoded, and a replay leaves none out: {err}"
        ) from err


def run_agent(settings: AgentSettings, stop: threading.Event, codec: Codec | None = None) -> dict[str, Any]:
    """Run the agent process until its source ends or ``stop`` is set.

    Args:
        settings: Of the process.
        stop: Ends it.
        codec: Used instead of the one ``settings`` names.

    Returns:
        Counts, drops by reason and stage times, with ``agent_epoch``, ``source`` and ``complete``.

    Raises:
        SourceError: The source can't be read, or failed later; what it gave before that was sent. Or a frame
            that is to be replayed can't be encoded.
        ConfigError: The codec is unknown.
        CheckpointError: Its weights are missing or damaged.
        TransportError: Its port is taken, where it is the hub.
    """
    metrics = Metrics(ROLE)
    with contextlib.ExitStack() as stack:
        source = open_source(settings.source)
        unread = stack.enter_context(contextlib.ExitStack())
        unread.callback(source.close)
        codec = codec if codec is not None else _codec_of(settings)
        session = open_session(settings.network, stop)
        summary: dict[str, Any] = {"agent_epoch": 0, "source": source.name, "complete": False}
        if session is None:
            return {**metrics.summary(), **summary}
        stack.enter_context(session)
        stack.callback(lambda: logger.info("%s", metrics.closing_line("sent")))
        agent_epoch = time.time_ns()
        beat = StatusBeat(session, settings.agent_id, ROLE, metrics, lambda: agent_epoch)
        stack.callback(beat.close)
        sending = _Sending(session, settings, source, codec, metrics, stop, agent_epoch)
        stack.callback(sending.close)
        session.declare_alive(settings.agent_id, ROLE)
        if settings.wait:
            wait_for_peers(session, settings.agent_id, _PEERS, stop)
            if not sending.lossless:
                wait_until_ready(session, settings.agent_id, agent_epoch, stop)
        if not stop.is_set():
            what = f"sending {source.name} with {codec.name}, {settings.mode}"
            logger.info("%s, %s channel uses a frame", what, sending.channel_uses)
        capture = Capture(source, "all" if sending.lossless else "newest", metrics, sending.wants)
        stack.callback(capture.close)
        unread.pop_all()  # from now on it is the capture's, which frees it when nobody reads from it
        complete = _send(sending, capture, session, settings.agent_id, stop)
        summary.update(agent_epoch=agent_epoch, complete=complete)
    return {**metrics.summary(), **summary}


def _codec_of(settings: AgentSettings) -> Codec:
    codec = load_codec(
        settings.codec,
        modulation=settings.modulation,
        num_threads=settings.threads,
        device=settings.device,
        weights=settings.weights,
        runtime=settings.runtime,
        precision=settings.precision,
    )
    if "torch" in sys.modules:  # onnxruntime keeps its memory by itself
        keep_freed_memory()
    return codec


def _send(
    sending: _Sending, capture: Capture, session: Session, agent_id: str, stop: threading.Event
) -> bool:
    """Send until the source ends or ``stop`` is set, and tell whether it came to its end."""
    try:
        if sending.lossless:
            _send_lossless(sending, capture, session, agent_id, stop)
        else:
            _send_live(sending, capture, stop)
        capture.raise_failure()
    except (SourceError, TransportError) as err:
        sending.metrics.error(str(err))
        raise
    complete = capture.ended and not stop.is_set()
    if complete:
        sending.metrics.end()  # the server may have missed the last frame
    return complete
