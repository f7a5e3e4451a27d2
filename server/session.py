"""Everything that belongs to one start of one agent: its map, its rows, its checkpoint and its outputs."""

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcast.common.config import settings_to_dict, to_toml
from semcast.common.errors import CheckpointError, tell_nobody
from semcast.common.run_folder import CHECKPOINT_NAME, DENSE_NAME, FRAMES_NAME, SETTINGS_NAME, SUMMARY_NAME
from semcast.common.whole_file import write_whole
from semcast.server.bundle_runner import new_bundle
from semcast.server.checkpoint import Checkpoint, CheckpointHeader, checkpoint_of
from semcast.server.decoder import Arrival
from semcast.server.dense.cloud import DensePatch
from semcast.server.export.outputs import EachFile, versions, write_json, write_ply
from semcast.server.export.parts import after_gaps
from semcast.server.former_run import set_aside
from semcast.server.frame_rows import FrameRow
from semcast.server.frame_views import frame_view
from semcast.server.mapping.bundle_problem import BundleRunner
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.state import DecodedFrame, FrameResult, MapUpdate, TrackingState
from semcast.server.metres import Metres
from semcast.server.reference import Reference
from semcast.server.run_results import Results, results_of, write_results
from semcast.server.run_summary import run_line, summarise, too_much
from semcast.server.sent_frames import stretches
from semcast.server.session_cloud import SessionCloud
from semcast.server.session_records import SessionRecords
from semcast.server.settings import ServerSettings
from semcast.server.stream_identity import StreamIdentity
from semcast.server.view.frame_view import FrameView

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

#: How long a live frame waits for its PSNR; in replay it waits until it is there.
LIVE_PSNR_WAIT_S = 0.05


@dataclass(frozen=True)
class Outcome:
    """What one frame led to: its result, changes of map and dense cloud, and what is shown of it."""

    result: FrameResult
    update: MapUpdate | None
    view: FrameView
    patches: tuple[DensePatch, ...] = ()


class Session:
    """Tracks and maps one agent epoch and writes what it leaves behind. Used from one thread.

    Args:
        settings: Of the server.
        identity: What the map belongs to.
        folder: Where outputs go, or None.
        reference: Originals and truth, or None.
        bundle: A runner made ahead by ``new_bundle``, which the session closes; None makes one.
        program: Settings of the program for the run's records; None takes ``settings``.
        on_error: Is told in a line what the stream goes on without: rows, checkpoints or images that can't be
            written, an adjustment, more of the dense cloud, or the metre.

    Raises:
        OSError: The folder can't be made.
        SemcastError: It can't be written into.
    """

    def __init__(
        self,
        settings: ServerSettings,
        identity: StreamIdentity,
        folder: Path | None,
        reference: Reference | None,
        bundle: BundleRunner | None = None,
        program: Any = None,
        on_error: Callable[[str], None] = tell_nobody,
    ) -> None:
        self._settings = settings
        self._program = program if program is not None else settings
        self.identity = identity
        self._on_error = on_error
        self._reference = reference
        self._bundle = bundle if bundle is not None else new_bundle(settings)
        self._reconstruction = Reconstruction(identity.camera, settings.reconstruction, self._bundle)
        self._cloud = SessionCloud(settings, identity.camera, self._reconstruction, on_error)
        #: What a unit of each part of the map is.
        self.metres = Metres(settings.marker, identity.camera, self._reconstruction, on_error)
        self._t_source_ns: dict[int, int] = {}
        self._numbers: dict[int, int | None] = {}
        self._num_frames = identity.num_frames
        self._map_epoch = 0
        self._last_frame_id = -1
        self._newest_posed: FrameResult | None = None
        self._state = TrackingState.INITIALIZING
        self._is_blank = False
        self._is_concluded = False
        self._told = ""
        self._last_checkpoint_s = time.monotonic()
        self.resumed = False
        self.former_drops: Mapping[str, int] = {}
        self._records = self._recorded_in(None)
        if folder is not None:
            try:
                self._open(folder)
            except BaseException:
                self.close()
                raise
        for row in (rows := self._records.rows.rows()):
            self._t_source_ns[row.frame_id] = row.t_source_ns
            self._numbers[row.frame_id] = row.seq
        #: Poses of a restored map that the viewer has not seen yet.
        self._restored = self._reconstruction.final_trajectory() if self.resumed else {}
        self._after_gaps = after_gaps(self._restored, (row.frame_id for row in rows if not row.posed))

    def _open(self, folder: Path) -> None:
        """Take up what a folder holds of this stream, and begin to write into it."""
        folder.mkdir(parents=True, exist_ok=True)
        self.resumed = self._settings.resume and self._restore(folder / CHECKPOINT_NAME)
        if not self.resumed:
            set_aside(folder)
        self._records = self._recorded_in(folder)

    def _recorded_in(self, folder: Path | None) -> SessionRecords:
        how = self._settings, self._reconstruction
        return SessionRecords(folder, *how, resume=self.resumed, on_error=self._on_error)

    @property
    def last_frame_id(self) -> int:
        """Newest frame that was processed, -1 before the first."""
        return self._last_frame_id

    @property
    def last_seq(self) -> int | None:
        """Its number among the frames that were sent, None where it is not known."""
        return self._numbers.get(self._last_frame_id)

    def _restore(self, path: Path) -> bool:
        """Take the map of a checkpoint that belongs to this stream; say so when there is none."""
        try:
            checkpoint = checkpoint_of(self.identity, path)
            if checkpoint is None:
                return False
            self._reconstruction.restore(checkpoint.arrays)
            self.metres.restore(checkpoint.arrays)
        except (CheckpointError, ValueError, KeyError) as err:
            logger.warning("a new map is started, the checkpoint can't be used: %s", err)
            self.restart_map()
            return False
        self.former_drops = checkpoint.header.drops
        self._last_frame_id = checkpoint.header.frame_id
        self._map_epoch = checkpoint.header.map_epoch
        self._state = TrackingState.LOST
        logger.info("map restored from the checkpoint, up to frame %d", self._last_frame_id)
        return True

    def note_arrival(self, frame_id: int, seq: int, *, final: bool = False) -> None:
        """Note the number of a frame that is processed next, or of which there is nothing to process.

        The ``final`` one tells how many frames the source had, which videos only estimate before.
        """
        self._numbers[frame_id] = seq
        if final:
            self._num_frames = self.identity.num_until(frame_id)

    @property
    def is_adjusting(self) -> bool:
        """Whether an adjustment of a live stream's map is under way, or waits for ``use_time``."""
        return self._settings.mode == "live" and self._bundle.busy

    def use_time(self) -> None:
        """Bring an adjustment that is done into the map: there is time, and the next frame is spared it.

        In replay that belongs to the next frame, for which it is waited for.
        """
        try:
            if self.is_adjusting:
                self._reconstruction.collect()
        except Exception as err:  # on a frame's way it would cost that frame and not the stream, either
            logger.exception("an adjustment could not be applied and is left out")
            self._on_error(f"an adjustment could not be applied: {err}")

    def process(
        self, frame: DecodedFrame, arrival: Arrival, on_pose: Callable[[FrameResult], None] | None = None
    ) -> Outcome:
        """Track a frame, extend the map and write the frame's row.

        Args:
            frame: The frame.
            arrival: What else is known about it.
            on_pose: Is told what the tracker found, once, as soon as it is known; the map is extended after.
        """
        self._is_concluded = False
        reference = self._reference
        quality = None if reference is None else reference.psnr_db(frame.frame_id, frame.image)
        tracked_ns, metric = 0, None

        def tell(found: FrameResult) -> None:
            nonlocal tracked_ns, metric
            tracked_ns = time.perf_counter_ns()
            if on_pose is not None:
                on_pose(found)
            metric = self.metres.of(found)

        result = self._reconstruction.process(frame, tell)
        if not tracked_ns:
            tell(result)
        self._log_state(result)
        update = self._reconstruction.take_map_update()
        patches = self._cloud.grow(frame, result, update)
        self._last_frame_id = frame.frame_id
        if result.T_world_cam is not None:
            self._newest_posed = result
        self._t_source_ns[frame.frame_id] = frame.t_source_ns
        for frame_id, t_source_ns, _ in result.backfilled:
            self._t_source_ns.setdefault(frame_id, t_source_ns)
        row = FrameRow.of(
            frame,
            result,
            snr_set_db=arrival.snr_set_db,
            snr_estimated_db=arrival.snr_estimated_db,
            psnr_db=self._await(quality),
            m_per_unit=None if metric is None else metric.scale,
            seq=self._numbers.setdefault(frame.frame_id, None),
            t_arrival_ns=arrival.t_arrival_ns,
            age_ms=(tracked_ns - arrival.t_arrival_ns) * 1e-6,
            stage_ms={**arrival.stages_to_pose_ms(tracked_ns), **result.stage_ms},
        )
        self._records.rows.add(row)
        update = self.metres.follow(update, frame, result)
        self._records.keep_image(frame, result, update)
        self._map_epoch = result.map_epoch
        if time.monotonic() - self._last_checkpoint_s >= self._settings.checkpoint_interval_s:
            self.save_checkpoint(arrival.drops)
        view = frame_view(frame, result, row, arrival.drops)
        if self._restored:
            restored = [(k, self._t_source_ns.get(k, 0), T) for k, T in sorted(self._restored.items())]
            backfilled = (*restored, *view.backfilled)
            view = replace(view, backfilled=backfilled, after_gaps=self._after_gaps)
            self._restored = {}
        return Outcome(result, update, view, patches)

    def _log_state(self, result: FrameResult) -> None:
        """Say where a map begins, where the camera is lost, and where images show nothing without that."""
        is_tracking = result.state is TrackingState.TRACKING
        was_blank, self._is_blank = self._is_blank, is_tracking and not result.num_tracked
        before, self._state = self._state, result.state
        if result.state is before and self._is_blank == was_blank:
            return
        if self._is_blank:
            what = "the image shows nothing: is the lens covered?"
        elif is_tracking and was_blank:
            what = "the image shows something again"
        elif is_tracking:
            what = "a map has begun" if before is TrackingState.INITIALIZING else "the camera is found again"
        else:
            is_lost = result.state is TrackingState.LOST
            what = "the camera is lost" if is_lost else "waiting for a map to begin"
        logger.info("frame %d: %s", result.frame_id, what)

    def _await(self, quality: "Future[float | None] | None") -> float | None:
        if quality is None:
            return None
        try:
            return quality.result(timeout=None if self._settings.mode == "replay" else LIVE_PSNR_WAIT_S)
        except FutureTimeoutError:
            quality.cancel()
            return None

    def save_checkpoint(self, drops: Mapping[str, int]) -> None:
        """Hand the map to the checkpoint writer; a no-op without a folder or before the first frame.

        Args:
            drops: Frames of the stream that were dropped up to now, by reason.
        """
        self._last_checkpoint_s = time.monotonic()
        if not self._records.takes_checkpoints or self._last_frame_id < 0:
            return
        t_source_ns = self._t_source_ns.get(self._last_frame_id, 0)
        header = CheckpointHeader.of(
            self.identity,
            frame_id=self._last_frame_id,
            t_source_ns=t_source_ns,
            map_epoch=self._map_epoch,
            drops=dict(drops),
        )
        arrays = {**self._reconstruction.snapshot(), **self.metres.arrays()}
        self._records.write_checkpoint(Checkpoint(header, arrays))

    def whole_map(self) -> MapUpdate:
        """Return the map as one update, for who has seen none before."""
        return self._reconstruction.whole_map()

    def restart_map(self) -> None:
        """Forget the map, as the control request ``reset`` asks."""
        self._reconstruction.reset()
        self._restored, self._newest_posed = {}, None
        self._cloud.reset()
        self.metres.reset()

    def conclude(self) -> MapUpdate | None:
        """Adjust the whole map, as the settings want it, now that the stream has ended; what that changed.

        A second time without a frame in between there is nothing to do.
        """
        if self._is_concluded:
            return None
        self._is_concluded = True
        since = time.monotonic()
        try:
            num_adjusted = self._reconstruction.conclude()
            logger.debug("%d keyframes are adjusted, in %.1f s", num_adjusted, time.monotonic() - since)
        except Exception:
            logger.exception("the map could not be adjusted as a whole and stays as it was")
        update = self._reconstruction.take_map_update()
        self._cloud.follow(update)
        update = self.metres.follow(update)
        self.metres.tell()
        return update

    def newest_pose(self) -> FrameResult | None:
        """Return the newest frame that got a pose, with the one it has in the map as it is now.

        None where it has none any more, or no frame got one since the server began.
        """
        found, world = self._newest_posed, self._reconstruction.world
        T_world_cam = None if found is None else world.pose_of_frame(found.frame_id)
        if found is None or T_world_cam is None:
            return None
        part = world.submap_of[world.frames[found.frame_id][0]]
        return replace(found, T_world_cam=T_world_cam, submap=part, covariance=None, backfilled=())

    @property
    def is_concluded(self) -> bool:
        """No frame was processed since ``conclude``."""
        return self._is_concluded

    @property
    def num_to_adjust(self) -> int:
        """Keyframes that ``conclude`` will adjust."""
        wanted = self._settings.reconstruction.final_adjustment and not self._is_concluded
        return len(self._reconstruction.world.keyframes) if wanted else 0

    @property
    def num_without_depth(self) -> int:
        """Keyframes whose depth ``complete_cloud`` has still to estimate."""
        return self._cloud.num_waiting

    def complete_cloud(self, budget_s: float | None = None) -> Iterator[tuple[DensePatch, ...]]:
        """Estimate the depth that is still missing, after ``conclude``, and yield what is new in the cloud.

        Args:
            budget_s: What is still missing by then is left out; None waits for all.
        """
        return self._cloud.complete(budget_s)

    def write_outputs(
        self,
        folder: Path | None,
        drops: Mapping[str, int],
        *,
        complete: bool,
        num_sent: int | None = None,
    ) -> dict[str, Any]:
        """Write trajectory, map, reconstruction and summary, rows that still wait, and return the summary.

        Args:
            folder: Where to, or None to only make the summary.
            drops: Frames that never reached the tracker, by reason.
            complete: The source came to its end, so frames that were sent before any arrived count too.
            num_sent: Frames the agent sent, if it said so: those after the last that arrived count too.

        Raises:
            OSError: Files can't be written; the others are.
            SemcastError: The rows of the run can't be read back.
        """
        with EachFile() as each:
            with each.attempt(Path(FRAMES_NAME)):
                self._records.rows.finish()
            results = self._write_results(folder, each)
            summary = self._summary(results, drops, complete, num_sent)
            if folder is not None:
                with each.attempt(folder / SUMMARY_NAME) as path:
                    write_json(path, summary)
            posed = summary["frames"]["posed"]
            line = run_line(summary)
            if line != self._told:  # outputs are written again where another stream follows
                logger.log(logging.INFO if posed else logging.WARNING, "%s", line)
                if busy := too_much(summary):
                    logger.warning("%s", busy)
            self._told = line
        return summary

    def _summary(
        self, results: Results, drops: Mapping[str, int], complete: bool, num_sent: int | None
    ) -> dict[str, Any]:
        rows = self._records.rows.rows()
        truth = self._reference.truth_of(self._t_source_ns) if self._reference is not None else None
        if truth is not None and rows:
            # Errors are a share of the way that was gone, and not of all that the source has.
            truth = truth.between(rows[0].t_source_ns * 1e-9, rows[-1].t_source_ns * 1e-9)
        num_frames = self._num_frames if complete else None
        summary = summarise(
            rows,
            results.trajectory,
            results.part_of,
            truth,
            stretches(self._numbers, from_first=num_frames is not None, num_sent=num_sent),
            num_frames,
            drops,
            results.num_keyframes,
        )
        summary["num_landmarks"] = results.num_landmarks
        points = self._cloud.points()
        summary["num_dense_points"] = None if points is None else len(points.xyz)
        summary["stream"] = {
            "agent_id": self.identity.agent_id,
            "codec": self.identity.codec,
            "digest": self.identity.digest,
            "image_wh": [self.identity.camera.width, self.identity.camera.height],
        }
        summary["readout_ms"] = self._reconstruction.camera.readout_ms
        summary["readout_from"] = self._reconstruction.camera.readout_from
        summary["metres"] = self.metres.summary()
        summary["resumed"] = self.resumed
        summary["versions"] = versions()
        summary["settings"] = settings_to_dict(self._program)
        return summary

    def write_results(self, folder: Path | None) -> Results:
        """Write trajectory, map and reconstruction; return what there is.

        Raises:
            OSError: Files can't be written; the others are.
        """
        with EachFile() as each:
            return self._write_results(folder, each)

    def _write_results(self, folder: Path | None, each: EachFile) -> Results:
        results = results_of(self._reconstruction, self._t_source_ns)
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            with each.attempt(folder / SETTINGS_NAME) as path:
                write_whole(path, to_toml(self._program))
            camera, metres = self.identity.camera, self.metres.parts()
            write_results(folder, self._reconstruction, results, camera, self._t_source_ns, each, metres)
            cloud = self._cloud.points()
            if cloud is not None and len(cloud.xyz):
                with each.attempt(folder / DENSE_NAME) as path:
                    write_ply(path, cloud.xyz, cloud.rgb, cloud.confidence)
        return results

    def move_records(self, folder: Path) -> None:
        """Move what was written on the way to another folder, after ``close``, see ``SessionRecords``."""
        self._records.move(folder)

    def close(self) -> None:
        """End threads and processes. Idempotent; outputs are written by ``write_outputs`` before."""
        self._records.close()
        self._reconstruction.close()
        self._cloud.close()
