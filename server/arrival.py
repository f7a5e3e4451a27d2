"""Which of the frames that arrive count: agent epochs, duplicates, order, gaps, and how old a frame is."""

from collections import deque
from collections.abc import Callable

from semcast.common.messages import MAX_MISSING, SymbolFrame

#: An agent that was silent this long may come back with a clock set to the past.
SILENCE_NS = 3_000_000_000
#: Clocks drift: ages are told by the smallest offset of this time and the same before it.
_OFFSET_WINDOW_NS = 10_000_000_000
#: A frame that was captured so much later than others, by their arrival, has a wrong time.
_MAX_LEAD_NS = 1_000_000_000
#: Numbers of frames that are remembered, to know those that come twice.
_REMEMBERED = 256
#: A live agent sends fewer frames a second than this.
_MAX_RATE_HZ = 1000.0
#: Frames in a row whose numbers rise, or whose times are ahead, and follow on nothing, before they are taken
#: for the stream; so many, too, show that the one they don't follow on was wrong.
_BELIEVED = 3


class CaptureAge:
    """How old frames are, without a common clock.

    The offset between the two clocks plus the fastest way is the smallest ``arrival - capture`` of the last
    10 to 20 seconds; what a frame took more than that is its age. One frame from the future would make all
    others too old, so an offset far below is believed only of several in a row, with which all begins anew.
    The first frame, by which there is nothing to judge, holds until several in a row are far above it.
    """

    def __init__(self) -> None:
        self._current_ns: int | None = None
        self._previous_ns: int | None = None
        self._since_ns = 0
        self._num_ahead = self._num_behind = 0
        self._is_alone = True  # no frame since the one all began with agrees with it

    def arrived(self, t_capture_ns: int, t_arrival_ns: int) -> None:
        """Learn from a frame."""
        offset_ns = t_arrival_ns - t_capture_ns
        smallest_ns = self._smallest_ns()
        if smallest_ns is not None and offset_ns < smallest_ns - _MAX_LEAD_NS:
            self._num_ahead += 1
            if self._num_ahead < _BELIEVED:
                return
            self._begin_anew()
        elif smallest_ns is not None and self._is_alone and offset_ns > smallest_ns + _MAX_LEAD_NS:
            self._num_behind += 1
            if self._num_behind == _BELIEVED:
                self._begin_anew()
        else:
            self._is_alone = smallest_ns is None
        self._num_ahead = 0
        if self._current_ns is None or t_arrival_ns - self._since_ns > _OFFSET_WINDOW_NS:
            # After a longer silence all is older: an agent that was suspended has its clock stand still.
            is_recent = t_arrival_ns - self._since_ns <= 2 * _OFFSET_WINDOW_NS
            self._previous_ns, self._current_ns = self._current_ns if is_recent else None, offset_ns
            self._since_ns = t_arrival_ns
        self._current_ns = min(self._current_ns, offset_ns)

    def _begin_anew(self) -> None:
        self._current_ns = self._previous_ns = None
        self._num_behind, self._is_alone = 0, True

    def _smallest_ns(self) -> int | None:
        known = (self._current_ns, self._previous_ns)
        return min((offset_ns for offset_ns in known if offset_ns is not None), default=None)

    def age_ms(self, t_capture_ns: int, now_ns: int) -> float:
        """Return the age of a frame; 0 before anything arrived, and for one from the future."""
        smallest_ns = self._smallest_ns()
        return max(0.0, (now_ns - t_capture_ns - smallest_ns) * 1e-6) if smallest_ns is not None else 0.0


class Arrivals:
    """State of one stream at the receiver. Not synchronised.

    Live: the newest frame seen sets the pace. Reasons of drops: ``duplicate``, ``stale`` (older than one that
    came before it), ``epoch`` (of an agent that was restarted since), ``missing`` (never arrived: seen by the
    gap in ``seq``; taken back if the frame turns up late), ``ahead`` (numbered, or with a ``frame_id``, as no
    agent can have got to). When nothing else comes for three seconds, the numbering of what is refused is the
    one that holds; at once where that is against a single frame, the first one, which there was nothing to
    judge by.

    Lossless: only the frame that follows the last one is taken. Reasons: ``duplicate``, ``epoch``, ``ahead``
    (of its numbers or its ``frame_id``), ``gap`` (one before it is missing; the agent will send both again),
    ``missing`` (another receiver confirmed it).

    A new epoch is believed if somebody says what its camera is, otherwise only when no other's frames come.

    Args:
        lossless: Which of the two.
        drop: Is told reason and count.
        tell: Is told in a line why a frame is ``ahead``.

    Attributes:
        epoch: Of the newest agent, 0 before the first frame.
        arrived_seq: First frame that has not arrived.
        next_seq: Lossless: first frame the consumer is not done with.
        taken_ns: When the newest frame that counts arrived, 0 before the first.
    """

    def __init__(
        self,
        *,
        lossless: bool,
        drop: Callable[[str, int], None],
        tell: Callable[[str], None] = lambda text: None,
    ) -> None:
        self.epoch = 0
        self.arrived_seq = 0
        self.next_seq = 0
        self.taken_ns = 0
        self._lossless = lossless
        self._drop = drop
        self._tell = tell
        self._last_ns = 0
        self._num_taken = 0  # of this epoch and numbering
        self._is_announced = False
        self._odd_in_order, self._odd_seq = 0, 0
        self._frame_id: int | None = None  # of the newest frame taken
        self._leaps_in_order, self._leap_id = 0, 0
        self._left_out: set[int] = set()  # numbers, not passed yet, of frames with an id that leaps
        self._recent: deque[int] = deque()
        self._forgotten_seq = 0  # the newest one that may have come without being remembered
        self._done_early: set[int] = set()
        self._age = CaptureAge()

    def accept(
        self, frame: SymbolFrame, arrival_ns: int, frame_step: int = 1, *, is_announced: bool = True
    ) -> bool:
        """Tell whether a frame counts, and count it under its reason where it does not.

        Args:
            frame: That arrived.
            arrival_ns: When.
            frame_step: Usual difference of the ids of two frames, see ``CameraInfo.frame_step``.
            is_announced: It is known what the camera of the frame's epoch is.
        """
        if frame.agent_epoch != self.epoch:
            if not self._takes_over(frame, arrival_ns, is_announced=is_announced):
                self._drop("epoch", 1)
                return False
            self._start(frame)
            self._is_announced = is_announced
        self._last_ns = arrival_ns
        if not self._lossless and frame.seq in self._recent:
            self._drop("duplicate", 1)
            return False
        if self._is_odd(frame, arrival_ns):
            if not self._is_believed(self._odd_in_order, arrival_ns):
                self._refuse(frame)
                return False
            # One message with a number out of nowhere must not shut out all others for good.
            self._start(frame)
        if self._lossless and not self._is_next(frame):
            return False
        if self._leaps(frame, arrival_ns, frame_step) and not self._is_believed(
            self._leaps_in_order, arrival_ns
        ):
            # Once tracked, it would make frames of all ids below it count as tracked too.
            self._left_out.add(frame.seq)
            self._drop("ahead", 1)
            self._tell(f"frame {frame.frame_id} is left out: it can't follow frame {self._frame_id}")
            return False
        self._pass_over(frame.seq)
        self._odd_in_order = self._leaps_in_order = 0
        self.arrived_seq = frame.seq + 1
        self._frame_id = frame.frame_id
        self.taken_ns = arrival_ns
        self._num_taken += 1
        self._remember(frame.seq)
        self._age.arrived(frame.t_capture_ns, arrival_ns)
        return True

    def announced(self, agent_epoch: int) -> None:
        """Note that it is known from now on what the camera of an epoch is."""
        self._is_announced |= agent_epoch == self.epoch

    def waits_for_camera(self, frame: SymbolFrame, arrival_ns: int) -> bool:
        """Tell whether a frame would count if it were known what the camera of its epoch is."""
        return (
            frame.agent_epoch != self.epoch
            and self._takes_over(frame, arrival_ns, is_announced=True)
            and not self._takes_over(frame, arrival_ns, is_announced=False)
        )

    def _takes_over(self, frame: SymbolFrame, arrival_ns: int, *, is_announced: bool) -> bool:
        """Tell whether a frame of another epoch ends the present one."""
        if self.epoch == 0 or arrival_ns - self._last_ns > SILENCE_NS:
            return True
        if is_announced != self._is_announced:
            return is_announced
        return frame.agent_epoch > self.epoch

    def _is_next(self, frame: SymbolFrame) -> bool:
        """Tell whether a lossless frame is the one that follows, and count it where it is not."""
        # What a receiver before this one confirmed never comes again. The frame this one began with may have
        # been on its way for long, and not know of it yet.
        confirmed = max(0, frame.base_seq - self.arrived_seq)
        if self._num_taken:
            self._drop("missing", confirmed)
        self.arrived_seq += confirmed
        self.next_seq = max(self.next_seq, frame.base_seq)
        if frame.seq != self.arrived_seq:
            self._drop("duplicate" if frame.seq < self.arrived_seq else "gap", 1)
        return frame.seq == self.arrived_seq

    def _pass_over(self, seq: int) -> None:
        """Count the frames before the next one as missing, but for those that came and were left out."""
        left_out = {k for k in self._left_out if self.arrived_seq <= k < seq}
        self._drop("missing", seq - self.arrived_seq - len(left_out))
        for k in left_out:
            self._remember(k)
        self._left_out.clear()

    def _is_odd(self, frame: SymbolFrame, arrival_ns: int) -> bool:
        """Tell whether a frame's number is not one that can follow, or come again; count those that rise."""
        if self._lossless:
            follows = max(frame.base_seq - self.arrived_seq, self.arrived_seq - frame.seq) <= MAX_MISSING
        else:
            follows = 0 <= frame.seq - self.arrived_seq <= self._farthest(arrival_ns)
        if follows:
            return False
        self._odd_in_order = self._odd_in_order + 1 if frame.seq > self._odd_seq else 1
        self._odd_seq = frame.seq
        return True

    def _leaps(self, frame: SymbolFrame, arrival_ns: int, frame_step: int) -> bool:
        """Tell whether a frame's id is above all that can follow; count those that do not fall.

        Where it falls, the frame is one that was tracked before, and the consumer's business.
        """
        if self._frame_id is None:
            return False
        if frame.frame_id - self._frame_id <= frame_step * (1 + self._farthest(arrival_ns)):
            return False
        self._leaps_in_order = self._leaps_in_order + 1 if frame.frame_id >= self._leap_id else 1
        self._leap_id = frame.frame_id
        return True

    def _farthest(self, arrival_ns: int) -> float:
        """Return how many frames an agent can have gone on since the newest that was taken."""
        return MAX_MISSING + (arrival_ns - self.taken_ns) * 1e-9 * _MAX_RATE_HZ

    def _is_believed(self, num_in_order: int, arrival_ns: int) -> bool:
        against_one = self._num_taken <= 1
        return num_in_order >= _BELIEVED and (against_one or arrival_ns - self.taken_ns > SILENCE_NS)

    def _refuse(self, frame: SymbolFrame) -> None:
        if frame.seq > self.arrived_seq:
            self._drop("ahead", 1)
            self._tell(f"a frame is left out: number {frame.seq} can't follow number {self.arrived_seq - 1}")
            return
        if self._lossless:
            self._drop("duplicate", 1)
            return
        # It was counted as missing when a later one came, unless that was before this receiver's time, or it
        # came and is no longer remembered.
        if frame.seq > self._forgotten_seq:
            self._drop("missing", -1)
        self._remember(frame.seq)
        self._drop("stale", 1)

    def _remember(self, seq: int) -> None:
        if len(self._recent) == _REMEMBERED:
            self._forgotten_seq = max(self._forgotten_seq, self._recent.popleft())
        self._recent.append(seq)

    def _start(self, frame: SymbolFrame) -> None:
        """Take up a stream, from its first unconfirmed frame, or where it is now."""
        self.epoch = frame.agent_epoch
        self.arrived_seq = frame.base_seq if self._lossless else frame.seq
        self.next_seq = self.arrived_seq
        self._forgotten_seq = self.arrived_seq
        self._num_taken = self._odd_in_order = self._leaps_in_order = 0
        self._frame_id = None
        self._left_out.clear()
        self._recent.clear()
        self._done_early.clear()
        self._age = CaptureAge()

    def done(self, frame: SymbolFrame) -> None:
        """Note that the consumer is done with a frame; lossless: it counts once those before it are done too.

        A frame that is refused is done while the one before it is still in work.
        """
        if frame.agent_epoch != self.epoch:
            return
        self._done_early.add(frame.seq)
        if not self._lossless or len(self._done_early) > _REMEMBERED:
            # Some before it never came to the consumer: the sender does not keep to the window.
            self.next_seq = max(self.next_seq, frame.seq + 1)
        while self.next_seq in self._done_early:
            self.next_seq += 1
        self._done_early = {seq for seq in self._done_early if seq > self.next_seq}

    def age_ms(self, frame: SymbolFrame, now_ns: int) -> float:
        """Return how old a frame is; 0 for one of a former epoch."""
        return self._age.age_ms(frame.t_capture_ns, now_ns) if frame.agent_epoch == self.epoch else 0.0
