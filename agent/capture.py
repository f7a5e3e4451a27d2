"""Reads the source on a thread of its own, so that capturing and encoding overlap."""

import logging
import threading
from collections.abc import Callable

from semcast.agent.source import Source, SourceFrame
from semcast.common.errors import SourceError
from semcast.common.mailbox import Mailbox, Policy
from semcast.common.metrics import Metrics

logger = logging.getLogger(__name__)


#: How long the end of the thread is waited for: above the time a network camera may take for a read.
_JOIN_S = 6.0


class Capture:
    """Frames of a source, ahead of the encoder.

    Args:
        source: Is read by the thread alone, until ``close``.
        policy: ``newest`` keeps one frame and counts what it replaces as ``superseded``; ``all`` waits.
        metrics: Where to count.
        wants: Tells of each frame whether it is to be sent; the others are counted as ``thinned``. The last
            frame of a source is not asked for: it ends the stream. None wants all.
    """

    def __init__(
        self,
        source: Source,
        policy: Policy,
        metrics: Metrics,
        wants: Callable[[SourceFrame], bool] | None = None,
    ) -> None:
        self._source = source
        self._wants = wants
        self._metrics = metrics
        self._box: Mailbox[SourceFrame] = Mailbox(1, policy)
        self._stopping = threading.Event()
        self._error: SourceError | None = None
        self._num_unreadable = 0
        self._thread = threading.Thread(target=self._run, name="semcast-capture", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            for frame in self._source.frames(self._stopping):
                self._metrics.count("captured")
                self._count_unreadable()
                if not (frame.final or self._wants is None or self._wants(frame)):
                    self._metrics.drop("thinned")
                    continue
                _ = frame.image  # made on this thread, beside the encoder, and of frames that are sent alone
                self._metrics.drop("superseded", self._box.put(frame) or 0)
                if self._stopping.is_set():
                    return
        except SourceError as err:
            self._error = err
        except Exception as err:
            logger.exception("the source failed")
            self._error = SourceError(f"the source failed: {err}")
        finally:
            self._count_unreadable()
            self._box.close()

    def _count_unreadable(self) -> None:
        before, self._num_unreadable = self._num_unreadable, self._source.num_unreadable
        self._metrics.drop("unreadable", self._num_unreadable - before)

    @property
    def ended(self) -> bool:
        """Whether the source is at its end or has failed, and everything before that was taken."""
        return self._box.closed and len(self._box) == 0

    def get(self, timeout_s: float) -> SourceFrame | None:
        """Return the next frame, None when there was none in time or ``ended``."""
        return self._box.get(timeout_s)

    def raise_failure(self) -> None:
        """Raise what the source failed with, if it did: the caller decides what is still sent before.

        Raises:
            SourceError: The source failed.
        """
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """End the thread and free the source. Idempotent."""
        self._stopping.set()
        self._box.close()
        self._thread.join(_JOIN_S)
        # A camera that hangs in a read can't be freed under it; the end of the process does.
        if not self._thread.is_alive():
            self._source.close()
