"""The receiving end of a stream: which frames count, in which order, equalised and ready for the decoder."""

import logging
import threading
import time
from collections import OrderedDict, deque
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import ReceivedImage
from semcast.common.complaints import Complaints
from semcast.common.errors import TransportError
from semcast.common.keys import camera_key, channel_key, rx_key
from semcast.common.mailbox import Mailbox
from semcast.common.messages import CameraInfo, ChannelReport, SymbolFrame
from semcast.common.metrics import Metrics
from semcast.common.rate import belongs_to, slots_at
from semcast.common.symbol_payload import equalise_frame
from semcast.common.transport import FRAME_RING_CAPACITY, Session
from semcast.common.wire import WireError, unpack
from semcast.server.announcement import answered_camera
from semcast.server.arrival import Arrivals
from semcast.server.backlog import Backlog
from semcast.server.feedback import WINDOW, Feedback

logger = logging.getLogger(__name__)

Mode = Literal["live", "replay"]

#: Between two questions for a camera: where nobody is there to answer, each comes back at once.
_CAMERA_PAUSE_S = 0.05
_KEPT_REPORTS = 256
_KEPT_CAMERAS = 16


@dataclass(frozen=True)
class ReceivedFrame:
    """One frame behind the equaliser.

    Attributes:
        message: What arrived: ids, times, codec.
        camera: Of the agent that sent it.
        received: What the codec decodes; None when the whole frame was lost on the air, of which the receiver
            learns in replay only.
        snr_db: The receiver's estimate of the link's SNR, None with ``received``.
        snr_db_set: What the channel node says it applied, for plots only; None where it says nothing.
        t_arrival_ns: ``perf_counter_ns`` when the message arrived.
        equalise_ms: Duration of the equaliser.
    """

    message: SymbolFrame
    camera: CameraInfo
    received: ReceivedImage | None
    snr_db: float | None
    snr_db_set: float | None
    t_arrival_ns: int
    equalise_ms: float

    @property
    def slot_snr_db(self) -> NDArray[np.float32] | None:
        """``(num_slots,)`` SNR of each row of blocks of the camera's grid, None when the frame was lost."""
        if self.received is None:
            return None
        return slots_at(self.received.row_snr_db, self.received.shape_hw[0], self.camera.image_wh[1])


class Receiver:
    """Takes the frames of one agent from the network. ``next`` belongs to one thread.

    In ``live`` mode frames wait while a busy moment is worked off, and of a consumer that is too slow the
    newest one wins, see ``Backlog``; in ``replay`` every frame is delivered once and in order, and the
    agent is told how many it may send, and which it may forget: those that are ``done``. Frames of the other
    kind are dropped as ``mode``. What does not get to ``next`` is counted in ``metrics`` by reason, see
    ``Arrivals``; further reasons are ``camera`` (nobody says what the camera is), ``too_old`` and
    ``protocol``. Agents wait until the role ``server`` is alive: the caller declares that, once its decoder
    is ready.

    Args:
        session: An open session.
        agent_id: Whose frames.
        mode: Service.
        metrics: Where to count.
        max_age_ms: Live frames older than this are dropped, but for a source's last one, see ``is_too_old``.
    """

    def __init__(
        self,
        session: Session,
        agent_id: str,
        mode: Mode,
        metrics: Metrics,
        max_age_ms: float = 1000.0,
    ) -> None:
        if mode not in ("live", "replay"):
            raise ValueError(f"mode must be live or replay, got {mode!r}")
        if not max_age_ms > 0:
            raise ValueError(f"max_age_ms must be positive, got {max_age_ms:g}")
        self._session = session
        self._agent_id = agent_id
        self._mode = mode
        self._metrics = metrics
        self._max_age_ms = max_age_ms
        self._complaints = Complaints(metrics)
        self._lock = threading.Lock()
        self._arrivals = Arrivals(
            lossless=mode == "replay",
            drop=metrics.drop,
            tell=lambda text: self._complaints.tell("ahead", text),
        )
        self._box: Backlog[tuple[SymbolFrame, int]] | Mailbox[tuple[SymbolFrame, int]] = (
            Backlog() if mode == "live" else Mailbox(4 * WINDOW, "newest")
        )
        self._held: tuple[SymbolFrame, int] | None = None
        self._cameras: dict[int, CameraInfo] = {}
        self._early: deque[tuple[SymbolFrame, int]] = deque()
        self._snr_set: OrderedDict[tuple[int, int], float] = OrderedDict()
        self._num_superseded = self._num_given_way = 0
        self._roles: set[str] = set()
        #: Of a stream that has ended: epoch, frames sent, and how many behind the newest count as missing.
        self._end = (0, 0, 0)
        self._feedback = Feedback(session, agent_id, metrics, self._how_far if mode == "replay" else None)
        self._stopping = threading.Event()
        session.subscribe(camera_key(agent_id), "every", self._on_camera)
        session.subscribe(channel_key(agent_id), "newest", self._on_report, FRAME_RING_CAPACITY)
        session.watch_alive(agent_id, self._on_alive)
        session.subscribe(rx_key(agent_id), "newest", self._on_symbols, FRAME_RING_CAPACITY)
        self._feedback.begin()  # where nothing can fail any more: nobody could close it

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    @property
    def roles_alive(self) -> frozenset[str]:
        """Roles of this stream that are alive now."""
        with self._lock:
            return frozenset(self._roles)

    @property
    def agent_epoch(self) -> int:
        """Epoch of the newest agent heard, 0 before the first frame."""
        with self._lock:
            return self._arrivals.epoch

    @property
    def quiet_s(self) -> float:
        """Time since the newest frame that counts arrived."""
        with self._lock:
            return (time.perf_counter_ns() - self._arrivals.taken_ns) * 1e-9

    def count_missing(self, agent_epoch: int, num_sent: int | None) -> None:
        """Count the frames behind the newest that never came, of so many that were sent; None: not known.

        Those that come all the same are taken off again.
        """
        if num_sent is None or self._mode != "live":
            return
        with self._lock:
            if self._arrivals.epoch not in (0, agent_epoch):
                return  # the agent was started again: what arrived before that is not known any more
            counted = self._end[2] if self._end[0] == agent_epoch else 0
            self._end = agent_epoch, num_sent, counted
            self._count_behind()

    def _count_behind(self) -> None:
        """Bring the count of frames missing behind the newest up to date; the lock is held."""
        agent_epoch, num_sent, counted = self._end
        arrived_seq = self._arrivals.arrived_seq if agent_epoch == self._arrivals.epoch else 0
        behind = max(0, num_sent - arrived_seq)
        self._metrics.drop("missing", behind - counted)
        self._end = agent_epoch, num_sent, behind

    def _on_alive(self, role: str, alive: bool | None) -> None:
        with self._lock:
            known = role in self._roles
            (self._roles.add if alive else self._roles.discard)(role)
        if alive is not None and known != alive and role != "server":
            logger.info("%s %s", role, "is there" if alive else "is gone")

    def _on_camera(self, payload: bytes) -> None:
        try:
            camera = unpack(payload, CameraInfo)
        except WireError as err:
            self._complaints.refuse(err)
            return
        self._keep(camera)

    def _keep(self, camera: CameraInfo) -> None:
        with self._lock:
            # The one announced last stays: that of an agent whose clock was set back has the lowest epoch.
            self._cameras.pop(camera.agent_epoch, None)
            self._cameras[camera.agent_epoch] = camera
            while len(self._cameras) > _KEPT_CAMERAS:
                del self._cameras[next(iter(self._cameras))]
            self._arrivals.announced(camera.agent_epoch)
            early = [entry for entry in self._early if entry[0].agent_epoch == camera.agent_epoch]
            self._early = deque(entry for entry in self._early if entry not in early)
        for frame, arrival_ns in early:
            self._sort(frame, arrival_ns)

    def _on_report(self, payload: bytes) -> None:
        try:
            report = unpack(payload, ChannelReport)
        except WireError as err:
            self._complaints.refuse(err)
            return
        with self._lock:
            self._snr_set[(report.agent_epoch, report.frame_id)] = report.snr_db_set
            while len(self._snr_set) > _KEPT_REPORTS:
                self._snr_set.popitem(last=False)

    def _on_symbols(self, payload: bytes) -> None:
        arrival_ns = time.perf_counter_ns()
        try:
            frame = unpack(payload, SymbolFrame)
            if frame.direction != "rx":
                raise WireError("kind", f"frame must be rx, got {frame.direction}")
        except WireError as err:
            self._complaints.refuse(err)
            return
        if frame.lossless != (self._mode == "replay"):
            self._metrics.drop("mode")
            self._tell_of_mode(frame.lossless)
        else:
            self._sort(frame, arrival_ns)
        self._metrics.count("received")

    def takes(self, camera: CameraInfo) -> bool:
        """Tell whether frames of a stream that is announced will count; say why where they will not."""
        if camera.lossless != (self._mode == "replay"):
            self._tell_of_mode(camera.lossless)
            return False
        return True

    def _tell_of_mode(self, lossless: bool) -> None:
        there = "replay" if lossless else "live"
        what = "" if lossless else ", live for 'semcast play'"
        self._complaints.tell(
            "mode", f"the agent runs in {there} mode, this server in {self._mode}: give both one --mode{what}"
        )

    def _sort(self, frame: SymbolFrame, arrival_ns: int) -> None:
        with self._lock:
            new_epoch = frame.agent_epoch != self._arrivals.epoch
            camera = self._cameras.get(frame.agent_epoch)
            if camera is None and self._arrivals.waits_for_camera(frame, arrival_ns):
                self._keep_early(frame, arrival_ns)
                return
            step = camera.frame_step if camera is not None else 1
            taken = self._arrivals.accept(frame, arrival_ns, step, is_announced=camera is not None)
            if taken and new_epoch:
                dropped = self._box.clear()
                self._metrics.drop("epoch", dropped)
                self._num_superseded = 0
            if taken and frame.agent_epoch == self._end[0]:
                self._count_behind()
            if taken:
                self._box.put((frame, arrival_ns))
                self._count_superseded()
        self._feedback.send_flow()

    def _keep_early(self, frame: SymbolFrame, arrival_ns: int) -> None:
        """Keep a frame that overtook what its agent says about itself; the lock is held."""
        self._early.append((frame, arrival_ns))
        if len(self._early) > FRAME_RING_CAPACITY:
            self._early.popleft()
            self._metrics.drop("camera")
            self._complaints.tell("early", "frames arrive of an agent that does not say what its camera is")

    def _count_superseded(self) -> None:
        """Count what gave way to newer frames since the last time; the lock is held."""
        superseded = self._box.dropped - self._num_given_way
        self._num_given_way += superseded
        self._num_superseded += superseded
        self._metrics.drop("superseded", superseded)

    def announce_ready(self, agent_epoch: int) -> None:
        """Tell a live agent that everything is set up for its first frame; it waits for this."""
        self._feedback.announce_ready(agent_epoch)

    def _how_far(self) -> tuple[int, int, int]:
        with self._lock:
            return self._arrivals.epoch, self._arrivals.next_seq, self._arrivals.arrived_seq

    def next(self, timeout_s: float) -> ReceivedFrame | None:
        """Return the next frame, None when there is none in time; tell when it is ``done``."""
        deadline_s = time.monotonic() + timeout_s
        while not self._stopping.is_set():
            entry = self._take_held() or self._box.get(max(0.0, deadline_s - time.monotonic()))
            with self._lock:
                self._count_superseded()
            if entry is None:
                return None
            frame = self._prepare(*entry)
            if frame is not None:
                return frame
            if self._held is not None:
                remaining_s = deadline_s - time.monotonic()
                if remaining_s <= 0.0:
                    return None
                self._stopping.wait(min(remaining_s, _CAMERA_PAUSE_S))
        return None

    def _take_held(self) -> tuple[SymbolFrame, int] | None:
        """Return the frame that waits for its camera.

        An agent that was restarted never says what the camera of its former start was: that start's frame is
        dropped, or none of the new one would ever be reached.
        """
        held, self._held = self._held, None
        if held is None:
            return None
        with self._lock:
            current = held[0].agent_epoch == self._arrivals.epoch
        if not current:
            self._metrics.drop("epoch")
            return None
        return held

    def is_too_old(self, message: SymbolFrame) -> bool:
        """Tell whether a frame is older than live frames may be, and count it as dropped if so."""
        with self._lock:
            age_ms = self._arrivals.age_ms(message, time.perf_counter_ns())
        # The final one ends the stream.
        is_too_old = self._mode == "live" and age_ms > self._max_age_ms and not message.final
        if is_too_old:
            self._metrics.drop("too_old")
        return is_too_old

    def _prepare(self, message: SymbolFrame, arrival_ns: int) -> ReceivedFrame | None:
        if self.is_too_old(message):
            return None
        camera = self._camera_of(message.agent_epoch)
        if camera is None:
            self._complaints.tell("camera", "frames arrive, but the agent does not say what its camera is")
            if self._mode == "live":
                self._metrics.drop("camera")
            else:
                self._held = (message, arrival_ns)
            return None
        received, snr_db, equalise_ms = None, None, 0.0
        if message.payload_format == "lost":
            self._metrics.count("lost_on_air")
        elif not belongs_to(message.image_hw, camera.intrinsics.shape_hw):
            self._metrics.drop("protocol")
            self._complaints.tell(
                "size",
                f"frames are {message.image_hw}, no coded size of the camera's {camera.intrinsics.shape_hw}",
            )
            self.done(message)
            return None
        else:
            started_ns = time.perf_counter_ns()
            equalised = equalise_frame(message)
            equalise_ms = (time.perf_counter_ns() - started_ns) * 1e-6
            received, snr_db = equalised.received, float(equalised.snr_db)
            self._metrics.observe("equalise", equalise_ms)
            self._feedback.report(message, equalised, self._num_superseded_of(message))
        self._metrics.count("delivered")
        with self._lock:
            snr_db_set = self._snr_set.get((message.agent_epoch, message.frame_id))
        return ReceivedFrame(
            message=message,
            camera=camera,
            received=received,
            snr_db=snr_db,
            snr_db_set=snr_db_set,
            t_arrival_ns=arrival_ns,
            equalise_ms=equalise_ms,
        )

    def done(self, message: SymbolFrame) -> None:
        """Note that nothing more is done with a frame, whatever came of it.

        In replay this lets the agent send another and forget this one: one that was received but not tracked
        would be missing if the server ended now.
        """
        with self._lock:
            self._arrivals.done(message)
        self._feedback.send_flow()

    def _camera_of(self, epoch: int) -> CameraInfo | None:
        with self._lock:
            camera = self._cameras.get(epoch)
        if camera is not None:
            return camera
        try:
            camera = answered_camera(self._session, self._agent_id, epoch)
        except TransportError:
            return None
        if camera is not None:
            self._keep(camera)
        return camera

    def _num_superseded_of(self, message: SymbolFrame) -> int:
        with self._lock:
            return self._num_superseded if message.agent_epoch == self._arrivals.epoch else 0

    def close(self) -> None:
        """Take no more frames. Idempotent; subscriptions end with the session."""
        self._stopping.set()
        self._box.close()
        self._feedback.close()
