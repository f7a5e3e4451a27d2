import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from rows_of_runs import frame_row
from rows_of_runs import straight_path as line

from semcast.cli import main
from semcast.common.errors import SourceError
from semcast.common.run_folder import FRAMES_NAME, SUMMARY_NAME, TRAJECTORY_NAME
from semcast.common.trajectory import Trajectory, write_tum
from semcast.common.trajectory_error import ate
from semcast.evaluation import run_plots
from semcast.evaluation.run_plots import (
    RunToPlot,
    held,
    missing_times,
    path_title,
    plot_run,
    time_span_doubt,
    timeline_title,
)
from semcast.server.frame_rows import FrameRows

NAN = float("nan")


def row(frame_id, **changes):
    return frame_row(frame_id, **{"snr_estimated_db": 9.5 + 0.1 * frame_id, **changes})


def write_run(folder, rows, summary=None):
    folder.mkdir()
    with_rows = FrameRows(folder)
    for each in rows:
        with_rows.add(each)
    with_rows.close()
    assert (folder / FRAMES_NAME).exists()
    if summary is not None:
        (folder / SUMMARY_NAME).write_text(json.dumps(summary))
    return folder


def timeline(rows, tmp_path, name):
    run = RunToPlot(name="run", trajectory=line([]), rows=rows, truth=None)
    (path,) = plot_run(run, tmp_path / name)
    return cv2.imread(str(path))


def test_what_was_set_is_held_until_something_else_is_known():
    np.testing.assert_array_equal(held(np.array([NAN, 10.0, NAN, NAN, 4.0])), [NAN, 10.0, 10.0, 10.0, 4.0])
    np.testing.assert_array_equal(held(np.array([NAN, NAN])), [NAN, NAN])
    assert len(held(np.zeros(0))) == 0


def test_the_line_of_the_snr_that_is_set_has_no_gap_where_a_report_came_late(tmp_path):
    whole = [row(k) for k in range(10)]
    late = [row(k, snr_set_db=None if k in (3, 6) else 10.0) for k in range(10)]
    unlike = [row(k, snr_set_db=8.0 if k in (3, 6) else 10.0) for k in range(10)]
    of_whole = timeline(whole, tmp_path, "whole")
    assert (timeline(late, tmp_path, "late") == of_whole).all()
    assert (timeline(unlike, tmp_path, "unlike") != of_whole).any()


def test_missing_frames_lie_between_those_that_are_there():
    older_run = dict.fromkeys([0, 2, 4, 10, 12])
    t_s = np.array([0.0, 0.2, 0.4, 1.3, 1.5])
    # Every second frame was sent: 6 and 8 are missing, in thirds of the way from 4 to 10.
    np.testing.assert_allclose(missing_times(older_run, t_s), [0.7, 1.0])
    assert len(missing_times(dict.fromkeys([0, 2, 4]), t_s[:3])) == 0
    assert len(missing_times({7: None}, t_s[:1])) == 0
    np.testing.assert_allclose(missing_times({0: 0, 2: 1, 4: 2, 10: 4, 12: 5}, t_s), [0.85])


def test_frames_missing_before_the_first_and_after_the_last_are_known_from_the_summary():
    numbers, t_s = {6: 0, 8: 1, 12: 3}, np.array([0.6, 0.8, 1.2])
    unposed = [(0, 8), (10, 10), (12, 18)]
    np.testing.assert_allclose(missing_times(numbers, t_s, unposed), [0.0, 0.2, 0.4, 1.0, 1.4, 1.6, 1.8])
    assert len(missing_times({}, np.zeros(0), unposed)) == 0


def test_a_run_whose_link_died_is_measured_by_the_way_until_then_and_shows_the_rest(tmp_path, caplog):
    rows = [row(k) for k in range(10)]
    folder = write_run(tmp_path / "run", rows, {"unposed_frames": [[10, 49]]})
    write_tum(folder / TRAJECTORY_NAME, line(range(10)))
    run = RunToPlot.read(folder, line(range(50)))
    assert run.truth_on_the_way.path_length == pytest.approx(9.0)
    np.testing.assert_allclose(run.missing_s, np.arange(10, 50) * 0.1)
    plot_run(run, tmp_path / "plots")
    assert not caplog.records, "the truth is that of this recording"


def test_missing_frames_are_marked(tmp_path):
    there = [row(k, snr_estimated_db=None) for k in (0, 1, 2, 3, 5, 6, 7, 8)]
    renumbered = [row(k, snr_estimated_db=None, t_source_ns=r.t_source_ns) for k, r in enumerate(there)]
    left_out = [replace(r, seq=k) for k, r in enumerate(there)]
    marked, unmarked = timeline(there, tmp_path, "marked"), timeline(renumbered, tmp_path, "unmarked")

    def red(image):
        blue, green, red = (image[..., k].astype(int) for k in range(3))
        return int(((red > 200) & (green < 60) & (blue < 60)).sum())

    assert red(unmarked) == 0 < red(marked)
    assert red(timeline(left_out, tmp_path, "left_out")) == 0, "the agent did not send it"


def test_the_title_says_how_many_frames_were_sent_and_where_the_others_went(tmp_path):
    rows = [row(k, posed=k > 0) for k in range(3)]
    drops = {"superseded": 3, "lost": 1, "damaged": 0, "duplicate": 2}
    summary = {"frames": {"source": 20, "sent": 7}, "drops": drops}
    known = RunToPlot.read(write_run(tmp_path / "known", rows, summary), None)
    assert timeline_title(known) == "known: 3 of 7 frames (1 lost, 3 superseded), 2 with a pose at once"
    cut_off = RunToPlot.read(write_run(tmp_path / "cut_off", rows), None)
    assert timeline_title(cut_off) == "cut_off: 3 frames, 2 with a pose at once"
    whole = {"frames": {"source": 3}, "drops": {}}
    assert "whole: 3 frames, " in timeline_title(
        RunToPlot.read(write_run(tmp_path / "whole", rows, whole), None)
    )


def test_a_stage_outside_the_time_to_the_pose_is_no_part_of_it(tmp_path):
    plain = [row(k) for k in range(6)]
    outside = dict.fromkeys(("map", "bundle", "decoded_to_pose"), 200.0)
    more = [row(k, stage_ms={"decode": 20.0, "track": 10.0, **outside}) for k in range(6)]
    part = [row(k, stage_ms={"decode": 20.0, "track": 10.0, "pose": 15.0}) for k in range(6)]
    expected = timeline(plain, tmp_path, "plain")
    assert (timeline(more, tmp_path, "more") == expected).all()
    assert (timeline(part, tmp_path, "part") != expected).any()


def to_plot(frame_ids, truth_ids, *, in_metres=True):
    trajectory, truth = line(frame_ids), replace(line(truth_ids), in_metres=in_metres)
    return RunToPlot(name="run", trajectory=trajectory, rows=[], truth=truth), ate(trajectory, truth)


def test_the_title_says_how_many_poses_its_error_is_about():
    assert path_title(*to_plot(range(10), range(10))) == "run: ATE 0 m RMSE, 0.00 % of 9 m"
    assert path_title(*to_plot(range(44), range(12, 60))).endswith(" of 47 m\n32 of 44 poses matched")
    unknown = to_plot(range(10), range(10), in_metres=False)
    assert path_title(*unknown) == "run: ATE 0.00 % of 9 units of the truth"
    # Two poses are fitted without an error.
    assert path_title(*to_plot(range(10), range(8, 20))) == (
        "run: 2 of 10 poses matched, not enough for an ATE"
    )
    without = RunToPlot(name="run", trajectory=line(range(10)), rows=[], truth=None)
    assert path_title(without, None) == "run: 10 poses, no ground truth"


def test_the_title_says_that_a_path_is_of_several_parts(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(run_plots, "save_figure", lambda figure, path: drawn.append(figure))
    for num_parts in (1, 2):
        parts = [{"submap": k, "num_posed": 5} for k in range(num_parts)]
        folder = write_run(tmp_path / str(num_parts), [row(k) for k in range(10)], {"parts": parts})
        write_tum(folder / TRAJECTORY_NAME, line(range(10)))
        plot_run(RunToPlot.read(folder, None), tmp_path)
    whole, apart = (figure.get_suptitle() for figure in drawn[::2])
    assert whole == "1: 10 poses, no ground truth"
    assert apart.endswith("\nin 2 parts; the place and scale of all but the first are guessed")


def test_a_truth_of_other_times_is_doubted():
    assert time_span_doubt(line(range(50)), line(range(50))) is None
    assert time_span_doubt(line(range(10, 50)), line(range(50))) is None, "it takes time until there is a map"
    for truth in (line(range(20)), line(range(200)), line(range(1000, 1050))):
        assert "is it of the same recording?" in time_span_doubt(line(range(50)), truth)
    assert time_span_doubt(line(range(50)), line(range(20))).startswith(
        "frames are from 0.0 to 4.9 s, the true path from 0.0 to 1.9 s: "
    )


def test_a_doubtful_truth_is_drawn_and_warned_of(tmp_path, caplog):
    run, _ = to_plot(range(50), range(20))
    with caplog.at_level("WARNING"):
        (path,) = plot_run(run, tmp_path)
    assert "run: frames are from" in caplog.text
    assert cv2.imread(str(path)) is not None


def test_the_spread_of_small_errors_has_few_numbers_below_it(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(run_plots, "save_figure", lambda figure, path: drawn.append(figure))
    rng = np.random.default_rng(0)
    for scale_m in (1e-4, 0.0173, 0.2, 35.0):
        trajectory = line(range(60))
        trajectory.T_world_cam[:, 0, 3] = scale_m * rng.normal(size=60)
        plot_run(RunToPlot(name="run", trajectory=trajectory, rows=[], truth=line(range(60))), tmp_path)
        histogram = drawn[-1].axes[3]
        low, high = histogram.get_xlim()
        assert 2 <= sum(low <= tick <= high for tick in histogram.get_xticks()) <= 5


def test_the_spread_of_a_few_errors_counts_no_half_frames(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(run_plots, "save_figure", lambda figure, path: drawn.append(figure))
    trajectory = line(range(10))
    trajectory.T_world_cam[:, 0, 3] = np.linspace(0.0, 1.0, 10) ** 2
    plot_run(RunToPlot(name="run", trajectory=trajectory, rows=[], truth=line(range(10))), tmp_path)
    assert all(count == int(count) for count in drawn[-1].axes[3].get_yticks())


def test_a_panels_label_stays_clear_of_the_panel_beside_it(tmp_path, monkeypatch):
    drawn, save = [], run_plots.save_figure

    def watched(figure, path):
        save(figure, path)
        drawn.append(figure)

    monkeypatch.setattr(run_plots, "save_figure", watched)
    trajectory = line(range(10))
    trajectory.T_world_cam[:, :3, 3] = np.outer(np.linspace(0.0, 1.0, 10), (0.8, -0.09, 0.53))
    plot_run(RunToPlot(name="run", trajectory=trajectory, rows=[], truth=None), tmp_path)
    drawn[0].set_layout_engine("none")  # as it was saved, at another resolution
    drawn[0].canvas.draw()
    left, right = drawn[0].axes
    assert left.get_window_extent().x1 < right.yaxis.label.get_window_extent().x0


def test_a_run_without_a_decoded_frame_has_nothing_to_plot(tmp_path):
    folder = write_run(tmp_path / "run", [])
    for _ in range(2):
        with pytest.raises(SourceError, match="run: no frame was decoded: nothing to plot"):
            RunToPlot.read(folder, None)
        (folder / TRAJECTORY_NAME).write_text("")
    (tmp_path / "other").mkdir()
    with pytest.raises(SourceError, match="holds neither"):
        RunToPlot.read(tmp_path / "other", None)
    with pytest.raises(SourceError, match="is not a folder"):
        RunToPlot.read(tmp_path / "missing", None)


@pytest.mark.parametrize(
    "summary",
    [
        {"frames": 5},
        {"frames": {"sent": "many"}},
        {"frames": {"sent": float("inf")}},
        {"drops": ["lost"]},
        {"unposed_frames": [3]},
    ],
)
def test_a_summary_that_no_run_wrote_is_named_in_one_line(tmp_path, capsys, summary):
    write_tum(tmp_path / TRAJECTORY_NAME, line([1, 2, 3]))
    (tmp_path / SUMMARY_NAME).write_text(json.dumps({"settings": None, **summary}))
    assert main(["plot", str(tmp_path)]) == 1
    assert f"{tmp_path / SUMMARY_NAME} is none that a run wrote: " in capsys.readouterr().err


def test_a_true_path_without_a_pose_is_refused_in_one_line(tmp_path, capsys):
    write_tum(tmp_path / TRAJECTORY_NAME, line([1, 2, 3]))
    write_tum(tmp_path / "empty.tum", line([]))
    assert main(["plot", str(tmp_path), "--truth", str(tmp_path / "empty.tum")]) == 1
    assert f"{tmp_path / 'empty.tum'} must hold poses, got none" in capsys.readouterr().err


def test_from_above_is_from_above_also_where_the_true_world_has_z_up(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(run_plots, "save_figure", lambda figure, path: drawn.append(figure))
    trajectory = line(range(8))
    trajectory.T_world_cam[:, 0, 3] = np.sin(np.arange(8))
    T_truth_map = np.eye(4)
    T_truth_map[:3, :3] = [
        [1, 0, 0],
        [0, 0, 1],
        [0, -1, 0],
    ]  # x right, z forward becomes y, y down becomes -z
    T_truth_map[:3, 3] = 1.0, 2.0, 3.0
    truth = Trajectory(trajectory.t_s, T_truth_map @ trajectory.T_world_cam)
    plot_run(RunToPlot(name="run", trajectory=trajectory, rows=[], truth=truth), tmp_path)
    for curve in drawn[0].axes[0].lines[:2]:  # true and estimated
        np.testing.assert_allclose(curve.get_xydata(), trajectory.positions[:, [0, 2]], atol=1e-9)
