"""What one session writes on its way: rows of frames, checkpoints of the map, decoded images."""

import contextlib
from collections.abc import Callable
from pathlib import Path

from semcast.common.run_folder import CHECKPOINT_NAME, IMAGES_NAME, RECORD_FILES, RESULT_FILES
from semcast.server.checkpoint import Checkpoint, CheckpointWriter
from semcast.server.frame_rows import FrameRows
from semcast.server.image_writer import ImageWriter
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.state import DecodedFrame, FrameResult, MapUpdate, TrackingState
from semcast.server.settings import ServerSettings


class SessionRecords:
    """Grow with the stream; without a folder only the newest rows are kept, in memory.

    Args:
        folder: Of the run, or None. It must be there.
        settings: Of the server: which images are kept, and whether any may be left out.
        reconstruction: Puts images right as poses and observations fit them.
        resume: Go on with the rows that are there.
        on_error: Is told in a line what can't be written.

    Attributes:
        rows: One for each frame.

    Raises:
        SemcastError: The folder can't be written into.
    """

    def __init__(
        self,
        folder: Path | None,
        settings: ServerSettings,
        reconstruction: Reconstruction,
        *,
        resume: bool,
        on_error: Callable[[str], None],
    ) -> None:
        self._folder = folder
        self._reconstruction = reconstruction
        self._keeps_all = settings.save_images == "all"
        self._checkpoints: CheckpointWriter | None = None
        self._images: ImageWriter | None = None
        self.rows = FrameRows(folder, resume=resume, on_error=on_error)
        if folder is None:
            return
        try:
            self._checkpoints = CheckpointWriter(folder / CHECKPOINT_NAME, on_error)
            if settings.save_images != "none":
                self._images = ImageWriter(folder, lossless=settings.mode == "replay", on_error=on_error)
        except BaseException:
            self.close()
            raise

    def keep_image(self, frame: DecodedFrame, result: FrameResult, update: MapUpdate | None) -> None:
        """Keep the decoded image where the settings want it, as poses and observations fit it.

        A start makes keyframes of earlier frames.
        """
        if self._images is None:
            return
        waits = result.state is not TrackingState.TRACKING  # a later part of the map begins from lost frames
        if result.is_keyframe or waits or self._keeps_all:
            image = self._reconstruction.put_right(frame.image)
            self._images.put(frame.frame_id, image, provisional=waits and not self._keeps_all)
        if result.backfilled and update is not None:
            self._images.settle(update.keyframe_ids.tolist())

    @property
    def takes_checkpoints(self) -> bool:
        """Whether there is a folder for them."""
        return self._checkpoints is not None

    def write_checkpoint(self, checkpoint: Checkpoint) -> None:
        """Write a checkpoint, on a thread, instead of any that still waits."""
        if self._checkpoints is not None:
            self._checkpoints.submit(checkpoint)

    def move(self, folder: Path) -> None:
        """Move all of it to another folder, the viewer's file too, after ``close``.

        Results that were saved on the way, or by a run that this one resumed, give way to those there.
        """
        if self._folder is None:
            return
        for name in (*RECORD_FILES, IMAGES_NAME, *RESULT_FILES):
            with contextlib.suppress(FileNotFoundError):
                if name in RESULT_FILES and (folder / name).exists():
                    (self._folder / name).unlink()
                else:
                    (self._folder / name).rename(folder / name)

    def close(self) -> None:
        """Write what waits and end the threads. Idempotent."""
        if self._checkpoints is not None:
            self._checkpoints.close()
        if self._images is not None:
            self._images.close()
        self.rows.close()
