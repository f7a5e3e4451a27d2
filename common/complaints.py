"""What a process says about messages that make no sense to it."""

import logging

from semcast.common.metrics import Metrics
from semcast.common.wire import WireError

logger = logging.getLogger(__name__)

#: Different texts about one thing that are logged: nonsense without end must not hide what helps.
_MAX_TOLD = 10


class Complaints:
    """Shows in the status what is wrong with what arrives, and logs it the first time.

    Args:
        metrics: Of the process.
    """

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics
        self._told: dict[str, set[str]] = {}

    def tell(self, about: str, text: str) -> None:
        """Say a text about one thing.

        Args:
            about: The thing, of which no more than ten different texts are logged.
            text: A line.
        """
        self._metrics.error(text)
        told = self._told.setdefault(about, set())
        if text not in told and len(told) < _MAX_TOLD:
            told.add(text)
            logger.warning("%s", text)

    def refuse(self, err: WireError) -> None:
        """Count a message that is not valid, and say why."""
        self._metrics.drop("protocol")
        self._metrics.count(f"protocol_{err.reason}")
        self.tell(err.reason, f"a message was refused: {err}")
