"""What one start of one agent is, as its map, its outputs and its viewer know it."""

from dataclasses import dataclass
from typing import Self

from semcast.common.camera import Intrinsics
from semcast.common.messages import CameraInfo

#: Nearly the last are so many frames, or the last fifth where that is fewer.
NEARLY_FINAL_FRAMES = 10


@dataclass(frozen=True)
class StreamIdentity:
    """What a map belongs to.

    Attributes:
        agent_id: The camera's name.
        agent_epoch: Start of the agent, nanoseconds.
        codec: Codec name.
        digest: Its digest.
        camera: Intrinsics of the decoded images.
        num_frames: Frames of a finite source, or None. Of some videos an estimate.
        last_frame_id: Of the last of them, or None.
        frame_step: See ``CameraInfo``.
    """

    agent_id: str
    agent_epoch: int
    codec: str
    digest: str
    camera: Intrinsics
    num_frames: int | None
    last_frame_id: int | None = None
    frame_step: int = 1

    @classmethod
    def of(cls, agent_id: str, camera: CameraInfo) -> Self:
        """Return the identity of an announced stream."""
        return cls(
            agent_id=agent_id,
            agent_epoch=camera.agent_epoch,
            codec=camera.codec,
            digest=camera.digest,
            camera=camera.intrinsics,
            num_frames=camera.num_frames,
            last_frame_id=camera.last_frame_id,
            frame_step=camera.frame_step,
        )

    def num_until(self, final_id: int) -> int | None:
        """Return how many frames the source had when this one turned out to be its last."""
        if self.num_frames is None or self.last_frame_id in (None, final_id):
            return self.num_frames
        return final_id // self.frame_step + 1


def is_nearly_final(frame_id: int, camera: CameraInfo) -> bool:
    """Tell whether a frame is among the last of a finite source, whose ids may count in steps."""
    last_id = camera.last_frame_id
    if camera.num_frames is None or last_id is None:
        return False
    nearly = min(NEARLY_FINAL_FRAMES, max(1, camera.num_frames // 5))
    return frame_id > last_id - nearly * camera.frame_step
