import cv2
import numpy as np
import pytest
from full_disk import room_for
from matplotlib.text import Text

from semcast.common.errors import SemcastError
from semcast.evaluation import plots
from semcast.evaluation.competitors import COMPETITORS
from semcast.evaluation.picture_strip import write_picture
from semcast.evaluation.plots import plot_against_snr, plot_pair_errors, plot_path, plot_reliability


def reliability_of(predicted, observed, share=(0.5, 0.5)):
    return {"predicted": predicted, "observed": observed, "share": share}


def drawn_by(monkeypatch, draw):
    """What a function draws instead of saving."""
    drawn = []
    monkeypatch.setattr(plots, "save_figure", lambda figure, path: drawn.append(figure))
    draw()
    return drawn


def test_all_bars_are_of_the_difference_from_one_rival(tmp_path, monkeypatch):
    def compared(mode, against, low, high):
        return {
            "mode": mode,
            "against": against,
            "figure": "rot_deg_mean",
            "paired": {"low": low, "high": high},
        }

    values = {"rot_deg_mean": 1.0, "tdir_deg_mean": 1.0}
    comparisons = [
        compared("robust", "off", -0.5, -0.2),
        compared("robust", "others", -0.9, -0.1),
        compared("off", "others", -0.8, 0.8),
    ]
    modes = dict.fromkeys(("robust", "off", "others"), values)
    cells = [{"snr_db": snr_db, "results": modes, "comparisons": comparisons} for snr_db in (2.0, 10.0)]
    rotation, _ = drawn_by(monkeypatch, lambda: plot_pair_errors(tmp_path, {"cells": cells}))
    bars = [line.get_ydata() for line in rotation.axes[0].lines if line.get_marker() == "_"]
    np.testing.assert_allclose(bars, [(0.5, 0.8), (0.5, 0.8)])
    assert rotation.axes[0].get_xticks().tolist() == [2.0, 10.0], "the SNRs that were measured"


def test_a_bin_of_a_few_samples_is_no_point_of_a_reliability_diagram(tmp_path, monkeypatch):
    table = reliability_of([0.2, 0.5, 0.8], [0.9, 0.5, 0.8], [0.0002, 0.4998, 0.5])
    (figure,) = drawn_by(monkeypatch, lambda: plot_reliability(tmp_path / "r.png", {"c": table}, "what was"))
    (curve,) = (line for line in figure.axes[0].lines if line.get_label() == "c")
    assert curve.get_xdata().tolist() == [0.5, 0.8]


def test_pair_plots_are_drawn_with_the_intervals_there_are(tmp_path):
    def cell(snr_db, off, interval=None):
        values = {"rot_deg_mean": off, "tdir_deg_mean": 2 * off}
        paired = None if interval is None else {"low": interval[0], "high": interval[1]}
        which = {"mode": "robust", "against": "off", "figure": "rot_deg_mean", "paired": paired}
        return {"snr_db": snr_db, "results": {"off": values, "robust": values}, "comparisons": [which]}

    both = plot_pair_errors(tmp_path, {"cells": [cell(10, 1.0), cell(2, 4.0)]})
    assert [p.name for p in both] == ["fig9_rotation.png", "fig10_translation_direction.png"]
    images = [cv2.imread(str(p)) for p in both]
    assert all(image is not None and image.std() > 5 for image in images)
    rotation, direction = (p.read_bytes() for p in both)
    plot_pair_errors(tmp_path, {"cells": [cell(10, 1.0, (-0.5, 0.5)), cell(2, 4.0, (-5.0, 1.0))]})
    assert both[0].read_bytes() != rotation
    assert both[1].read_bytes() == direction


def test_curves_with_gaps_draw_and_wrong_lengths_raise(tmp_path):
    path = tmp_path / "a.png"
    plot_against_snr(path, [2, 4], {"x": [1.0, None]}, "y")
    assert cv2.imread(str(path)) is not None
    with pytest.raises(ValueError, match="2 values"):
        plot_against_snr(path, [2, 4], {"x": [1.0]}, "y")


def test_long_names_of_curves_leave_the_title_whole(monkeypatch, tmp_path):
    curves = {"a/checkpoint/with/a/name/as/long.safetensors": [1.0, 2.0]}
    title = "rayleigh, 16qam (learned codecs), CBR 1/16, mean of 24 images"
    (figure,) = drawn_by(
        monkeypatch, lambda: plot_against_snr(tmp_path / "a.png", [2, 4], curves, "y", title)
    )
    figure.draw_without_rendering()
    (legend,) = figure.legends
    box = next(text for text in figure.findobj(Text) if text.get_text() == title).get_window_extent()
    assert figure.bbox.x0 <= box.x0
    assert box.x1 <= figure.bbox.x1
    assert not box.overlaps(legend.get_window_extent())


def assert_names_are_whole(figure):
    figure.draw_without_rendering()
    (legend,) = figure.legends
    box = legend.get_window_extent()
    assert figure.bbox.x0 <= box.x0
    assert box.x1 <= figure.bbox.x1


def test_names_below_the_axes_are_whole_however_many_there_are(monkeypatch, tmp_path):
    title = "3dcsc-lite-vr.safetensors, parking_synth_60_by_night"
    table = reliability_of([0.2, 0.8], [0.3, 0.7])
    for name in ("SNR {} dB", "SNR ramp from {} dB"):
        tables = {name.format(snr_db): table for snr_db in (2, 6, 10, 14)}
        (figure,) = drawn_by(
            monkeypatch, lambda t=tables: plot_reliability(tmp_path / "r.png", t, "what was", title)
        )
        assert_names_are_whole(figure)
        (shown,) = (t for t in figure.findobj(Text) if t.get_text().replace("\n", " ") == title)
        assert figure.bbox.x0 <= shown.get_window_extent().x0
    methods = ["robust", "paper", "off", *COMPETITORS, "oracle"]
    values = {method: {"rot_deg_mean": 1.0, "tdir_deg_mean": 2.0} for method in methods}
    for num_panels in range(1, 5):
        cells = [
            {"snr_db": snr_db, "results": values, "comparisons": [], "features": "klt", "gap": gap}
            for snr_db in (2.0, 10.0)
            for gap in range(1, num_panels + 1)
        ]
        for figure in drawn_by(monkeypatch, lambda c=cells: plot_pair_errors(tmp_path, {"cells": c})):
            assert_names_are_whole(figure)


def test_path_and_reliability_are_drawn(tmp_path):
    path = tmp_path / "top.svg"
    line = np.stack([np.arange(5.0), np.zeros(5), np.arange(5.0)], axis=1)
    plot_path(path, {"ground truth": line, "semcast": line + 0.1}, title="t", unit="m")
    assert "<svg" in path.read_text()
    plot_reliability(tmp_path / "r.png", {"c": reliability_of([0.2, 0.8], [0.3, 0.7])}, "what was")
    assert cv2.imread(str(tmp_path / "r.png")) is not None


@pytest.mark.parametrize("name", [r"run $\foo$", "\u8d70\u308b"])
def test_names_are_no_formulas_and_may_be_of_any_script(tmp_path, name):
    plot_against_snr(tmp_path / "a.svg", [2, 4], {name: [1.0, 2.0]}, "y")
    assert f"<!-- {name} -->" in (tmp_path / "a.svg").read_text("utf-8")


def test_an_unknown_file_type_is_one_clear_error(tmp_path):
    with pytest.raises(SemcastError, match="plot"):
        plot_path(tmp_path / "a.nonsense", {"a": np.zeros((2, 3))}, unit="m")


@pytest.mark.parametrize(
    "draw",
    [
        lambda path: plot_path(path, {"a": np.zeros((2, 3))}, unit="m"),
        lambda path: write_picture(path, np.zeros((500, 500, 3), np.uint8)),
    ],
)
def test_a_full_disk_leaves_the_former_picture(tmp_path, draw):
    path = tmp_path / "a.png"
    path.write_bytes(b"former")
    with room_for(100), pytest.raises(SemcastError, match="can't be written"):
        draw(path)
    assert path.read_bytes() == b"former"
    assert list(tmp_path.iterdir()) == [path]


def test_names_of_curves_stand_beside_the_axes_and_hide_no_point(tmp_path, monkeypatch):
    def draw():
        curves = {name: [30.0, 30.0, 31.0] for name in "abcde"}
        plot_against_snr(tmp_path / "a.png", [2, 4, 6], curves, "PSNR (dB)")
        corner = reliability_of([0.1, 0.9], [0.9, 0.1])
        plot_reliability(tmp_path / "b.png", dict.fromkeys("abcde", corner), "what was")
        plot_path(tmp_path / "c.png", {"ground truth": np.eye(3), "semcast": -np.eye(3)}, unit="m")

    drawn = drawn_by(monkeypatch, draw)
    assert len(drawn) == 3
    for figure in drawn:
        figure.draw_without_rendering()
        (axes,), (names,) = figure.axes, figure.legends
        assert axes.get_legend() is None
        assert not names.get_window_extent().overlaps(axes.get_window_extent())
        assert figure.bbox.containsx(names.get_window_extent().x1)
