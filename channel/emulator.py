"""The channel process: takes the agent's symbols, does to them what a radio link does, passes them on."""

import contextlib
import logging
import math
import threading
from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

from semcast.channel.delay import DelayLine, extra_delay_ms
from semcast.channel.emulator_settings import EmulatorSettings
from semcast.channel.link import Link
from semcast.channel.registry import build_channel
from semcast.channel.settings import MAX_DOPPLER_SLOT, ChannelSettings
from semcast.channel.silence import Silence
from semcast.common.complaints import Complaints
from semcast.common.config import build_settings, settings_to_dict
from semcast.common.errors import ConfigError, SemcastError, TransportError
from semcast.common.keys import channel_key, control_key, rx_key, tx_key
from semcast.common.mailbox import Mailbox
from semcast.common.message_fields import sendable
from semcast.common.messages import MAX_MISSING, ChannelReport, ControlReply, ControlRequest, SymbolFrame
from semcast.common.metrics import Metrics
from semcast.common.network_settings import NetworkSettings
from semcast.common.phy.pilots import insert_pilots
from semcast.common.status_beat import StatusBeat
from semcast.common.symbol_payload import data_symbols, pack_iq, pack_lost
from semcast.common.transport import FRAME_RING_CAPACITY, Session, open_client, open_session
from semcast.common.wire import WireError, pack, unpack
from semcast.common.worker_guard import WorkerGuard

logger = logging.getLogger(__name__)

ROLE = "channel"
_POLL_S = 0.1
#: How long a hub, and then a channel, has to answer who changes its settings.
_ANSWER_S = 3.0
_REPLAY_CAPACITY = 64
#: Frames that an agent may send again: more than it ever has under way.
_REMEMBERED = 1024


class Emulator:
    """One stream's channel on a session. ``work`` runs in one thread, settings change from any.

    Args:
        session: Open.
        settings: Of the process.
        metrics: Where to count. Drops: ``superseded`` by a newer frame while busy, ``lost`` on the air,
            ``missing`` (gaps in what the agent sent), ``protocol``, ``carry`` (an error nobody foresaw),
            ``overflow`` (too many are delayed), ``unsent`` (one that was carried could not be sent on).
    """

    def __init__(self, session: Session, settings: EmulatorSettings, metrics: Metrics) -> None:
        self._settings = settings
        self._metrics = metrics
        self._complaints = Complaints(metrics)
        self._link = Link(settings.link, settings.seed)
        self._link_lock = threading.Lock()
        self._control_lock = threading.Lock()  # one change after the other, while frames pass
        self._box: Mailbox[SymbolFrame] = Mailbox(1, "newest")
        self._epoch = 0
        self._carried: deque[int] = deque(maxlen=_REMEMBERED)
        self._silence = Silence(settings.agent_id)
        self._arrived_epoch = 0
        self._arrived_seq = 0
        self._far_seq = 0
        agent_id = settings.agent_id
        self._live = session.publisher(rx_key(agent_id), "newest")
        self._lossless = session.publisher(rx_key(agent_id), "every")
        self._reports = session.publisher(channel_key(agent_id), "newest")
        session.answer(control_key(agent_id, ROLE), self._on_request)
        session.watch_alive(agent_id, self._silence.on_alive)
        session.subscribe(tx_key(agent_id), "newest", self._on_symbols, FRAME_RING_CAPACITY)
        # Last, as it has a thread that nobody would end if one of the others failed.
        self._delay = DelayLine(self._send, self._on_unsent)

    @property
    def agent_epoch(self) -> int:
        """Epoch of the last frame, 0 before the first."""
        return self._epoch

    def _on_symbols(self, payload: bytes) -> None:
        try:
            frame = unpack(payload, SymbolFrame)
            if frame.direction != "tx":
                raise WireError("kind", f"frame must be tx, got {frame.direction}")
        except WireError as err:
            self._complaints.refuse(err)
            return
        self._metrics.count("received")
        self._count_missing(frame)
        # A lossless agent never has more frames under way than this; a live one is served its newest.
        self._box.resize(_REPLAY_CAPACITY if frame.lossless else 1)
        self._metrics.drop("superseded", self._box.put(frame) or 0)

    def _count_missing(self, frame: SymbolFrame) -> None:
        """Count the frames before this one that never came; what is sent again opens no gap."""
        if frame.agent_epoch != self._arrived_epoch:
            self._arrived_epoch, self._arrived_seq = frame.agent_epoch, frame.seq
        num_missing = max(0, frame.seq - self._arrived_seq)
        before_seq, self._far_seq = self._far_seq, frame.seq
        if num_missing > MAX_MISSING:  # believed when another follows on it
            if not 0 < frame.seq - before_seq <= MAX_MISSING:
                return
            num_missing -= 1  # the one before came
        self._metrics.drop("missing", num_missing)
        self._arrived_seq = max(self._arrived_seq, frame.seq + 1)

    def work(self, stop: threading.Event) -> None:
        """Carry frames until ``stop`` is set."""
        carrying = WorkerGuard("carrying a frame", self._on_uncarried)
        while not stop.is_set():
            frame = self._box.get(_POLL_S)
            if frame is None:
                self._silence.check()
                continue
            self._silence.on_frame()
            with carrying:
                try:
                    with self._metrics.stage("channel"):
                        self._carry(frame)
                except (ValueError, SemcastError) as err:
                    self._metrics.drop("protocol")
                    self._complaints.tell("frame", f"frame {frame.frame_id} is left out: {err}")

    def _carry(self, frame: SymbolFrame) -> None:
        self._follow(frame)
        symbols = data_symbols(frame)
        with self._link_lock:
            settings = self._link.settings
            sent = self._link.transmit(insert_pilots(symbols), frame.t_source_ns * 1e-9, frame.frame_id)
        self._reports.put(
            pack(
                ChannelReport(
                    agent_epoch=frame.agent_epoch,
                    frame_id=frame.frame_id,
                    channel=settings.channel,
                    snr_db_set=float(sent.snr_db_set),
                    num_slots=frame.num_slots,
                    num_slots_lost=int(sent.slot_lost.sum()),
                    frame_lost=sent.frame_lost,
                )
            )
        )
        # What is sent again meets the same fate, which is counted once.
        again = frame.seq in self._carried
        if not again:
            self._carried.append(frame.seq)
        if sent.frame_lost:
            self._metrics.drop("lost", 0 if again else 1)
            if not frame.lossless:
                return
        received = replace(
            frame,
            direction="rx",
            payload_format="lost" if sent.frame_lost else "iq16",
            payload=b"" if sent.frame_lost else pack_iq(sent.slots_rx),
            slot_lost=pack_lost(sent.slot_lost),
        )
        extra_ms = extra_delay_ms(settings.jitter_ms, self._settings.seed, frame.frame_id)
        if self._delay.put(pack(received), frame.lossless, settings.delay_ms + extra_ms):
            self._metrics.count("carried_again" if again else "carried")
        else:
            self._metrics.drop("overflow")

    def _follow(self, frame: SymbolFrame) -> None:
        """Start anew for a restarted agent."""
        if frame.agent_epoch != self._epoch:
            self._epoch = frame.agent_epoch
            self._carried.clear()
            with self._link_lock:
                self._link.restart()

    def _send(self, packet: bytes, lossless: bool) -> None:
        try:
            (self._lossless if lossless else self._live).put(packet)
        except TransportError as err:
            self._on_unsent(str(err))

    def _on_uncarried(self, text: str) -> None:
        self._metrics.drop("carry")
        self._metrics.error(text)

    def _on_unsent(self, text: str) -> None:
        self._metrics.drop("unsent")
        self._metrics.error(text)

    def _on_request(self, payload: bytes) -> bytes:
        try:
            request = unpack(payload, ControlRequest)
            return pack(ControlReply(ok=True, settings=self._control(request)))
        except SemcastError as err:
            return pack(ControlReply(ok=False, error=sendable(str(err), 1000)))

    def _control(self, request: ControlRequest) -> dict[str, Any]:
        if request.op not in ("get", "set"):
            raise ConfigError(f"op must be get or set, got {request.op!r}")
        with self._control_lock:
            if request.op == "set" and request.settings:
                current = settings_to_dict(self._link.settings)
                changed = build_settings(ChannelSettings, {**current, **request.settings})
                model = build_channel(changed, self._settings.seed)
                with self._link_lock:
                    self._link.switch(changed, model)
                logger.info("channel set: %s", ", ".join(f"{k}={v}" for k, v in request.settings.items()))
                warn_of_settings(changed, request.settings)
            in_force = settings_to_dict(self._link.settings)
        # Given on the command line, the name of a file may be no text.
        return {k: sendable(v, 1000) if isinstance(v, str) else v for k, v in in_force.items()}

    def close(self) -> None:
        """End the delay line's thread. Idempotent."""
        self._box.close()
        self._delay.close()


def warn_of_settings(link: ChannelSettings, given: Collection[str] | None = None) -> None:
    """Say which values do nothing as long as the channel is what it is, and which no real link is like.

    Args:
        link: In force.
        given: Names of the values that somebody set just now; None takes those that are not the default.
    """
    idle = link.without_effect(given)
    if idle:
        logger.warning("%s: no effect on channel %s as it is set", ", ".join(idle), link.channel)
    if link.fades_within_slots and (
        given is None or not {"channel", "doppler_hz", "slot_ms"}.isdisjoint(given)
    ):
        logger.warning(
            "doppler_hz times slot_ms should be at most %g, got %g: a real link would fade within slots",
            *(MAX_DOPPLER_SLOT, link.doppler_hz * link.slot_ms),
        )


def run_channel(settings: EmulatorSettings, stop: threading.Event) -> dict[str, Any]:
    """Run the channel process until ``stop`` is set.

    Args:
        settings: Of the process.
        stop: Ends it.

    Returns:
        Counts, drops by reason and stage times.

    Raises:
        ConfigError: A trace can't be read.
        TransportError: Its port is taken, where it is the hub.
    """
    metrics = Metrics(ROLE)
    Link(settings.link, settings.seed)  # a trace that can't be read is told before any wait
    session = open_session(settings.network, stop)
    if session is None:
        return metrics.summary()
    with contextlib.ExitStack() as stack:
        stack.enter_context(session)
        stack.callback(lambda: logger.info("%s", metrics.closing_line("carried")))
        emulator = Emulator(session, settings, metrics)
        beat = StatusBeat(session, settings.agent_id, ROLE, metrics, lambda: emulator.agent_epoch)
        stack.callback(beat.close)
        stack.callback(emulator.close)
        session.declare_alive(settings.agent_id, ROLE)
        link = settings.link
        snr = f"that of {link.trace_file}" if link.has_own_snr else link.snr_label
        logger.info("channel %s, SNR: %s", link.channel, snr)
        warn_of_settings(settings.link)
        emulator.work(stop)
    return metrics.summary()


def set_channel(network: NetworkSettings, agent_id: str, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Change the settings of a running channel, or read them with no changes.

    Args:
        network: Where the hub is.
        agent_id: Whose channel.
        changes: Fields of ``ChannelSettings`` and their new values.

    Returns:
        All settings now in force.

    Raises:
        ConfigError: A value is no number, or the channel refused; the message is its own.
        TransportError: No hub or no channel answered.
    """
    for name, value in changes.items():
        if isinstance(value, float) and not math.isfinite(value):  # no message carries it
            build_settings(ChannelSettings, {name: value})
    op = "set" if changes else "get"
    plain = {name: str(value) if hasattr(value, "__fspath__") else value for name, value in changes.items()}
    with open_client(network, _ANSWER_S) as session:
        answer = session.request(
            control_key(agent_id, ROLE), pack(ControlRequest(op=op, settings=plain)), _ANSWER_S
        )
        others = [] if answer is not None else session.alive_agents()
    if answer is None:
        names = ", ".join(name for name in others if name != agent_id)
        meant = f" --agent-id says which is meant; there are agents {names}" if names else ""
        raise TransportError(f"no channel of {agent_id} answers: is 'semcast channel' running?{meant}")
    reply = unpack(answer, ControlReply)
    if not reply.ok:
        raise ConfigError(reply.error)
    return reply.settings
