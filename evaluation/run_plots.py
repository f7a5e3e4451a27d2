"""Pictures of one finished run: its path, and what happened over time."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcast.common.errors import SourceError
from semcast.common.metrics import DUPLICATE
from semcast.common.run_folder import FRAMES_NAME, SUMMARY_NAME, TRAJECTORY_NAME
from semcast.common.run_summary import read_summary
from semcast.common.trajectory import Trajectory, read_tum
from semcast.common.trajectory_error import AteResult, ate, match_times
from semcast.evaluation.plots import new_grid, save_figure
from semcast.server.frame_rows import FrameRow, RowsOnDisk
from semcast.server.sent_frames import stretches

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]

_NONE: Array = np.zeros(0)
_STATE_COLOURS = {"initializing": "#f0c040", "lost": "#d05050"}
#: Stages outside the time to the pose: the map is extended when a frame has its pose, its adjustment
#: runs beside the frames, and the last is a sum of others.
_NOT_TO_POSE = frozenset({"map", "bundle", "decoded_to_pose"})

#: Curves of stages in their panel.
_MAX_STAGES = 3
#: A part of a recording without pose is common; beyond this factor the truth may be of another recording.
_MAX_SPAN_RATIO = 1.5
#: More numbers with decimals below a narrow panel run into each other.
_MAX_TICKS = 5


@dataclass(frozen=True)
class RunToPlot:
    """What is drawn of a run.

    Attributes:
        name: For the titles.
        trajectory: All posed frames.
        rows: One per frame that reached the tracker, in order.
        truth: Reference path, None where unknown.
        num_sent: Frames that were sent, None where the run did not say.
        drops: Frames that never reached the tracker, by reason, as far as the run said.
        num_parts: Parts of the map, whose poses don't fit together.
        unposed: First and last id of each run of frames that were sent and have no pose.
    """

    name: str
    trajectory: Trajectory
    rows: Sequence[FrameRow]
    truth: Trajectory | None
    num_sent: int | None = None
    drops: Mapping[str, int] = field(default_factory=dict)
    num_parts: int = 1
    unposed: Sequence[tuple[int, int]] = ()

    @property
    def truth_on_the_way(self) -> Trajectory | None:
        """The true path from the first frame that was decoded to the last: errors are a share of that.

        So a run's summary has it too.
        """
        if self.truth is None or not self.rows:
            return self.truth
        return self.truth.between(self.rows[0].t_source_ns * 1e-9, self.rows[-1].t_source_ns * 1e-9)

    @property
    def missing_s(self) -> Array:
        """When the frames were recorded that were sent and never decoded."""
        t_s = np.array([row.t_source_ns for row in self.rows], dtype=np.float64) * 1e-9
        return missing_times({row.frame_id: row.seq for row in self.rows}, t_s, self.unposed)

    @staticmethod
    def read(folder: Path, truth: Trajectory | None) -> "RunToPlot":
        """Read a run folder.

        Raises:
            SourceError: The folder is no run, or one without a decoded frame, or its summary is no run's.
        """
        if not folder.is_dir():
            raise SourceError(f"{folder} is not a folder; give the folder that --out wrote")
        path, there = folder / TRAJECTORY_NAME, RowsOnDisk.read(folder / FRAMES_NAME)
        rows = there.all_good()
        if not path.is_file() and not (folder / FRAMES_NAME).is_file():
            raise SourceError(
                f"{folder} holds neither {TRAJECTORY_NAME} nor {FRAMES_NAME}: there is nothing to plot"
            )
        trajectory = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
        if path.is_file():
            trajectory = read_tum(path)
        if not rows and not len(trajectory):
            raise SourceError(f"{folder}: no frame was decoded: nothing to plot")
        try:
            summary = read_summary(folder)
            told = _told_by(summary)
            missing = there.missing((summary.get("frames") or {}).get("tracked"))
        except (AttributeError, TypeError, ValueError, OverflowError) as err:
            raise SourceError(f"{folder / SUMMARY_NAME} is none that a run wrote: {err}") from err
        for text in missing:
            logger.warning("%s: %s", there.path, text)
        return RunToPlot(name=folder.name, trajectory=trajectory, rows=rows, truth=truth, **told)


def _told_by(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a run's summary says of its frames and parts."""
    counts = summary.get("frames") or {}
    num_sent = counts.get("sent", counts.get("source"))
    return {
        "num_sent": None if num_sent is None else int(num_sent),
        "drops": {reason: int(number) for reason, number in (summary.get("drops") or {}).items()},
        "num_parts": max(1, len(summary.get("parts") or ())),
        "unposed": [(int(first), int(last)) for first, last in summary.get("unposed_frames") or ()],
    }


def plot_run(run: RunToPlot, out: Path, image_format: str = "png") -> list[Path]:
    """Draw ``trajectory`` (path from above and from the side, error over time) and ``timeline``.

    Args:
        run: What to draw.
        out: Folder the pictures go to.
        image_format: ``png`` or ``svg``.

    Returns:
        The files written; a picture without anything to show is left out.

    Raises:
        SemcastError: A file can't be written.
    """
    files = []
    if len(run.trajectory):
        files.append(_plot_path(run, out / f"trajectory.{image_format}"))
    if run.rows:
        files.append(_plot_timeline(run, out / f"timeline.{image_format}"))
    return files


def _plot_path(run: RunToPlot, path: Path) -> Path:
    on_the_way = run.truth_on_the_way
    result = ate(run.trajectory, on_the_way) if on_the_way is not None else None
    estimate, truth = _in_camera_axes(run, result)
    unit = "map units" if result is None else result.unit
    doubt = time_span_doubt(run.trajectory, run.truth, run.missing_s) if run.truth is not None else None
    if doubt is not None:
        logger.warning("%s: %s", run.name, doubt)
    figure, grid = new_grid(1 if result is None else 2, 2, 9.0, 4.2 if result is None else 6.4)
    for axes, (first, second), view in zip(
        grid[0], (("x", "z"), ("z", "y")), ("above the first camera", "its side"), strict=True
    ):
        columns = ["xyz".index(first), "xyz".index(second)]
        if truth is not None:
            axes.plot(*truth[:, columns].T, color="0.75", linewidth=4.5, label="ground truth")
        axes.plot(*estimate[:, columns].T, "-", color="#1f77b4", linewidth=1.5, label="estimate")
        axes.plot(*estimate[:1, columns].T, "o", color="#2ca02c", markersize=6, label="start")
        axes.set(xlabel=f"{first} ({unit})", ylabel=f"{second} ({unit})", title=f"from {view}")
        axes.set_aspect("equal", adjustable="datalim")
        if second == "y":
            axes.invert_yaxis()  # y points down
    names = grid[0][0].get_legend_handles_labels()
    figure.legend(*names, fontsize="small", loc="outside lower center", ncols=3)
    if result is not None:
        _plot_error(grid[1], result)
    title = path_title(run, result)
    if run.num_parts > 1:
        title += f"\nin {run.num_parts} parts; the place and scale of all but the first are guessed"
    figure.suptitle(title)
    save_figure(figure, path)
    return path


def _in_camera_axes(run: RunToPlot, result: AteResult | None) -> tuple[Array, Array | None]:
    """Return ``(N, 3)`` estimated and ``(M, 3)`` true positions in the axes of the first camera.

    These are x right, y down, z forward. What is up in a truth's own world is not known: in TUM's and ROS's
    it is z, in KITTI's -y.
    """
    estimate = run.trajectory.positions
    if result is None or run.truth is None:
        return estimate, None
    return result.scale * estimate, (run.truth.positions - result.t_truth_map) @ result.R_truth_map


def path_title(run: RunToPlot, result: AteResult | None) -> str:
    """Return how far the path is from the truth, and how many of its poses that is about."""
    num_poses = len(run.trajectory)
    if run.truth is None:
        return f"{run.name}: {num_poses} poses, no ground truth"
    if result is None:
        num_matched = len(match_times(run.trajectory.t_s, run.truth.t_s)[0])
        return f"{run.name}: {num_matched} of {num_poses} poses matched, not enough for an ATE"
    num_matched = len(result.t_s)
    matched = "" if num_matched == num_poses else f"\n{num_matched} of {num_poses} poses matched"
    rmse = f"{result.rmse:.3g} m RMSE, " if result.in_metres else ""
    error = f"ATE {rmse}{result.percent:.2f} % of {result.path_length:.3g} {result.unit}"
    return f"{run.name}: {error}{matched}"


def time_span_doubt(trajectory: Trajectory, truth: Trajectory, missing_s: Array = _NONE) -> str | None:
    """Return what to say where a path and the truth hardly share a time and may not belong together.

    Args:
        trajectory: At least one pose.
        truth: At least one pose.
        missing_s: Times of frames that were sent and could not have a pose.
    """
    times_s = (np.concatenate((trajectory.t_s, missing_s)), truth.t_s)
    spans_s = [(float(t_s.min()), float(t_s.max())) for t_s in times_s]
    (first_s, last_s), (true_first_s, true_last_s) = spans_s
    shared_s = min(last_s, true_last_s) - max(first_s, true_first_s)
    if max(last_s - first_s, true_last_s - true_first_s) <= _MAX_SPAN_RATIO * shared_s:
        return None
    return (
        f"frames are from {first_s:.1f} to {last_s:.1f} s, the true path from {true_first_s:.1f} to "
        f"{true_last_s:.1f} s: is it of the same recording?"
    )


def _plot_error(row: Sequence[Any], result: AteResult) -> None:
    over_time, histogram = row
    t_s = result.t_s - result.t_s[0]
    over_time.plot(t_s, result.error, color="#d05050", linewidth=1.2)
    over_time.axhline(result.rmse, color="k", linestyle=":", linewidth=1.0)
    over_time.set(
        xlabel="time (s)", ylabel=f"position error ({result.unit})", title="error over time, dotted: RMSE"
    )
    over_time.set_ylim(bottom=0.0)
    histogram.hist(result.error, bins=min(30, max(5, len(result.error) // 4)), color="#d05050")
    histogram.set(xlabel=f"position error ({result.unit})", ylabel="frames", title="how the error is spread")
    histogram.locator_params(axis="x", nbins=_MAX_TICKS - 1)
    histogram.locator_params(axis="y", integer=True)


def _plot_timeline(run: RunToPlot, path: Path) -> Path:
    rows = run.rows
    t_s = np.array([row.t_source_ns for row in rows], dtype=np.float64) * 1e-9
    t_s -= t_s[0]
    panels: list[tuple[str, dict[str, Array]]] = [
        (
            "SNR (dB)",
            {"set": held(_column(rows, "snr_set_db")), "estimated": _column(rows, "snr_estimated_db")},
        ),
        ("PSNR (dB)", {"decoded image": _column(rows, "psnr_db")}),
        ("mean confidence", {"decoded image": _column(rows, "confidence_mean")}),
        ("keypoints", {"tracked": _column(rows, "num_tracked"), "inliers": _column(rows, "num_inliers")}),
        ("reprojection\nerror (px)", {"median of inliers": _column(rows, "reprojection_error_px")}),
        ("arrival to\npose (ms)", {"whole": _column(rows, "age_ms"), **_stages(rows)}),
    ]
    panels = [
        (label, curves) for label, curves in panels if any(np.isfinite(v).any() for v in curves.values())
    ]
    figure, grid = new_grid(len(panels), 1, 9.0, 1.5 * len(panels) + 0.6, share_x=True)
    for (axes,), (label, curves) in zip(grid, panels, strict=True):
        for name, values in curves.items():
            if np.isfinite(values).any():
                axes.plot(
                    t_s,
                    values,
                    linewidth=1.1,
                    marker="." if len(rows) <= 150 else None,
                    markersize=3,
                    label=name,
                )
        axes.set_ylabel(label, fontsize="small")
        _shade_states(axes, t_s, rows)
        if len(curves) > 1:
            axes.legend(fontsize="x-small", loc="upper left", bbox_to_anchor=(1.005, 1.02))
    top = grid[0][0]
    meaning = "recorded time (s); yellow: no map yet, red: lost, |: keyframe"
    keyframes = t_s[[row.is_keyframe for row in rows]]
    top.plot(keyframes, np.ones(len(keyframes)), "|", color="k", transform=top.get_xaxis_transform())
    missing = run.missing_s - rows[0].t_source_ns * 1e-9
    if len(missing):
        at_bottom = np.zeros(len(missing))
        top.plot(missing, at_bottom, "x", color="r", transform=top.get_xaxis_transform(), clip_on=False)
        meaning += ", x: missing"
    grid[-1][0].set_xlabel(meaning)
    figure.suptitle(timeline_title(run))
    save_figure(figure, path)
    return path


def timeline_title(run: RunToPlot) -> str:
    """Return how many frames there are, of how many where that is known, and what became of the others."""
    count = str(len(run.rows))
    if run.num_sent is not None and run.num_sent > len(run.rows):
        count += f" of {run.num_sent}"
    drops = {reason: number for reason, number in sorted(run.drops.items()) if number and reason != DUPLICATE}
    dropped = ", ".join(f"{number} {reason}" for reason, number in drops.items())
    posed = sum(row.posed for row in run.rows)
    return f"{run.name}: {count} frames{f' ({dropped})' if dropped else ''}, {posed} with a pose at once"


def missing_times(
    numbers: Mapping[int, int | None], t_s: Array, unposed: Sequence[tuple[int, int]] = ()
) -> Array:
    """Return when the frames were recorded that were sent and are missing, evenly spread.

    Args:
        numbers: N frame ids, each with its number among those that were sent, or None.
        t_s: ``(N,)`` their times in seconds.
        unposed: Ranges of ids without pose: they tell what is missing before the first and after the last.
    """
    if not numbers:
        return _NONE
    ids, index = np.unique(np.array(list(numbers), dtype=np.int64), return_index=True)
    t_s = t_s[index]
    sent = np.concatenate([stretch.frame_ids for stretch in stretches(numbers)])
    between = np.interp(np.setdiff1d(sent, ids), ids, t_s)
    if len(ids) < 2:
        return np.asarray(between, dtype=np.float64)
    step = int(np.diff(ids).min())
    period_s = (t_s[-1] - t_s[0]) / (ids[-1] - ids[0])
    num_before = max(0, ids[0] - min((first for first, _ in unposed), default=ids[0])) // step
    num_after = max(0, max((last for _, last in unposed), default=ids[-1]) - ids[-1]) // step
    before = t_s[0] - period_s * step * np.arange(num_before, 0, -1)
    after = t_s[-1] + period_s * step * np.arange(1, num_after + 1)
    return np.concatenate((before, between, after))


def held(values: Array) -> Array:
    """Return values with every gap filled by the last value before it; a gap at the begin stays.

    The channel says what it applies in a message of its own, which may come when the frame's row is written.
    """
    known = np.isfinite(values)
    last = np.maximum.accumulate(np.where(known, np.arange(len(values)), -1))
    return np.where(last >= 0, values[last], np.nan)


def _column(rows: Sequence[FrameRow], name: str) -> Array:
    return np.array([np.nan if (v := getattr(row, name)) is None else v for row in rows], dtype=np.float64)


def _stages(rows: Sequence[FrameRow]) -> dict[str, Array]:
    """Return the stages to the pose that take longest in all, each with a value per row."""
    names = {name for row in rows for name in row.stage_ms} - _NOT_TO_POSE
    total = {name: sum(row.stage_ms.get(name, 0.0) for row in rows) for name in names}
    longest = sorted(total, key=lambda name: (-total[name], name))[:_MAX_STAGES]
    return {name: np.array([row.stage_ms.get(name, np.nan) for row in rows]) for name in longest}


def _shade_states(axes: Any, t_s: Array, rows: Sequence[FrameRow]) -> None:
    """Mark spans without tracking behind the curves."""
    ends = np.append(t_s[1:], t_s[-1] + (t_s[-1] - t_s[-2] if len(t_s) > 1 else 1.0))
    for row, begin, end in zip(rows, t_s, ends, strict=True):
        colour = _STATE_COLOURS.get(row.state)
        if colour is not None:
            axes.axvspan(begin, end, color=colour, alpha=0.25, linewidth=0)
