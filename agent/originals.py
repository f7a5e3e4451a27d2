"""Publishes original frames beside the symbols, not through the channel, so that a recording keeps them."""

import logging
import threading
from typing import Literal

import cv2

from semcast.agent.source import SourceFrame
from semcast.common.errors import TransportError
from semcast.common.keys import source_key
from semcast.common.mailbox import Mailbox
from semcast.common.messages import SourceImage
from semcast.common.metrics import Metrics
from semcast.common.transport import Session
from semcast.common.wire import WireError, pack

logger = logging.getLogger(__name__)

ImageFormat = Literal["jpeg", "png"]
JPEG_QUALITY = 95
_QUEUE = 2
_POLL_S = 0.2


def source_image(frame: SourceFrame, agent_epoch: int, image_format: ImageFormat) -> SourceImage:
    """Return a frame as the agent gives it to the encoder, compressed as ``image_format``."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if image_format == "jpeg" else []
    bgr = cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode("." + image_format, bgr, quality)
    height, width = frame.image.shape[:2]
    return SourceImage(
        agent_epoch=agent_epoch,
        frame_id=frame.frame_id,
        image_hw=(height, width),
        image_format=image_format,
        data=data.tobytes(),
    )


class OriginalSharer:
    """Compresses and publishes frames on a thread of its own.

    Args:
        session: Open network session.
        agent_id: Whose frames.
        agent_epoch: Of this start of the agent.
        image_format: ``jpeg`` (quality 95) or ``png`` (lossless, and slower).
        lossless: ``put`` waits and every frame is shared; otherwise the sender never waits, and frames that
            come too fast are left out and counted as ``source_superseded``.
        metrics: Where to count.
        stop: Ends waiting in ``put``.

    Raises:
        TransportError: The session is closed.
    """

    def __init__(
        self,
        session: Session,
        agent_id: str,
        agent_epoch: int,
        image_format: ImageFormat,
        lossless: bool,
        metrics: Metrics,
        stop: threading.Event,
    ) -> None:
        self._publisher = session.publisher(source_key(agent_id), "every" if lossless else "newest")
        self._agent_epoch = agent_epoch
        self._format = image_format
        self._metrics = metrics
        self._stop = stop
        self._box: Mailbox[SourceFrame] = Mailbox(_QUEUE, "all" if lossless else "newest")
        self._thread = threading.Thread(target=self._run, name="semcast-originals", daemon=True)
        self._thread.start()

    def put(self, frame: SourceFrame) -> None:
        """Share a frame."""
        while (gave_way := self._box.put(frame, _POLL_S)) is None:
            if self._box.closed or self._stop.is_set():
                return
        self._metrics.drop("source_superseded", gave_way)

    def _run(self) -> None:
        try:
            while not (self._box.closed and len(self._box) == 0):
                frame = self._box.get(_POLL_S)
                if frame is not None:
                    self._share(frame)
        except TransportError as err:
            self._metrics.error(str(err))
        except Exception as err:
            logger.exception("sharing the originals failed")
            self._metrics.error(f"sharing the originals failed: {err}")
        finally:
            self._box.close()

    def _share(self, frame: SourceFrame) -> None:
        try:
            message = pack(source_image(frame, self._agent_epoch, self._format))
        except (WireError, cv2.error) as err:
            # Such as a frame of more than 16 MiB as PNG: the next one may be smaller.
            self._metrics.drop("source_invalid")
            self._metrics.error(str(err))
            return
        with self._metrics.stage("share_source"):
            self._publisher.put(message)
        self._metrics.count("source_shared")

    def close(self) -> None:
        """Send what is left and end the thread. Idempotent."""
        self._box.close()
        self._thread.join(5.0)
