"""Puts a recorded stream back on the network, for live processes: as a new start of its agent."""

import contextlib
import itertools
import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from semcast.agent.peers import READY_S, wait_for_peers, wait_until_ready
from semcast.common.errors import SourceError
from semcast.common.keys import camera_key, channel_key, check_agent_id, rx_key, source_key, tx_key
from semcast.common.messages import MAX_MISSING, ChannelReport, SourceImage, SymbolFrame
from semcast.common.metrics import Metrics
from semcast.common.network_settings import NetworkSettings
from semcast.common.playback import check_part
from semcast.common.recorded_streams import RecordedStream, Symbols, choose_stream, stream_messages
from semcast.common.recording_reader import RecordingReader
from semcast.common.status_beat import StatusBeat
from semcast.common.transport import Session, open_session
from semcast.common.wire import pack

logger = logging.getLogger(__name__)

Played = SymbolFrame | ChannelReport | SourceImage

_CLASSES: dict[str, type[Played]] = {"symbols": SymbolFrame, "channel": ChannelReport, "source": SourceImage}
_NOT_READY = (
    f"in {READY_S:g} s the server has not said that it is ready: see its log; in --mode replay it takes "
    "nothing that is played"
)
#: Between two messages; the recorder's clock may have been set meanwhile, by years on a machine without one.
_LONGEST_PAUSE_S = 60.0


@dataclass(frozen=True, kw_only=True)
class PlaySettings:
    """What is played, and to whom.

    Raises:
        ValueError: A value is out of range.
    """

    file: Path = field(metadata={"help": "recording to play (MCAP)", "positional": True})
    symbols: Symbols = field(
        default="received",
        metadata={
            "help": "received: what the recorded link made of the frames, to a server; transmitted: what the "
            "agent sent, to a channel that runs"
        },
    )
    stream: int | None = field(
        default=None,
        metadata={
            "help": "which start of an agent, counted from 1; semcast info lists them (default the last one "
            "that has frames)"
        },
    )
    agent_id: str | None = field(
        default=None, metadata={"help": "name of an agent to play it as (default the recorded one's)"}
    )
    pace: float = field(default=1.0, metadata={"help": "1: as recorded, 2: twice as fast"})
    start_s: float = field(
        default=0.0, metadata={"help": "leave out what was recorded before this time of the stream"}
    )
    end_s: float | None = field(
        default=None, metadata={"help": "leave out what was recorded after this time"}
    )
    wait: bool = field(
        default=True, metadata={"help": "wait for the server (and the channel) before the first frame"}
    )
    network: NetworkSettings = field(default=NetworkSettings(), metadata={"help": "where the hub is"})

    def __post_init__(self) -> None:
        if self.agent_id is not None:
            check_agent_id(self.agent_id)
        if not 0.01 <= self.pace <= 100.0:
            raise ValueError(f"pace must be in [0.01, 100], got {self.pace:g}")
        check_part(self.start_s, self.end_s)


def _recorded(
    reader: RecordingReader, stream: RecordedStream, start_s: float, end_s: float | None
) -> Iterator[tuple[float, Played]]:
    """Yield a part of what agent and channel sent, of symbols both sides, with seconds since it all began."""
    t_s, before_ns = 0.0, None
    for log_time_ns, found in stream_messages(reader, stream, _CLASSES):
        pause_s = 0.0 if before_ns is None else (log_time_ns - before_ns) * 1e-9
        t_s += min(max(0.0, pause_s), _LONGEST_PAUSE_S)
        before_ns = log_time_ns
        if end_s is not None and t_s > end_s:
            return
        if t_s >= start_s:
            yield t_s, found


class _Sending:
    """A stream on an open session: live, of an agent that started just now, and numbered from 0.

    Args:
        session: Open.
        settings: What is played.
        stream: The same.
        agent_id: Name it is played under.
        metrics: Of the agent: ``sent`` counts what it had sent, ``played`` the frames that are put. Drops:
            ``lost`` (on the air, as lossless recordings tell), ``stale`` (from before the part played) and
            ``unheard`` (nobody takes frames now; told not to wait, it is not asked).
        radio: Of the channel.
    """

    def __init__(
        self,
        session: Session,
        settings: PlaySettings,
        stream: RecordedStream,
        agent_id: str,
        metrics: Metrics,
        radio: Metrics,
    ) -> None:
        #: A server that has seen the stream takes it for a new one all the same.
        self.agent_epoch = time.time_ns()
        self._metrics, self._radio = metrics, radio
        is_received = settings.symbols == "received"
        self._direction = "rx" if is_received else "tx"
        self._asks = settings.wait
        self._first_seq: int | None = None
        self._num_sent = 0
        self._played: set[int] = set()
        camera = pack(replace(stream.camera, agent_id=agent_id, agent_epoch=self.agent_epoch, lossless=False))
        session.answer(camera_key(agent_id), lambda request: camera)
        self._symbols = session.publisher(rx_key(agent_id) if is_received else tx_key(agent_id), "newest")
        self._originals = session.publisher(source_key(agent_id), "newest")
        self._reports = session.publisher(channel_key(agent_id), "newest") if is_received else None
        session.publisher(camera_key(agent_id), "every").put(camera)

    def put(self, message: Played) -> None:
        """Send what is to be sent of a message now."""
        if isinstance(message, SymbolFrame):
            self._put_frame(message)
        elif isinstance(message, SourceImage):
            self._originals.put(pack(replace(message, agent_epoch=self.agent_epoch)))
        elif self._reports is not None:
            self._reports.put(pack(replace(message, agent_epoch=self.agent_epoch)))

    def _put_frame(self, frame: SymbolFrame) -> None:
        """Send a frame of the side that is played, once, as if it were captured now; count those of both."""
        if self._first_seq is None:
            self._first_seq = frame.seq
        seq = frame.seq - self._first_seq
        # One from further ahead tells nothing of how many were sent.
        if 0 < (num_more := seq + 1 - self._num_sent) <= MAX_MISSING:
            self._num_sent += num_more
            for _ in range(num_more):
                self._metrics.count("sent")
        if frame.direction != self._direction or seq in self._played:
            return
        self._played.add(seq)
        if seq < 0 or frame.payload_format == "lost":
            self._metrics.drop("stale" if seq < 0 else "lost")
            return
        if self._asks and not self._symbols.has_receiver:
            self._metrics.drop("unheard")
            return
        as_new = replace(
            frame,
            agent_epoch=self.agent_epoch,
            seq=seq,
            base_seq=0,
            t_capture_ns=time.monotonic_ns(),
            lossless=False,
        )
        self._symbols.put(pack(as_new))
        self._metrics.count("played")
        self._radio.count("carried")


def _play(
    sending: _Sending, messages: Iterator[tuple[float, Played]], pace: float, stop: threading.Event
) -> bool:
    """Send messages at their times, sped up by ``pace``; tell whether all were sent before ``stop``."""
    started_s: float | None = None
    for t_s, message in messages:
        if started_s is None:
            started_s = time.monotonic() - t_s / pace
        if stop.wait(max(0.0, started_s + t_s / pace - time.monotonic())):
            return False
        sending.put(message)
    return not stop.is_set()


def run_play(settings: PlaySettings, stop: threading.Event) -> dict[str, Any]:
    """Play a stream of a recording to its end, or until ``stop`` is set.

    Others see an agent in live mode and, of received symbols, its channel: late ones may ask for the camera,
    and the server learns at the end that all was sent. Images and link are as recorded, also where the server
    reports on them.

    Returns:
        Counts, drops by reason and stage times, with ``agent_epoch``, ``source`` and ``complete``.

    Raises:
        SourceError: The file is no recording, is damaged, or holds no such frames.
        TransportError: Its port is taken, where it is the hub.
    """
    reader = RecordingReader(settings.file)
    stream = choose_stream(reader, settings.stream, settings.symbols)
    messages = _recorded(reader, stream, settings.start_s, settings.end_s)
    first = next(messages, None)
    if first is None:
        length_s = max((t_s for t_s, _ in _recorded(reader, stream, 0.0, None)), default=0.0)
        end = "" if settings.end_s is None else f" and before {settings.end_s:g} s"
        raise SourceError(
            f"nothing of {settings.file} lies after {settings.start_s:g} s{end}: it is {length_s:.1f} s long"
        )
    agent_id = settings.agent_id or stream.agent_id
    metrics, radio = Metrics("agent"), Metrics("channel")
    summary: dict[str, Any] = {"agent_epoch": 0, "source": stream.camera.source_name, "complete": False}
    session = open_session(settings.network, stop)
    if session is None:
        return {**metrics.summary(), **summary}
    is_received = settings.symbols == "received"
    with contextlib.ExitStack() as stack:
        stack.enter_context(session)
        stack.callback(lambda: logger.info("%s", metrics.closing_line("played")))
        sending = _Sending(session, settings, stream, agent_id, metrics, radio)
        roles = {"agent": metrics, "channel": radio} if is_received else {"agent": metrics}
        for role, counted in roles.items():
            beat = StatusBeat(session, agent_id, role, counted, lambda: sending.agent_epoch)
            stack.callback(beat.close)
            session.declare_alive(agent_id, role)
        if settings.wait:
            wait_for_peers(session, agent_id, {"server"} if is_received else {"server", "channel"}, stop)
            is_ready = wait_until_ready(session, agent_id, sending.agent_epoch, stop)
            if not is_ready and not stop.is_set():
                logger.warning("%s", _NOT_READY)
        if not stop.is_set():
            what = f"{settings.file} as {agent_id!r}, {settings.symbols} symbols, pace {settings.pace:g}"
            logger.info("playing %s", what)
        complete = _play(sending, itertools.chain([first], messages), settings.pace, stop)
        if complete:
            metrics.end()
        summary.update(agent_epoch=sending.agent_epoch, complete=complete)
    return {**metrics.summary(), **summary}
