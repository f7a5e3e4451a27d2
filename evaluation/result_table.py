"""What ``semcast eval`` prints of a result: the figures that say most, in 80 columns."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from semcast.evaluation.trace_snr import snr_heading, trace_notes

Report = Mapping[str, Any]
#: A column that has another name, or none, where the SNR follows a trace.
_SNR = "SNR dB"


@dataclass(frozen=True)
class ResultTable:
    """A table as text.

    Attributes:
        head: Names of the columns.
        rows: As many cells each; a dash where there is no figure.
        notes: Lines to print below.
    """

    head: list[str]
    rows: list[list[str]]
    notes: list[str]


@dataclass(frozen=True)
class _Layout:
    """How the table of an evaluation is made.

    Attributes:
        rows: Finds the rows in the result.
        columns: Name of a column -> where in a row its figure is, dots between keys, and its format.
        notes: Returns the lines below the table.
        optional: Columns that are left out where no row has a figure.
    """

    rows: Callable[[Report], list[dict[str, Any]]]
    columns: dict[str, tuple[str, str]]
    notes: Callable[[Report], list[str]] = lambda report: []
    optional: frozenset[str] = frozenset()


def result_table(what: str, report: Report) -> ResultTable:
    """Return the table of what an evaluation returned.

    Args:
        what: Name of the evaluation, such as ``trajectory``.
        report: What it returned.
    """
    layout = LAYOUTS[what]
    entries = layout.rows(report)
    columns = {
        str(snr_heading(report)) if name == _SNR else name: column
        for name, column in layout.columns.items()
        if (name != _SNR or snr_heading(report) is not None)
        and (name not in layout.optional or any(_cell(entry, *column) != "-" for entry in entries))
    }
    rows = [[_cell(entry, *column) for column in columns.values()] for entry in entries]
    partial = ["Partial: interrupted before all was measured."] if report.get("partial") else []
    return ResultTable(list(columns), rows, [*partial, *trace_notes(report), *layout.notes(report)])


def _cell(row: Mapping[str, Any], where: str, form: str) -> str:
    value: Any = row
    for key in where.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return "-" if value is None else format(value, form)


def _cloud_note(row: Mapping[str, Any]) -> str:
    link = "" if row["snr_db"] is None else f" at {row['snr_db']:g} dB, confidence {row['confidence']}"
    figures = [
        _cell(row["cloud"], name, form)
        for name, form in (("accuracy_median", ".2%"), ("accuracy_p90", ".2%"), ("completeness", ".1%"))
    ]
    if not row["cloud"]["points"]:
        return f"Cloud of {row['codec']}{link}: no points."
    return (
        f"Cloud of {row['codec']}{link}: {row['cloud']['points']:.0f} points, half of them within "
        f"{figures[0]} of a surface, nine in ten within {figures[1]}; {figures[2]} of what was seen has one."
    )


def _named(entries: Mapping[str, dict[str, Any]]) -> list[dict[str, Any]]:
    return [{"name": name, **entry} for name, entry in entries.items()]


def _trajectory_notes(report: Report) -> list[str]:
    note = (
        "Medians over seeds. ATE and posed are of the path after the last correction, with frames that got "
        "their pose later."
    )
    is_live = any("ate_at_once_percent" in cell for cell in report["cells"])
    return [f"{note} Live: of the poses as they were published with each frame." if is_live else note]


def _pair_notes(report: Report) -> list[str]:
    num_pairs = max(entry["num_pairs"] for entry in report["results"].values())
    return [
        f"Errors of rotation and direction of the translation in degrees, mean and median, over {num_pairs} "
        "pairs: all SNRs, seeds and kinds of matches together. AUC: of the larger error, up to 5, 10 and 20 "
        "degrees, in percent."
    ]


LAYOUTS: dict[str, _Layout] = {
    "trajectory": _Layout(
        lambda report: report["cells"],
        {
            _SNR: ("snr_db", "g"),
            "mode": ("confidence", ""),
            "ATE m": ("ate_rmse_m", ".3f"),
            "ATE %": ("ate_percent", ".2f"),
            "live %": ("ate_at_once_percent", ".2f"),
            "posed": ("completeness", ".1%"),
            "posed live": ("completeness_at_once", ".1%"),
            "PSNR dB": ("psnr_db", ".2f"),
            "again": ("recovery_s", ".2f"),
            "failed": ("num_failed", "d"),
        },
        _trajectory_notes,
        optional=frozenset({"live %", "posed live", "again"}),
    ),
    "pairs": _Layout(
        lambda report: _named(report["results"]),
        {
            "method": ("name", ""),
            "rot": ("rot_deg_mean", ".3f"),
            "rot p50": ("rot_deg_median", ".3f"),
            "dir": ("tdir_deg_mean", ".2f"),
            "dir p50": ("tdir_deg_median", ".2f"),
            "AUC5": ("auc5", ".1f"),
            "AUC10": ("auc10", ".1f"),
            "AUC20": ("auc20", ".1f"),
            "failed": ("num_failed", "d"),
        },
        _pair_notes,
    ),
    "codec": _Layout(
        lambda report: report["results"],
        {
            "codec": ("codec", ""),
            _SNR: ("snr_db", "g"),
            "PSNR dB": ("psnr_db", ".2f"),
            "SSIM": ("ssim", ".3f"),
            "MS-SSIM": ("ms_ssim", ".3f"),
            "outage": ("outage", ".0%"),
            "CBR": ("cbr", ".4f"),
            "enc ms": ("encode_ms.p50", ".0f"),
            "dec ms": ("decode_ms.p50", ".0f"),
        },
    ),
    "confidence": _Layout(
        lambda report: report["results"],
        {
            _SNR: ("snr_db", "g"),
            "frames": ("num_frames", "d"),
            "lost": ("num_frames_lost", "d"),
            "PSNR dB": ("psnr_db", ".2f"),
            "pixel ECE": ("pixel.ece", ".3f"),
            "pixel rank": ("pixel.maps.confidence.spearman_pixel", ".2f"),
            "corner rank": ("keypoint.maps.keypoint_confidence.spearman", ".2f"),
            "moved px": ("keypoint.displacement_px_median", ".2f"),
        },
        lambda report: [
            "Rank: Spearman correlation of the codec's doubt with the error of pixels, and with how far "
            "corners moved; 1 is best."
        ],
    ),
    "depth": _Layout(
        lambda report: report["results"],
        {
            "codec": ("codec", ""),
            _SNR: ("snr_db", "g"),
            "confidence": ("confidence", ""),
            "coverage": ("coverage", ".1%"),
            "median": ("median_error", ".2%"),
            "off by 5 %": ("outlier_share", ".1%"),
            "PSNR dB": ("psnr_db", ".2f"),
            "lost": ("lost", ".0%"),
        },
        lambda report: [
            f"Depth that other keyframes confirm, over {report['num_keyframes']} keyframes. Coverage: share "
            f"of the pixels with {report['reference']} depth. Errors are relative to it.",
            *(_cloud_note(row) for row in report["results"] if row.get("cloud")),
        ],
    ),
    "latency": _Layout(
        lambda report: _named(report["stages"]),
        {
            "stage": ("name", ""),
            "p50 ms": ("p50", ".1f"),
            "p95 ms": ("p95", ".1f"),
            "max ms": ("max", ".1f"),
            "runs on": ("ran_share", ".0%"),
            "share of time": ("time_share", ".0%"),
        },
        lambda report: [f"{report['num_frames']} frames. Bottleneck: {report['bottleneck']}"],
    ),
    "endurance": _Layout(
        lambda report: report["results"],
        {
            "frames": ("frames", "d"),
            "posed": ("posed_share", ".1%"),
            "p50 ms": ("frame_ms_p50", ".1f"),
            "p95 ms": ("frame_ms_p95", ".1f"),
            "landmarks": ("landmarks", "d"),
            "keyframes": ("keyframes", "d"),
            "MB": ("memory_mb", ".0f"),
            "bundle MB": ("bundle_memory_mb", ".0f"),
            "ATE %": ("ate_percent", ".2f"),
        },
    ),
    "runtime": _Layout(
        lambda report: report["results"],
        {
            "codec": ("codec", ""),
            "work": ("work", ""),
            "runtime": ("runtime", ""),
            "ISA": ("isa", ""),
            "precision": ("precision", ""),
            "threads": ("threads", "d"),
            "p50 ms": ("p50_ms", ".1f"),
            "p95 ms": ("p95_ms", ".1f"),
            "per s": ("fps", ".1f"),
        },
        lambda report: [
            f"{row['codec']}, {row['work']}, {row['runtime']}: {row['error']}"
            for row in report["results"]
            if "error" in row
        ],
    ),
    "server": _Layout(
        lambda report: report["results"],
        {
            "sent": ("frames.sent", "d"),
            "tracked": ("frames.tracked", "d"),
            "posed": ("completeness", ".1%"),
            "to pose p50 ms": ("stage_ms.decoded_to_pose.p50", ".1f"),
            "p95 ms": ("stage_ms.decoded_to_pose.p95", ".1f"),
            "decode p50 ms": ("stage_ms.decode.p50", ".1f"),
        },
        lambda report: [
            f"{report['rate_hz']:.1f} frames a second; 'to pose' is from the end of the decoder to the pose"
        ],
    ),
    "recording": _Layout(
        lambda report: [dict(report)],
        {
            "share of a core": ("core_share", ".1%"),
            "put p50 us": ("put_us.p50", ".0f"),
            "put p99 us": ("put_us.p99", ".0f"),
            "bytes/s": ("bytes_per_s", ".0f"),
            "dropped": ("dropped", "d"),
        },
    ),
}
