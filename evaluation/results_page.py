"""``docs/results.md`` and the generated parts of README and ``docs/confidence.md``, from result files.

Files are recognised by their names, ``<kind>_*.json``, see ``SECTIONS``. Each table is followed by its
pictures, ``<name>-*.png``, and by the command, commit and machine that made it.
"""

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from semcast.common.codec import DEFAULT_CODEC
from semcast.evaluation.depth_summary import depth_summary
from semcast.evaluation.link_summary import link_summary
from semcast.evaluation.markdown import number, table, with_part
from semcast.evaluation.mode_summary import mode_summary
from semcast.evaluation.pair_summary import RIVAL, pair_headline, pair_summary
from semcast.evaluation.path_tables import WORST_RATIO, readme_table, trajectory_table
from semcast.evaluation.pipeline import CLEAN
from semcast.evaluation.plots import variant_name
from semcast.evaluation.report import RESULTS, result_files
from semcast.evaluation.speed_table import speed_table
from semcast.evaluation.trace_snr import level_name
from semcast.evaluation.trajectory_summary import trajectory_summary

PAGE = Path("docs/results.md")
README = Path("README.md")
CONFIDENCE_PAGE = Path("docs/confidence.md")

Report = Mapping[str, Any]
Tables = Callable[[Report], Iterator[str]]

HEAD = f"""# Results

Written by `make results-page` from `evaluation/results/*.json`; each file holds the command, the seed, the
commit and the machine. Trajectory errors are after alignment by a similarity and of the path after the last
correction, when the stream has ended. They are medians over the seeds; in brackets the worst run, if its
error is more than {WORST_RATIO:g} times the median. Completeness is the share of the sent frames that have a
pose in that path, including those that got it later, in the run in which it is lowest. Where a map fell into
parts that never met, `most parts` is how many; place and scale of a later part are guesses, and what is wrong
with them counts in the error. `live` means poses as they were published with each frame; files without such
figures have no such columns. The true
paths of `shelf_50` and `phone_150` are not exact ([references](reading-results.md#references)). In the
codec tables PSNR of an outage counts the grey picture the receiver shows then (12.8 dB on Kodak); elsewhere
PSNR is a mean over the frames that could be decoded. The calibration error (ECE) of a codec table is a mean
over those of its images; in the tables of confidence it is that of all pixels together, which is smaller
where images err to either side. What the figures mean and what limits them is in
[reading the results](reading-results.md).
"""


def _codec(report: Report) -> Iterator[str]:
    rows = report["results"]
    ratios = sorted({row["cbr"] for row in rows})
    yield (
        f"{report['num_images']} images. Channel uses per source value, pilots included: "
        f"{', '.join(f'{cbr:.4f} (1/{1 / cbr:.1f})' for cbr in ratios)}.\n"
    )
    snrs = sorted({row["snr_db"] for row in rows})
    levels = [level_name(snr, report, " dB") for snr in snrs]
    for key, name, digits in (("psnr_db", "PSNR dB", 2), ("ssim", "SSIM", 3), ("ms_ssim", "MS-SSIM", 3)):
        body = []
        for codec in dict.fromkeys(row["codec"] for row in rows):
            at = {row["snr_db"]: row[key] for row in rows if row["codec"] == codec}
            body.append([codec, *(number(at.get(snr), digits) for snr in snrs)])
        yield from table([name, *levels], body)
        yield ""
    for key, name in (("ece", "ECE of confidence"), ("spearman_blocks", "Spearman, 8x8 blocks")):
        body = []
        for codec in dict.fromkeys(row["codec"] for row in rows):
            at = {row["snr_db"]: row["confidence"][key] for row in rows if row["codec"] == codec}
            body.append([codec, *(number(at.get(snr), 3) for snr in snrs)])
        yield from table([name, *levels], body)
        yield ""


def _lost_detail(report: Report) -> Iterator[str]:
    rows = [(photos, row) for photos in ("kept", "valid") for row in report[photos]]
    yield (
        "Calibration error (ECE) with the map as it was decoded and with what scaling adds; the last two "
        "are of all pixels together. Photos `kept` are of `train/` but not of the fit. Factors: "
        f"{' and '.join(f'{factor:.3f}' for factor in report['fitted'])} fitted, "
        f"{' and '.join(f'{factor:g}' for factor in report['used'])} used.\n"
    )
    keys = [f"{kind}_{name}" for kind in ("ece", "ece_of_all") for name in ("as_decoded", "with_lost_detail")]
    yield from table(
        ["photos", "codec", "rate", "SNR dB", "as decoded", "with it", "all: as decoded", "all: with it"],
        [
            [photos, row["codec"], row["rate"], f"{row['snr_db']:g}", *(number(row[key], 3) for key in keys)]
            for photos, row in rows
        ],
    )


def _trajectory(report: Report) -> Iterator[str]:
    yield from _other_codec(report)
    yield from trajectory_table(report)


def _other_codec(report: Report) -> Iterator[str]:
    if report["settings"]["codec"] not in (CLEAN, DEFAULT_CODEC):
        yield from _named_codec(report)


def _named_codec(report: Report) -> Iterator[str]:
    yield f"Codec `{report['settings']['codec']}`.\n"


def _pairs(report: Report) -> Iterator[str]:
    methods = list(report["results"])
    yield from _other_codec(report)
    yield "Mean translation-direction error in degrees; the last column is its 95 % interval.\n"
    rows = []
    for cell in report["cells"]:
        snr = level_name(cell["snr_db"], report)
        found = [number(cell["results"][m]["tdir_deg_mean"], 1) for m in methods]
        rows.append([snr, variant_name(cell), *found, _interval(cell)])
    yield from table(["SNR dB", "matches", *methods, f"robust - {RIVAL}"], rows)


def _interval(cell: Mapping[str, Any]) -> str:
    for c in cell["comparisons"]:
        if (c["mode"], c["against"], c["figure"]) == ("robust", RIVAL, "tdir_deg_mean") and c["paired"]:
            low, high = c["paired"]["low"], c["paired"]["high"]
            return "-" if low is None else f"{low:+.1f} .. {high:+.1f}"
    return "-"


def _confidence(report: Report) -> Iterator[str]:
    yield from _named_codec(report)
    for result in report["results"]:
        yield f"{level_name(result['snr_db'], report, ' dB')}:\n"
        rows = [
            [f"{target}: {name}", number(value, 3)]
            for target, grades in result.items()
            if isinstance(grades, dict)
            for name, value in grades.items()
            if value is None or isinstance(value, (int, float))
        ]
        yield from table(["grade", "value"], rows)
        yield ""
        for target in ("pixel", "keypoint"):
            maps = result[target]["maps"]
            names = sorted({name for grades in maps.values() for name in grades})
            body = [[map_, *(number(grades.get(name), 3) for name in names)] for map_, grades in maps.items()]
            yield from table([f"map, against the {_TRUTH[target]}", *names], body)
            yield ""


#: What each target's maps are graded against.
_TRUTH = {"pixel": "error of pixels", "keypoint": "displacement of keypoints"}


def _latency(report: Report) -> Iterator[str]:
    width, height = report["image_wh"]
    yield from _named_codec(report)
    yield f"{report['num_frames']} frames of {width}x{height}. Bottleneck: **{report['bottleneck']}**.\n"
    yield from table(
        ["stage", "p50 ms", "p95 ms", "runs on", "share of time"],
        [
            [
                name,
                number(s["p50"], 1),
                number(s["p95"], 1),
                f"{s['ran_share']:.0%}",
                f"{s['time_share']:.0%}",
            ]
            for name, s in report["stages"].items()
        ],
    )


def _demo(report: Report) -> Iterator[str]:
    width, height = report["stream"]["image_wh"]
    codec = report["stream"]["codec"]
    yield f"Three live processes and the viewer's recording, {width}x{height}, codec {codec}.\n"
    rows = [
        ["frames with a pose", f"{report['completeness']:.1%}"],
        ["ATE RMSE", f"{number(report['ate_rmse_m'], 3)} m"],
        ["ATE in percent of the path", f"{number(report['ate_percent'], 3)} %"],
        ["PSNR", f"{number(report['psnr_db'])} dB"],
    ]
    rows += [[f"dropped: {reason}", str(count)] for reason, count in report["drops"].items()]
    for stage, figures in report["stage_ms"].items():
        rows.append([f"{stage}, p50 / p95", f"{number(figures['p50'], 1)} / {number(figures['p95'], 1)} ms"])
    yield from table(["figure", "value"], rows)


def _server(report: Report) -> Iterator[str]:
    width, height = report["image_wh"]
    yield f"Codec `{report['codec']}`.\n"
    yield f"{report['rate_hz']:.1f} frames a second of {width}x{height}; each row is a run of a new server.\n"
    stages = {"decode": "decode", "decoded_to_pose": "decoded to pose", "arrival_to_pose": "arrival to pose"}
    yield from table(
        ["sent", "tracked", "with a pose", *(f"{name}, p50 / p95 ms" for name in stages.values())],
        [
            [
                str(run["frames"]["sent"]),
                str(run["frames"]["tracked"]),
                f"{run['completeness']:.1%}",
                *(
                    " / ".join(number(run["stage_ms"].get(stage, {}).get(q), 1) for q in ("p50", "p95"))
                    for stage in stages
                ),
            ]
            for run in report["results"]
        ],
    )


def _runtime(report: Report) -> Iterator[str]:
    settings = report["settings"]
    yield f"Images of {settings['width']}x{settings['height']}; all variants take turns in one run.\n"
    head = ["codec", "work", "runtime", "instruction sets", "precision", "threads"]
    keys = ("codec", "work", "runtime", "isa", "precision", "threads")
    yield from table(
        [*head, "p50 ms", "p95 ms", "per second"],
        [
            [*(str(row.get(k, "-")) for k in keys), *(number(row[k], 1) for k in ("p50_ms", "p95_ms", "fps"))]
            for row in report["results"]
        ],
    )


def _sampled(rows: Sequence[Any], count: int) -> list[Any]:
    """Return about so many of the rows, evenly spaced, the last one always."""
    step = max(1, len(rows) // count)
    chosen = sorted({*range(step - 1, len(rows), step), len(rows) - 1})
    return [rows[k] for k in chosen]


def _endurance(report: Report) -> Iterator[str]:
    yield from _named_codec(report)
    body = [
        [
            row["frames"],
            f"{row['posed_share']:.1%}",
            number(row["frame_ms_p50"], 1),
            number(row["frame_ms_p95"], 1),
            row["landmarks"],
            row["keyframes"],
            number(row["memory_mb"] + row["bundle_memory_mb"], 0),
            number(row.get("ate_percent")),
        ]
        for row in report["results"]
    ]
    head = ["frames", "posed", "p50 ms", "p95 ms", "landmarks", "keyframes", "memory MB", "ATE %"]
    yield from table(head, _sampled(body, 5))


def _depth(report: Report) -> Iterator[str]:
    against = "the exact depth" if report["reference"] == "exact" else "that from the original images"
    poses = "true" if report["settings"]["poses"] == "true" else "those estimated from the original images"
    yield f"{report['num_keyframes']} keyframes, measured against {against}; poses are {poses}.\n"
    figures = {
        "coverage": ("coverage", ".1%"),
        "median error": ("median_error", ".2%"),
        "off by 5 %": ("outlier_share", ".1%"),
    }
    cloud = {
        "points off by": ("accuracy_median", ".2%"),
        "nine in ten within": ("accuracy_p90", ".2%"),
        "of what was seen": ("completeness", ".1%"),
    }
    if not any(row.get("cloud") for row in report["results"]):
        cloud = {}
    yield from table(
        ["codec", "SNR dB", "confidence", *figures, *cloud, "PSNR dB", "lost"],
        [
            [
                row["codec"],
                "-" if row["snr_db"] is None else f"{row['snr_db']:g}",
                row["confidence"],
                *("-" if row[name] is None else format(row[name], form) for name, form in figures.values()),
                *(
                    "-" if row["cloud"][name] is None else format(row["cloud"][name], form)
                    for name, form in cloud.values()
                ),
                number(row["psnr_db"]),
                f"{row['lost']:.0%}",
            ]
            for row in report["results"]
        ],
    )
    if cloud:
        yield (
            "\nThe points that these depths become: how far they are from a surface, in shares of that to "
            "the camera, and how much of what keyframes saw has one within 2 % of its distance."
        )


def _training(report: Report) -> Iterator[str]:
    curve = report["curve"]
    rows = [[r["step"], r["elapsed_s"], number(r["train_psnr_db"])] for r in _sampled(curve, 8)]
    yield from table(["step", "seconds", "PSNR dB of training crops"], rows)
    yield f"\n{report['what'][0].upper()}{report['what'][1:]}."


def _ablation(report: Report) -> Iterator[str]:
    keys = {
        "psnr_db": "PSNR dB",
        "descriptor": "descriptor distance",
        "corner_px": "corners move by px",
        "ece": "ECE of confidence",
        "spearman_corners": "Spearman, corners",
    }
    rows = [[row["loss"], *(number(row[key], 3) for key in keys)] for row in report["results"]]
    yield from table(["loss", *keys.values()], rows)
    yield f"\n{report['steps']} steps of {report['batch']} crops each; {report['what']}."


def _recording(report: Report) -> Iterator[str]:
    rows = [
        ["share of a core", f"{report['core_share']:.1%}"],
        [
            "a sender is held up, p50 / p99",
            f"{report['put_us']['p50']:.0f} / {report['put_us']['p99']:.0f} us",
        ],
        ["written", f"{report['bytes_per_s'] / 1e6:.1f} MB/s"],
        ["messages dropped", str(report["dropped"])],
    ]
    yield from table(["figure", "value"], rows)


def _readout(report: Report) -> Iterator[str]:
    low_ms, high_ms = report["interval_ms"]
    found = f"{report['least_ms']:.1f} ms along {report['axis']} ({low_ms:.1f} to {high_ms:.1f})"
    yield f"Found: {found}. Below 0: from bottom or right.\n"
    yield from table(
        ["put right for ms", "along", "reprojection error px", "frames", "left over ms", "along"],
        [
            [
                f"{row['signed_ms']:.1f}",
                row["axis"],
                number(row["error_px"], 3),
                str(row["num_frames"]),
                "-" if row["more_ms"] is None else f"{row['more_ms']:.1f} +- {row['sigma_ms']:.1f}",
                row["more_axis"] or "-",
            ]
            for row in report["trials"]
        ],
    )


def _lens(report: Report) -> Iterator[str]:
    before, found = report["before"], report["found"]
    reach = report["focal_reach"] * found["fx"]
    bent = "".join(
        f" k{number} {k:.4f} +- {reach_k:.4f}."
        for number, (k, reach_k) in enumerate(
            zip(found["distortion"], report["radial_reach"], strict=False), 1
        )
    )
    if report["centre_reach_px"]:
        x, y = report["centre_reach_px"]
        bent += f" Principal point {found['cx']:.1f} +- {x:.1f}, {found['cy']:.1f} +- {y:.1f} px."
    yield f"Focal length {before['fx']:.1f} px before, {found['fx']:.1f} +- {reach:.1f} px found.{bent}\n"
    yield from table(
        [
            "focal length x",
            "k1 +",
            "k2 +",
            "centre + x",
            "centre + y",
            "reprojection error px",
            "frames",
            "left over, focal length %",
        ],
        [
            [
                f"{row['focal']:.4f}",
                *(f"{value:.4f}" for value in (*row["radial"], *row["centre"])),
                number(row["error_px"], 3),
                str(row["num_frames"]),
                "-" if row["more_focal"] is None else f"{100 * row['more_focal']:+.2f}",
            ]
            for row in report["trials"]
        ],
    )


SECTIONS: dict[str, tuple[str, Tables]] = {
    "demo": ("The live demo", _demo),
    "codec": ("Image quality per channel use", _codec),
    "lost": ("Confidence of pictures coded smaller", _lost_detail),
    "trajectory": ("Trajectories", _trajectory),
    "shutter": ("Rolling shutters, put right and not", _trajectory),
    "readout": ("Readout times found", _readout),
    "lens": ("Lenses found", _lens),
    "lorry": ("Behind a lorry", _trajectory),
    "variable": ("Paths with a variable rate, and with a fixed one", _trajectory),
    "focal": ("Paths with a lens that was guessed, and found", _trajectory),
    "pairs": ("Relative pose of frame pairs", _pairs),
    "confidence": ("What the confidence maps are worth", _confidence),
    "depth": ("Depth from decoded images", _depth),
    "latency": ("Where the time goes", _latency),
    "server": ("The server alone, live", _server),
    "runtime": ("How fast encoder and decoder are", _runtime),
    "recording": ("What recording costs", _recording),
    "endurance": ("Running for long", _endurance),
    "ablation": ("What each term of the loss does", _ablation),
    "training": ("How the weights were trained", _training),
}


def results_page(folder: Path = RESULTS) -> str:
    """Return the page for all result files of a folder as Markdown."""
    lines = [HEAD]
    for kind, (title, tables) in SECTIONS.items():
        files = result_files(folder, f"{kind}_*.json")
        if files:
            lines.append(f"## {title}\n")
        for file in files:
            report = json.loads(file.read_text(encoding="utf-8"))
            lines.append(f"### {file.stem.removeprefix(kind + '_').replace('_', ' ')}\n")
            lines.extend(tables(report))
            for picture in sorted(folder.glob(f"{file.stem}-*.png")):
                lines.append(f"\n![{picture.stem.replace('-', ', ').replace('_', ' ')}](../{picture})")
            commit = str(report.get("commit", "")).partition("+")
            made = f"commit {commit[0][:12]}{commit[1]}{commit[2]}" if commit[0] else "see the file"
            lines.append(
                f"\n`{report.get('command', file.name)}` ({made}, {report.get('machine', '')}; `{file}`)\n"
            )
    return "\n".join(lines)


def _reports(pattern: str) -> Iterator[Report]:
    for file in result_files(RESULTS, pattern):
        yield json.loads(file.read_text(encoding="utf-8"))


#: Parts of the page on confidence by the names of their markers, and what makes each of them.
CONFIDENCE_PARTS: dict[str, Callable[[], str]] = {
    "in short": lambda: pair_headline(_reports("pairs_*.json")),
    "pairs": lambda: pair_summary(_reports("pairs_*.json")),
    "depth": lambda: depth_summary(next(_reports("depth_room.json"))),
    "trajectories": lambda: trajectory_summary(_reports("trajectory_*.json")),
    "links": lambda: link_summary(_reports("trajectory_*.json")),
    "modes": lambda: mode_summary(_reports("trajectory_rayleigh_*_again_*.json")),
}


if __name__ == "__main__":
    if not (PAGE.is_file() and RESULTS.is_dir()):
        sys.exit(f"the pages are those of a checkout: there is no {PAGE} here; run this in its top folder")
    PAGE.write_text(results_page(), encoding="utf-8")
    for page, name, part in (
        (README, "results", readme_table(RESULTS)),
        (README, "speed", speed_table(RESULTS)),
        *((CONFIDENCE_PAGE, name, make()) for name, make in CONFIDENCE_PARTS.items()),
    ):
        page.write_text(with_part(page.read_text(encoding="utf-8"), name, part), encoding="utf-8")
