"""Plots of results: pose error against SNR (Fig. 9 and 10 of the paper), trajectories, reliability.

Matplotlib lives here alone and is used through its object interface, without a window or global state. It
is loaded with the first figure: half a second that an evaluation without plots, or ``--help``, need not wait.
"""

import textwrap
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from semcast.common.errors import SemcastError
from semcast.common.whole_file import whole_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MARKERS = "os^Dv<>P*Xhp"
#: Matplotlib's own ten and two more: as many as Kodak has codecs. Further curves are dashed.
_COLOURS = (*(f"C{k}" for k in range(10)), "black", "goldenrod")

#: Share of all samples from which a bin stands in a reliability diagram.
_LEAST_SHARE = 0.001
#: Letters of a title that a square picture has room for.
_TITLE_LETTERS = 48


def _empty_figure(width_in: float, height_in: float) -> "Figure":
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _new_figure(width_in: float, height_in: float) -> "tuple[Figure, Axes]":
    figure = _empty_figure(width_in, height_in)
    axes = figure.add_subplot()
    axes.grid(alpha=0.3)
    return figure, axes


def new_grid(
    num_rows: int, num_columns: int, width_in: float, height_in: float, *, share_x: bool = False
) -> "tuple[Figure, list[list[Axes]]]":
    """Return a figure with a grid of axes, as lists of rows."""
    figure = _empty_figure(width_in, height_in)
    grid = figure.subplots(num_rows, num_columns, squeeze=False, sharex=share_x)
    for axes in grid.flat:
        axes.grid(alpha=0.3)
    return figure, [list(row) for row in grid]


def _name_below(figure: "Figure", axes: "Axes", most_columns: int) -> None:
    """Put the names of curves below all axes, in as many columns as the picture is wide enough for."""
    names = axes.get_legend_handles_labels()
    for columns in range(most_columns, 0, -1):
        legend = figure.legend(*names, fontsize="small", loc="outside lower center", ncols=columns)
        if columns == 1 or legend.get_window_extent().width <= figure.bbox.width:
            break
        legend.remove()


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a figure in the format its name asks for, making the folder; the file is whole or as it was.

    Its texts are names of files and curves, never formulas: a ``$`` is a ``$``.

    Raises:
        SemcastError: The file can't be written.
    """
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_parse_math(False)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Without a date in the file the same result gives the same bytes.
        metadata = {"Date": None} if path.suffix == ".svg" else None
        with warnings.catch_warnings():
            # Of letters that the font lacks; what stands for them is seen in the picture.
            warnings.filterwarnings("ignore", message="Glyph .* missing from")
            # Axes of equal scale are numbered anew once they have a size; the layout must see those numbers.
            if any(axes.get_aspect() != "auto" for axes in figure.axes):
                figure.draw_without_rendering()
            with whole_file(path) as file:
                figure.savefig(file, format=path.suffix[1:], dpi=150, metadata=metadata)
    except (OSError, ValueError) as err:
        raise SemcastError(f"{path} can't be written as a plot: {err}") from err


def plot_against_snr(
    path: Path,
    snr_db: Sequence[float],
    curves: Mapping[str, Sequence[float | None]],
    y_label: str,
    title: str = "",
) -> None:
    """Draw one curve per name over the SNR and save it.

    Args:
        path: ``.png``, ``.svg`` or ``.pdf``.
        snr_db: ``(N,)`` abscissae.
        curves: Name to N values; None leaves a gap.
        y_label: Quantity and unit.
        title: Above the axes.

    Raises:
        ValueError: A curve has another length than ``snr_db``.
        SemcastError: The file can't be written.
    """
    figure, axes = _new_figure(6.4, 3.6)
    for k, (name, values) in enumerate(curves.items()):
        if len(values) != len(snr_db):
            raise ValueError(f"curve {name!r} must have {len(snr_db)} values, got {len(values)}")
        y = np.array([np.nan if v is None else v for v in values], dtype=np.float64)
        colour, marker = _COLOURS[k % len(_COLOURS)], _MARKERS[k % len(_MARKERS)]
        style = "-" if k < len(_COLOURS) else "--"
        axes.plot(snr_db, y, style, color=colour, marker=marker, markersize=4, label=name)
    axes.set(xlabel="SNR (dB)", ylabel=y_label)
    figure.suptitle(title, fontsize="medium")  # which may be wider than the axes are
    # Inside the axes the names would hide points of the curves.
    figure.legend(fontsize="small", loc="outside right center")
    save_figure(figure, path)


def plot_pair_errors(folder: Path, result: Mapping[str, Any]) -> list[Path]:
    """Draw rotation and translation-direction error against SNR, with and without confidence.

    These are Fig. 9 (``fig9_rotation.png``) and Fig. 10 (``fig10_translation_direction.png``) of the paper,
    with a panel for every gap, kind of features and thinning. The error is on a logarithmic scale: estimators
    differ by up to a hundredfold. Bars are the 95 % interval of a mode's difference, pair by pair, from the
    first mode that others were compared with, set upon that one's error: where one doesn't reach that one's
    curve, they differ.

    Args:
        folder: Where the two files go.
        result: What ``evaluate_pairs`` returned.

    Returns:
        The files written.
    """
    panels: dict[str, list[Mapping[str, Any]]] = {}
    for cell in sorted(result["cells"], key=lambda cell: float(cell["snr_db"])):
        panels.setdefault(variant_name(cell), []).append(cell)
    modes = list(result["cells"][0]["results"])
    paths = []
    for name, key, label in (
        ("fig9_rotation.png", "rot_deg_mean", "mean rotation error (deg)"),
        ("fig10_translation_direction.png", "tdir_deg_mean", "mean translation-direction error (deg)"),
    ):
        num_columns = min(len(panels), 4)
        num_rows = -(-len(panels) // num_columns)
        size = (5.0, 4.4) if len(panels) == 1 else (3.2 * num_columns, 2.9 * num_rows + 0.6)
        figure, grid = new_grid(num_rows, num_columns, *size)
        flat = [axes for row in grid for axes in row]
        for axes in flat[len(panels) :]:
            axes.set_visible(False)
        for axes, (variant, cells) in zip(flat, panels.items(), strict=False):
            _draw_pair_errors(axes, cells, modes, key)
            title = variant if len(panels) > 1 else str(result.get("title", ""))
            axes.set_title(title, fontsize="medium")
        for row in grid:
            row[0].set_ylabel(label, fontsize="small")
        _name_below(figure, flat[0], min(len(modes), 3 * num_columns))
        if len(panels) > 1:
            figure.suptitle(str(result.get("title", "")))
        save_figure(figure, folder / name)
        paths.append(folder / name)
    return paths


def _draw_pair_errors(
    axes: "Axes", cells: Sequence[Mapping[str, Any]], modes: Sequence[str], figure: str
) -> None:
    """Draw a figure of all modes over the SNR, the first one boldest."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    snr_db = [cell["snr_db"] for cell in cells]
    for k, mode in enumerate(modes):
        values = [cell["results"][mode][figure] for cell in cells]
        y = np.array([np.nan if v is None else v for v in values], dtype=np.float64)
        axes.plot(
            snr_db,
            np.where(y > 0, y, np.nan),
            color=_COLOURS[k % len(_COLOURS)],
            marker=_MARKERS[k % len(_MARKERS)],
            markersize=4,
            linewidth=2.2 if k == 0 else 1.0,
            zorder=3 if k == 0 else 2,
            label=mode,
        )
        _draw_intervals(axes, cells, mode, figure, _COLOURS[k % len(_COLOURS)])
    axes.set(xlabel="SNR (dB)", yscale="log", xticks=snr_db)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.15, which="minor")


def _draw_intervals(
    axes: "Axes", cells: Sequence[Mapping[str, Any]], mode: str, figure: str, colour: str
) -> None:
    """Draw how far a mode is from the one that all are compared with; nothing for that one itself.

    One compared with another rival would have a bar that says something else than those beside it.
    """
    for cell in cells:
        rival = next((c["against"] for c in cell["comparisons"]), None)
        wanted = (mode, rival, figure)
        mine = (c["paired"] for c in cell["comparisons"] if (c["mode"], c["against"], c["figure"]) == wanted)
        paired = next(mine, None)
        if paired is not None and paired["low"] is not None:
            bounds = cell["results"][rival][figure] + np.array([paired["low"], paired["high"]])
            if (bounds > 0).all():  # the scale has no zero
                axes.plot([cell["snr_db"]] * 2, bounds, color=colour, linewidth=1.0, marker="_", markersize=5)


def variant_name(cell: Mapping[str, Any]) -> str:
    """Return what the matches of a cell of ``evaluate_pairs`` are, such as ``klt, 40 matches, gap 2``."""
    parts = [str(cell.get("features", ""))]
    if cell.get("max_matches"):
        parts.append(f"{cell['max_matches']} matches")
    if cell.get("gap", 1) != 1:
        parts.append(f"gap {cell['gap']}")
    return ", ".join(parts)


def plot_path(
    path: Path,
    trajectories: Mapping[str, NDArray[np.float64]],
    *,
    axes_names: tuple[str, str] = ("x", "z"),
    title: str = "",
    unit: str,
) -> None:
    """Draw camera positions along one world axis and save them.

    Args:
        path: Image file.
        trajectories: Name to ``(N, 3)`` positions, all in one world frame.
        axes_names: The two world axes shown, of ``x``, ``y``, ``z``; a camera-style world looks best in x, z.
        title: Above the axes.
        unit: Unit of the axes.
    """
    columns = ["xyz".index(name) for name in axes_names]
    figure, axes = _new_figure(4.6, 4.6)
    for name, positions in trajectories.items():
        # A good path lies on the true one, and would hide a line of its own width.
        style: dict[str, Any] = {"color": "0.75", "linewidth": 4.5, "zorder": 1}
        if name != "ground truth":
            style = {"linewidth": 1.3}
        axes.plot(positions[:, columns[0]], positions[:, columns[1]], label=name, **style)
    axes.set(xlabel=f"{axes_names[0]} ({unit})", ylabel=f"{axes_names[1]} ({unit})", title=title)
    axes.set_aspect("equal", adjustable="datalim")
    _name_below(figure, axes, len(trajectories))
    save_figure(figure, path)


def plot_reliability(
    path: Path, tables: Mapping[str, Mapping[str, Sequence[float]]], observed: str, title: str = ""
) -> None:
    """Draw reliability diagrams: observed against predicted, one curve per name.

    Bins with hardly any samples are left out: what a few pixels of a million are like is chance.

    Args:
        path: Image file.
        tables: Name to a mapping with ``predicted``, ``observed`` and ``share`` of the samples.
        observed: What was predicted, for people.
        title: Above the axes.
    """
    figure, axes = _new_figure(4.2, 4.2)
    axes.plot([0, 1], [0, 1], "k:", linewidth=1)
    for k, (name, table) in enumerate(tables.items()):
        used = np.array(table["share"]) >= _LEAST_SHARE
        axes.plot(
            np.array(table["predicted"])[used],
            np.array(table["observed"])[used],
            marker=_MARKERS[k % len(_MARKERS)],
            markersize=4,
            label=name,
        )
    axes.set(xlabel="confidence", ylabel=observed, xlim=(0, 1), ylim=(0, 1))
    figure.suptitle(textwrap.fill(title, _TITLE_LETTERS), fontsize="medium")
    _name_below(figure, axes, 4)
    save_figure(figure, path)
