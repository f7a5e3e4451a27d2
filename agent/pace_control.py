"""How many of the camera's frames are sent: every one, or one in two, three, ... if the server can't keep up.

Frames that a server passes over because newer ones came have cost encoding and air time for nothing, and it
is chance which ones they are. One in n, evenly spaced, costs less and is easier to follow.
"""

import logging
import math
import statistics
import threading
from collections import deque
from itertools import pairwise

from semcast.common.messages import LinkReport

logger = logging.getLogger(__name__)

#: Frames a second that two cores can decode, track and map, about: a stream begins with so many.
START_HZ = 12.0
#: By then it is seen how many a camera gives: in the dark fewer than it says, over a network any number.
_START_S = 1.0
#: From so many steps between frames, all but the longest: a camera may pause after its first frame.
_START_STEPS = 8
#: A camera of 30 Hz before a server that takes a second a frame.
MAX_STRIDE = 30
#: Reports a decision is made from, at least,
_MIN_REPORTS = 12
#: and at most.
_MAX_REPORTS = 16
#: Fewer do where a server takes so long for them: the slower it is, the longer it would be sent too much.
_FEW_REPORTS, _FEW_REPORTS_S = 6, 3.0
#: How many of the worst count for nothing: a busy moment, such as the start of a map, says nothing about the
#: pace.
_NUM_WORST = 3
#: The first reports of a stream count for nothing, or those of its first seconds: beginning a map takes
#: longer than following.
_WARM_UP, _WARM_UP_S = 20, 5.0
#: Part of a frame by which the stride that is needed may exceed a whole number. Some frames passed over are
#: better than a pace far below what the server can do, which the next whole number may be.
_TOLERANCE = 0.4
#: Reports without a frame passed over until more frames are tried; a failure doubles it, up to this factor.
_PATIENCE = 30
_MAX_FACTOR = 16
#: By this share of it a stride gets shorter at a time, or by one: reports on long ones come seldom.
_SHARE_TRIED = 4


def start_stride(rate_hz: float) -> int:
    """Return the step between frames that makes about ``START_HZ`` of a source's rate; 1 for rate 0."""
    return min(MAX_STRIDE, max(1, math.floor(rate_hz / START_HZ + 0.5)))


class PaceControl:
    """Chooses which frames of a live source are sent. Each method may come from a thread of its own.

    Args:
        agent_epoch: Reports of another epoch are ignored.
        rate_hz: Frames a second of the source, 0 if it is not known.
    """

    def __init__(self, agent_epoch: int, rate_hz: float) -> None:
        self._agent_epoch = agent_epoch
        self._lock = threading.Lock()
        self._stride = start_stride(rate_hz)
        self._not_sent = self._stride - 1  # the first frame is sent at once
        self._last: LinkReport | None = None
        self._valid_from_ns: int | None = None
        self._passed_over: deque[int] = deque(maxlen=_MAX_REPORTS)
        self._quiet = 0
        self._num_reports = self._since_change = 0
        self._num_captured = 0
        self._captured_ns: list[int] = []  # of the first frames, until it is seen how many the source gives
        self._is_start = self._stride > 1
        self._captured_at_sent: deque[int] = deque(maxlen=_MAX_REPORTS)
        self._first_ns: int | None = None  # capture of the first frame that is reported on and counts,
        self._first_kept_ns = 0  # and of the first one whose report is among those kept
        self._is_trial = False
        self._factor = 1

    @property
    def stride(self) -> int:
        """One frame of so many is sent."""
        with self._lock:
            return self._stride

    def wants(self, t_capture_ns: int) -> bool:
        """Count one frame of the source and tell whether it is to be sent.

        Args:
            t_capture_ns: When it was captured, on the clock of the reports.
        """
        with self._lock:
            self._check_start(t_capture_ns)
            self._num_captured += 1
            self._not_sent += 1
            if self._not_sent < self._stride:
                return False
            self._not_sent = 0
            if self._valid_from_ns is None:
                self._valid_from_ns = t_capture_ns
            return True

    def _check_start(self, t_capture_ns: int) -> None:
        """Send more from the first second on where the source gives fewer frames than it said."""
        if not self._is_start:
            return
        self._captured_ns.append(t_capture_ns)
        since_begun_s = (t_capture_ns - self._captured_ns[0]) * 1e-9
        if since_begun_s < _START_S or len(self._captured_ns) <= _START_STEPS:
            return
        steps_ns = sorted(b - a for a, b in pairwise(self._captured_ns))[:-1]
        self._is_start, self._captured_ns = False, []
        given_hz = len(steps_ns) / max(1e-9 * sum(steps_ns), 1e-9)
        self._stride = min(self._stride, start_stride(given_hz))
        self._captured_at_sent.clear()

    def on_sent(self) -> None:
        """Note that a frame was sent: an agent that encodes slowly sends fewer than are wanted."""
        with self._lock:
            self._captured_at_sent.append(self._num_captured)

    def on_report(self, report: LinkReport) -> None:
        """Take what the server says about a frame it is to decode, and change the stride if it is time."""
        if report.agent_epoch != self._agent_epoch:
            return
        with self._lock:
            last = self._last
            if last is not None and report.frame_id <= last.frame_id:
                return
            self._last = report
            # Frames passed over before this one were captured after the last one reported on.
            if last is None or self._valid_from_ns is None or last.t_capture_ns < self._valid_from_ns:
                return
            self._num_reports += 1
            if self._first_ns is None:
                self._first_ns = report.t_capture_ns
            warm_up_s = (report.t_capture_ns - self._first_ns) * 1e-9
            if self._num_reports <= _WARM_UP and warm_up_s < _WARM_UP_S:
                return
            if not self._passed_over:
                self._first_kept_ns = report.t_capture_ns
            # A server that was started again counts from 0.
            passed_over = max(0, report.num_superseded - last.num_superseded)
            self._passed_over.append(passed_over)
            self._quiet = 0 if passed_over else self._quiet + 1
            self._since_change += 1
            self._decide((report.t_capture_ns - self._first_kept_ns) * 1e-9)

    def _decide(self, kept_s: float) -> None:
        usual = sorted(self._passed_over)[:-_NUM_WORST]
        step = self._usual_step()
        needed = step * (1.0 + sum(usual) / max(1, len(usual)))
        stride = min(math.ceil(needed - _TOLERANCE), 2 * step, MAX_STRIDE)
        least = _FEW_REPORTS if kept_s >= _FEW_REPORTS_S else _MIN_REPORTS
        if stride > self._stride and any(usual) and len(self._passed_over) >= least:
            if self._is_trial:
                failed = self._since_change <= _PATIENCE
                self._factor = min(2 * self._factor, _MAX_FACTOR) if failed else 1
            self._change(stride, is_trial=False)
        elif self._stride > 1 and self._quiet >= _PATIENCE * self._factor:
            self._change(self._stride - max(1, self._stride // _SHARE_TRIED), is_trial=True)

    def _usual_step(self) -> int:
        """Return one frame of how many is sent: the stride, or more where the encoder is slower than that."""
        steps = [b - a for a, b in pairwise(self._captured_at_sent)]
        return max(self._stride, statistics.median_low(steps)) if steps else self._stride

    def _change(self, stride: int, *, is_trial: bool) -> None:
        self._stride, self._is_trial, self._is_start = stride, is_trial, False
        self._valid_from_ns = None
        self._passed_over.clear()
        self._captured_at_sent.clear()
        self._quiet = self._since_change = 0
        pace = "every frame" if stride == 1 else f"one frame in {stride}"
        why = "" if is_trial else ", as many as the server can follow; smaller ones (--resize) would be more"
        logger.info("sending %s%s", pace, why)
