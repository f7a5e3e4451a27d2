"""When an attempt to start a map is put off, and when one that was not decided is made again."""

import numpy as np
from numpy.typing import NDArray

from semcast.server.mapping.hypotheses import Hypothesis

Array = NDArray[np.float64]

#: Attempts after which the best structure is taken though none is clearly better than the others.
_MAX_UNDECIDED = 12
#: The same as a number of frames.
_MAX_UNDECIDED_FRAMES = 60
#: The evidence grows with the motion of the tracks, and with what of it is not the camera's rotation: the
#: decision is taken again when one of them has grown by this factor.
_RETRY_GROWTH = 1.15


class Patience:
    """Puts an attempt off for a reason that may never go away, but not for ever.

    Args:
        most: Times it is put off.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._num = 0

    def puts_off(self) -> bool:
        """Whether to put an attempt off once more; each time that is asked counts."""
        self._num += 1
        return self._num <= self._most


class Undecided:
    """What is left of attempts that could not tell a start from what it may be mistaken for.

    Attributes:
        hypotheses: Structures that go on to the next attempt.
    """

    def __init__(self) -> None:
        self.hypotheses: list[Hypothesis] = []
        self._num_attempts = self._num_frames = 0
        self._evidence_px = np.zeros(2)

    @property
    def is_overdue(self) -> bool:
        """Whether the best structure has to do."""
        return self._num_attempts >= _MAX_UNDECIDED or self._num_frames >= _MAX_UNDECIDED_FRAMES

    def note_attempt(self, hypotheses: list[Hypothesis]) -> None:
        """Count an attempt, and keep what goes on from it."""
        self._num_attempts += 1
        self.hypotheses = hypotheses

    def note_evidence(self, evidence_px: Array) -> None:
        """Keep what the last attempt had to go by, ``(2,)``, if there was one that was not decided."""
        if self._num_attempts:
            self._evidence_px = evidence_px

    def forget_evidence(self) -> None:
        """Forget by what the last attempt went; attempts are counted on."""
        self._evidence_px = np.zeros(2)

    def wants(self, evidence_px: Array) -> bool:
        """Whether another attempt is worth it; each frame for which that is asked counts.

        Args:
            evidence_px: ``(2,)`` median way of the tracks, and what turning leaves of it.
        """
        if not self._num_attempts:
            return True
        self._num_frames += 1
        return self.is_overdue or bool((evidence_px >= _RETRY_GROWTH * self._evidence_px).any())
