"""One row per frame, written as it happens, and read again."""

import contextlib
import json
import logging
import os
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from semcast.common.errors import SemcastError, tell_nobody
from semcast.common.run_folder import FRAMES_NAME, SUMMARY_NAME
from semcast.common.whole_file import whole_file
from semcast.server.export.outputs import plain
from semcast.server.mapping.state import DecodedFrame, FrameResult

logger = logging.getLogger(__name__)

MAX_ROWS_IN_MEMORY = 20_000
#: How long rows wait for a file that could not be written before it is tried again.
RETRY_S = 5.0


@dataclass(frozen=True, kw_only=True)
class FrameRow:
    """What is known about one frame that reached the tracker. None means unknown.

    Attributes:
        frame_id: Index in the source.
        t_source_ns: Recorded time of the frame.
        state: Tracking state after the frame.
        posed: Whether it had a pose at once; frames posed later count in the trajectory.
        num_tracked: Keypoints in sight: followed into the frame, or begun in it.
        num_inliers: Of them, those that agree with the pose.
        reprojection_error_px: Median over inliers.
        is_keyframe: Whether it became a keyframe at once; a start makes keyframes of earlier frames too.
        map_epoch: Map it belongs to.
        submap: Part of the map the tracker was in after the frame. Parts that meet become one later:
            ``RunData.frame_submap`` says where posed frames belong at the end. 0 in rows of older runs.
        seq: Its number among the frames that were sent. None in rows of older runs.
        snr_set_db: What the channel node says it applies.
        snr_estimated_db: What the receiver estimated from the pilots.
        psnr_db: Of the decoded image, where the original is known.
        confidence_mean: Mean of the confidence map.
        t_arrival_ns: When it arrived, on the server's monotonic clock, which begins anew with the machine.
            None in rows of older runs.
        m_per_unit: Metres in a unit of the map, as published with the pose.
        age_ms: From arrival at the server to the pose.
        stage_ms: Duration of each stage, and ``decoded_to_pose`` from the end of the decoder to the pose.
    """

    frame_id: int
    t_source_ns: int
    state: str
    posed: bool
    num_tracked: int
    num_inliers: int
    reprojection_error_px: float | None
    is_keyframe: bool
    map_epoch: int
    snr_set_db: float | None
    snr_estimated_db: float | None
    psnr_db: float | None
    confidence_mean: float | None
    age_ms: float
    stage_ms: dict[str, float] = field(default_factory=dict)
    submap: int = 0
    seq: int | None = None
    t_arrival_ns: int | None = None
    m_per_unit: float | None = None

    @classmethod
    def of(cls, frame: DecodedFrame, result: FrameResult, **rest: Any) -> "FrameRow":
        """Return the row of a tracked frame; ``rest`` is what the tracker does not know."""
        confidence = frame.confidence
        return cls(
            frame_id=frame.frame_id,
            t_source_ns=frame.t_source_ns,
            state=result.state.value,
            posed=result.T_world_cam is not None,
            num_tracked=result.num_tracked,
            num_inliers=result.num_inliers,
            reprojection_error_px=result.reprojection_error_px,
            is_keyframe=result.is_keyframe,
            map_epoch=result.map_epoch,
            submap=result.submap,
            confidence_mean=None if confidence is None else float(confidence.mean()),
            **rest,
        )


class FrameRows:
    """Appends rows to ``frames.jsonl``, which survives a kill; without a folder keeps the newest in memory.

    Rows that the file does not take, as on a full disk, wait in memory until it does.

    Args:
        folder: Where the file goes, or None.
        resume: Go on behind the rows that are there, without lines that are none; otherwise they are
            replaced.
        on_error: Is told in a line, each time, that the file can't be written.
        clock: Returns seconds.

    Raises:
        SemcastError: The file can't be written.
    """

    def __init__(
        self,
        folder: Path | None,
        *,
        resume: bool = False,
        on_error: Callable[[str], None] = tell_nobody,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._waiting: deque[FrameRow] = deque(maxlen=MAX_ROWS_IN_MEMORY)
        self._num_forgotten = 0
        self._path = folder / FRAMES_NAME if folder is not None else None
        self._file: BinaryIO | None = None
        self._on_error = on_error
        self._clock = clock
        self._failed_s: float | None = None
        self._num_bytes = 0  # of the file, up to the end of its last whole row
        if self._path is None:
            return
        try:
            kept = _rows_to_resume(self._path) if resume else []
            with whole_file(self._path) as file:
                file.writelines(_line(row) for row in kept)
                self._num_bytes = file.tell()
            self._open(self._path)
        except OSError as err:
            raise SemcastError(f"{self._path} can't be written: {err}") from err

    def add(self, row: FrameRow) -> None:
        """Append a row. Where the file can't be written, it is tried again later and the stream goes on."""
        self._num_forgotten += len(self._waiting) == MAX_ROWS_IN_MEMORY
        self._waiting.append(row)
        if self._path is None or (self._failed_s is not None and self._clock() - self._failed_s < RETRY_S):
            return
        try:
            self._write(self._path)
        except OSError as err:
            self._fail(err)

    def _open(self, path: Path) -> None:
        """Open the file behind its last whole row: of one on a full disk a part may be there."""
        self._file = path.open("ab", buffering=0)
        size = self._file.seek(0, os.SEEK_END)
        if size > self._num_bytes:
            self._file.truncate(self._num_bytes)
        self._num_bytes = min(size, self._num_bytes)

    def _write(self, path: Path) -> None:
        """Let the file take all that waits.

        Raises:
            OSError: It does not; the rest waits.
        """
        if self._file is None:
            self._open(path)
        assert self._file is not None
        while self._waiting:
            line = memoryview(_line(self._waiting[0]))
            num_bytes = len(line)
            while line:
                line = line[self._file.write(line) :]
            self._num_bytes += num_bytes
            self._waiting.popleft()
        if self._failed_s is not None:
            self._failed_s = None
            logger.warning("%s is written again%s", path, self._loss())

    def _loss(self) -> str:
        number = self._num_forgotten
        return f", but {number} rows that waited for it are lost" if number else ", with the rows that waited"

    def _fail(self, err: OSError) -> None:
        text = f"{self._path} can't be written: {err}"
        if self._failed_s is None:
            logger.warning("%s; rows wait in memory, and it is tried again every %g s", text, RETRY_S)
        self._on_error(text)
        self._failed_s = self._clock()
        self.close()

    def finish(self) -> None:
        """Let the file take the rows that still wait, for nothing more comes.

        Raises:
            OSError: It does not take them, or some waited for so long that they are lost.
        """
        if self._path is None:
            return
        if self._waiting:
            try:
                self._write(self._path)
            except OSError:
                self.close()
                raise
        if self._num_forgotten:
            raise OSError(f"{self._num_forgotten} rows are lost")

    def rows(self) -> list[FrameRow]:
        """Return all rows, also those of a run this one resumed."""
        on_disk = read_rows(self._path) if self._path is not None else []
        return [*on_disk, *self._waiting]

    def close(self) -> None:
        """Close the file. Idempotent."""
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(OSError):
                file.close()


def _line(row: FrameRow) -> bytes:
    return (json.dumps(plain(asdict(row)), allow_nan=False) + "\n").encode()


@dataclass(frozen=True)
class RowsOnDisk:
    """What there is in a ``frames.jsonl``.

    Attributes:
        path: Of the file.
        rows: One per frame. Of a frame that was tracked again, after its server had ended before it could say
            so, the last row counts.
        bad: What is wrong with each line that is no row, but for the last one.
        ends_within_row: Whether the last line is no whole row, as a process leaves it that is killed.
    """

    path: Path
    rows: list[FrameRow]
    bad: list[str]
    ends_within_row: bool

    @classmethod
    def read(cls, path: Path) -> "RowsOnDisk":
        """Read the file; of one that is not there, there are no rows."""
        if not path.exists():
            return cls(path, [], [], False)
        rows: dict[int, FrameRow] = {}
        bad: list[str] = []
        ends_within_row = False
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True)
        for number, line in enumerate(lines, start=1):
            try:
                row = FrameRow(**json.loads(line))
                rows[row.frame_id] = row
            except (ValueError, TypeError) as err:
                if number < len(lines):
                    bad.append(f"{path}:{number} is not a frame row: {err}")
                else:
                    ends_within_row = True
        return cls(path, list(rows.values()), bad, ends_within_row)

    def all_good(self) -> list[FrameRow]:
        """Return the rows.

        Raises:
            SemcastError: A line before the last one is not a row.
        """
        if self.bad:
            raise SemcastError(self.bad[0])
        return self.rows

    def missing(self, num_tracked: int | None) -> list[str]:
        """Say in a line each what of the rows of a run is not there any more.

        Args:
            num_tracked: Frames that it tracked, as its summary says; None where it says nothing.
        """
        lines: list[str] = []
        if self.ends_within_row:
            lines.append("the last line is no whole row: the run was killed, or is writing it")
        if num_tracked is not None and len(self.rows) < num_tracked:
            lines.append(
                f"{len(self.rows)} rows of the {num_tracked} frames that {SUMMARY_NAME} says were tracked: "
                "the file was cut or changed since"
            )
        return lines


def _rows_to_resume(path: Path) -> list[FrameRow]:
    """Read the rows of a run that goes on; it must not end for good with a damaged line."""
    there = RowsOnDisk.read(path)
    if bad := there.bad:
        logger.warning("%s: %d lines are no frame rows and are left out: %s", path, len(bad), bad[0])
    return there.rows


def read_rows(path: Path) -> list[FrameRow]:
    """Read ``frames.jsonl`` up to its last whole line; none where there is no file.

    Raises:
        SemcastError: A line before the last one is not a row.
    """
    return RowsOnDisk.read(path).all_good()
