"""What a file or folder is, in a screenful: recordings, runs, sequences, videos, cameras and weights."""

import datetime
import json
import shlex
import tomllib
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from semcast.common.camera_settings import HOW_TO_GIVE
from semcast.common.errors import CheckpointError, SourceError
from semcast.common.file_lock import is_locked
from semcast.common.metrics import DUPLICATE
from semcast.common.recorded_streams import RecordedStream, recorded_streams
from semcast.common.recording_reader import RECORDING_METADATA, RecordingReader
from semcast.common.ros_bag_files import is_ros_bag
from semcast.common.run_folder import (
    FRAMES_NAME,
    RECONSTRUCTION_NAME,
    SUMMARY_NAME,
    files_of_run,
    read_image_paths,
    read_run,
)
from semcast.common.run_summary import read_summary
from semcast.common.trajectory import Trajectory
from semcast.describe_video import calibration_facts, camera_facts, is_calibration, video_facts
from semcast.server.export.parts import count_parts, parts_line
from semcast.server.export.placement import TWO_SIDED_95

#: Of a value that is shown; the rest is cut off.
_MAX_CHARS = 160
#: Heading and ``(name, value)`` lines; a name of "" goes on with the line before.
Section = tuple[str, list[tuple[str, str]]]


def describe(path: Path) -> list[Section]:
    """Say what a path holds.

    Args:
        path: A recording (``.mcap``), a run folder, a sequence folder, a transforms ``.json`` file, a
            video, a calibration file, a ROS bag, or weights (``.safetensors``, an exported encoder ``.onnx``
            or a shipped name such as ``3dcsc-lite``).

    Raises:
        SemcastError: It is none of these, or damaged.
    """
    if is_ros_bag(path):
        return describe_bag(path)
    if path.is_dir():
        if any((path / name).exists() for name in (RECONSTRUCTION_NAME, FRAMES_NAME, SUMMARY_NAME)):
            return describe_run(path)
        return describe_sequence(path)
    if path.suffix == ".mcap":
        return describe_recording(path)
    if path.suffix == ".onnx":
        return describe_encoder(path)
    if path.suffix == ".safetensors" or _is_bare_name(path):
        return describe_weights(path)
    if path.is_file():
        if is_calibration(path):
            return [(f"camera {path}", calibration_facts(path))]
        if path.suffix.lower() == ".json":
            return describe_sequence(path)
        with path.open("rb") as file:
            if file.read(5) == b"\x89MCAP":
                return describe_recording(path)
        if (facts := video_facts(path)) is not None:
            return [(f"video {path}", facts)]
    known = (
        "it must be a recording (.mcap), a folder that --out wrote, a sequence folder or transforms.json, "
        "a video, a calibration, a ROS bag, or weights (.safetensors, .onnx or a shipped name)"
    )
    if path.exists():
        raise SourceError(f"{path} is another kind of file, or damaged: {known}")
    raise SourceError(f"there is no file or folder {path}: {known}")


def describe_bag(path: Path) -> list[Section]:
    """Say what of a ROS bag can be made a sequence."""
    if find_spec("rosbags") is None:
        return [
            (f"ROS bag {path}", [("topics", "can't be read: pip install '.[ros]' in a checkout of semcast")])
        ]
    from semcast.agent.ros_bag import RosBag

    with RosBag(path) as bag:
        facts = [("time", f"{bag.span_s:.1f} s")]
        images = [(topic, f"{count:>6}") for topic, count in bag.counts("image").items()]
        poses = [(topic, f"{count:>6}") for topic, count in bag.counts("pose").items()]
        frames = sorted({name for said in bag.transforms() for name in (said.parent, said.child)})
    facts.append(("frames of /tf", ", ".join(frames) or "none"))
    facts.append(("a sequence is made of it by", f"semcast unpack {shlex.quote(str(path))} --out FOLDER"))
    return [(f"ROS bag {path}", facts), ("topics of images", images), ("topics of poses", poses)]


def _is_bare_name(path: Path) -> bool:
    return not path.suffix and len(path.parts) == 1 and not path.exists()


def describe_recording(path: Path) -> list[Section]:
    """Say what a recording holds: topics, counts, sizes, span, and whether it is whole."""
    reader = RecordingReader(path)
    info = reader.info()
    header = info.metadata.get(RECORDING_METADATA, {})
    if info.complete:
        state = "whole, by its index; 'semcast replay' tests every checksum"
    elif is_locked(path):
        state = "being recorded"
    else:
        state = "cut off: replay reads it up to there, 'semcast recover' mends it"
    facts = [("state", state), ("size", _bytes(reader.size_bytes))]
    if info.start_ns is not None and info.end_ns is not None:
        began = datetime.datetime.fromtimestamp(info.start_ns * 1e-9, datetime.UTC)
        span_s = (info.end_ns - info.start_ns) * 1e-9
        length = f"{span_s:.1f} s" if span_s >= 0 else "the clock was set back meanwhile"
        facts.append(("time", f"{began:%Y-%m-%d %H:%M:%S} UTC, {length}"))
    facts.append(("written by", f"semcast {header.get('semcast', '?')}, format {header.get('format', '?')}"))
    if info.num_damaged_chunks:
        facts.append(("damaged", f"{info.num_damaged_chunks} chunks left out"))
    topics = []
    for topic, count in sorted(info.counts.items()):
        missed = f", {info.missed[topic]} dropped by the recorder" if info.missed.get(topic) else ""
        kind, size = info.kinds.get(topic, "?"), _bytes(info.num_bytes[topic])
        topics.append((topic, f"{count:>6} {kind}, {size}{missed}"))
    sections: list[Section] = [(f"recording {path}", facts), ("messages", topics)]
    streams = [] if info.num_damaged_chunks else recorded_streams(reader)
    if streams:
        sections.append(("streams", [(f"--stream {k}", _stream(s)) for k, s in enumerate(streams, start=1)]))
    for name, values in info.metadata.items():
        if name != RECORDING_METADATA:
            sections.append((name, [(key, _short(value)) for key, value in sorted(values.items())]))
    settings = header.get("settings", "")
    if settings:
        sections.append(("settings of the recorder", _flat_toml(settings)))
    return sections


def _stream(stream: RecordedStream) -> str:
    camera = stream.camera
    began = datetime.datetime.fromtimestamp(camera.agent_epoch * 1e-9, datetime.UTC)
    return (
        f"{stream.agent_id}, {camera.codec}, begun {began:%H:%M:%S} UTC: "
        f"{stream.num_transmitted} frames sent, {stream.num_received} received"
    )


def describe_run(path: Path) -> list[Section]:
    """Say what came out of a run, from its summary and its arrays."""
    summary = read_summary(path)
    facts = [("state", f"no {SUMMARY_NAME}: the run is going on, or was killed")]
    if summary:
        try:
            facts = _figures(summary)
        except (AttributeError, KeyError, TypeError, ValueError) as err:
            raise SourceError(f"{path / SUMMARY_NAME} is none that a run wrote: {err}") from err
    parts = summary.get("parts") or []
    if (path / RECONSTRUCTION_NAME).is_file():
        data = read_run(path)
        parts = count_parts(data.frame_submap.tolist())
        facts.append(
            (
                "map",
                f"{len(data.landmark_ids)} landmarks, {len(data.keyframe_ids)} keyframes, "
                f"{len(data.observed_landmark_ids)} observations",
            )
        )
        facts += [
            (
                f"metre, part {known.part}" if len(parts) > 1 else "metre",
                f"a unit of the map is {known.m_per_unit:.4g} m, within "
                f"{100 * TWO_SIDED_95 * known.relative_sigma:.2g} % (95 %), by marker {known.marker_id}",
            )
            for known in data.metres
        ]
        camera = data.intrinsics
        facts.append(
            (
                "camera",
                f"{camera.width}x{camera.height}, fx {camera.fx:.1f} fy {camera.fy:.1f} "
                f"cx {camera.cx:.1f} cy {camera.cy:.1f} px",
            )
        )
    if line := parts_line(parts):
        facts.append(("parts", line))
    facts += _row_faults(path, summary)
    files = [(file.name, _bytes(file.stat().st_size)) for file in files_of_run(path)]
    images = read_image_paths(path)
    if images:
        files.append(("images/", f"{len(images)} decoded images"))
    versions = [(name, str(value)) for name, value in (summary.get("versions") or {}).items()]
    return [(f"run {path}", facts), ("files", files), ("made with", versions)]


def _row_faults(path: Path, summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Say what is wrong with the rows of a run, if anything is."""
    from semcast.server.frame_rows import RowsOnDisk

    there = RowsOnDisk.read(path / FRAMES_NAME)
    num_tracked = (summary.get("frames") or {}).get("tracked")
    texts = there.missing(num_tracked if isinstance(num_tracked, int) else None)
    if bad := there.bad:
        texts.append(f"damaged lines: {len(bad)}, the first: {bad[0]}")
    return [(FRAMES_NAME if k == 0 else "", text) for k, text in enumerate(texts)]


def _figures(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Return what a run's summary says, in words."""
    facts: list[tuple[str, str]] = []
    stream, frames = summary.get("stream") or {}, summary.get("frames") or {}
    size = "x".join(str(v) for v in stream.get("image_wh", ()))
    facts.append(("stream", f"{stream.get('agent_id', '?')}, {stream.get('codec', '?')}, {size}"))
    facts.append(("frames", ", ".join(f"{count} {name}" for name, count in frames.items())))
    for key, name, form in (
        ("completeness", "frames with a pose", "{:.1%}"),
        ("ate_percent", "position error (ATE)", "{:.2f} % of the path"),
        ("psnr_db", "image quality (PSNR)", "{:.2f} dB"),
        ("snr_estimated_db", "SNR at the receiver", "{:.1f} dB in frames that were decoded"),
        ("confidence_mean", "mean confidence", "{:.2f}"),
        ("frame_rate_hz", "tracked by recorded time", "{:.1f} frames a second"),
        ("processed_rate_hz", "tracked by time of arrival", "{:.1f} frames a second"),
    ):
        if summary.get(key) is not None:
            facts.append((name, form.format(summary[key])))
    num_posed, num_matched = summary.get("num_posed"), summary.get("num_matched")
    if summary.get("ate_percent") is not None and num_matched != num_posed:
        facts.append(("compared with the truth", f"{num_matched} of {num_posed} poses"))
    age = (summary.get("stage_ms") or {}).get("arrival_to_pose")
    if age:
        facts.append(("arrival to pose", f"p50 {age['p50']:.0f} ms, p95 {age['p95']:.0f} ms"))
    drops = dict(summary.get("drops") or {})
    num_repeated = drops.pop(DUPLICATE, 0)
    if drops:
        facts.append(("dropped frames", ", ".join(f"{n} {why}" for why, n in drops.items())))
    if num_repeated:
        facts.append(("frames that came twice", str(num_repeated)))
    return facts


def describe_sequence(path: Path) -> list[Section]:
    """Say what a recorded image sequence holds; what is missing is said, not an error."""
    from semcast.common.layouts.layout import find_layout, read_layout
    from semcast.common.sequence import open_sequence
    from semcast.common.times import ns_to_seconds

    layout = find_layout(path)
    sequence = open_sequence(path, layout=layout)
    facts = [("images", f"{len(sequence)}, {sequence.size_wh[0]}x{sequence.size_wh[1]} px")]
    facts += _refused(*sequence.refused_images())
    times_s = ns_to_seconds(sequence.times_ns)
    if len(times_s) > 1:
        rate_hz = (len(times_s) - 1) / (times_s[-1] - times_s[0])
        # Where a folder records no times, they follow the rate it is opened with.
        is_assumed = (sequence.times_ns != read_layout(path, layout, 2.0 * rate_hz).times_ns).any()
        note = ", assumed: no times are recorded" if is_assumed else ""
        facts.append(("time", f"{times_s[-1] - times_s[0]:.1f} s, {rate_hz:.1f} images a second{note}"))
    try:
        camera = sequence.intrinsics
        facts += camera_facts(camera, sequence.stored_camera)
    except SourceError:
        facts.append(("camera", f"unknown: {HOW_TO_GIVE}"))
    truth = sequence.groundtruth()
    facts.append(("true path", "none" if truth is None else _path(truth)))
    if doubt := sequence.doubt:
        facts.append(("order", doubt))
    return [(f"sequence {path}", facts)]


def _path(truth: Trajectory) -> str:
    length = f"{len(truth)} poses, {truth.path_length:.2f}"
    return f"{length} m" if truth.in_metres else f"{length} in a unit that the recording does not tell"


def _refused(messages: list[str], num_skipped: int, most: int = 5) -> list[tuple[str, str]]:
    """List images that can't be used, the first few by name."""
    facts = [("", message) for message in messages[:most]]
    if len(messages) > most:
        facts.append(("", f"and {len(messages) - most} more"))
    if messages:
        facts.insert(0, ("refused", f"{len(messages)} of these images"))
    if num_skipped:
        facts.append(("not looked at", f"{num_skipped} images, to be quick"))
    return facts


def describe_weights(path: Path) -> list[Section]:
    """Say what weights are, how they were made and what they reached."""
    from semcast.common.nets.manifest import read_manifest, weights_path

    try:
        file = weights_path(path if path.suffix else str(path))
    except CheckpointError as err:
        raise SourceError(f"there is no file, folder or codec {path}: {err}") from err
    manifest = read_manifest(file)
    low_db, high_db = manifest.snr_range_db
    facts = [
        ("architecture", f"{manifest.architecture} {json.dumps(manifest.sizes)}"),
        ("size", _bytes(file.stat().st_size)),
        ("sha256", manifest.sha256),
        ("channel uses", f"{manifest.cbr:.4f} for each source value, pilots included"),
        ("modulations", ", ".join(manifest.modulations)),
        ("trained for", f"{low_db:g}..{high_db:g} dB"),
    ]
    made = [(k, _short(v)) for k, v in manifest.made_by.items() if k != "settings"]
    measured = []
    for name, value in manifest.measured.items():
        measured += [(f"{name} {key}" if key else name, text) for key, text in _curves(value)]
    return [(f"weights {file.name}", facts), ("made by", made), ("measured", measured)]


def describe_encoder(path: Path) -> list[Section]:
    """Say what an exported encoder is."""
    if not path.is_file():
        raise SourceError(f"there is no file {path}")
    if find_spec("onnxruntime") is None:
        raise SourceError(f"onnxruntime is needed to read {path} (extra 'edge')")
    from semcast.common.nets.onnx_encoder import OnnxEncoder

    encoder = OnnxEncoder(path, num_threads=1)
    low_db, high_db = encoder.snr_range_db
    facts = [
        ("codec", encoder.name),
        ("size", _bytes(path.stat().st_size)),
        ("digest", f"{encoder.digest}, first digits of the sha256 of its weights"),
        ("convolutions", encoder.precision),
        ("trained for", f"{low_db:g}..{high_db:g} dB"),
    ]
    return [(f"encoder {path.name}", facts)]


def _curves(value: Any) -> list[tuple[str, str]]:
    """Shorten measurements: a curve becomes one line."""
    if not isinstance(value, dict):
        return [("", _short(value))]
    lines = []
    for key, inner in value.items():
        if isinstance(inner, list) and inner and isinstance(inner[0], dict) and "snr_db" in inner[0]:
            points = (f"{point['snr_db']:g} dB: {point.get('psnr_db', float('nan')):.1f}" for point in inner)
            lines.append((key, "PSNR dB at " + ", ".join(points)))
        else:
            lines.append((key, f"{inner:.4g}" if isinstance(inner, float) else _short(inner)))
    return lines


def _flat_toml(text: str) -> list[tuple[str, str]]:
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return [("", _short(text))]
    lines: list[tuple[str, str]] = []

    def walk(prefix: str, table: dict[str, Any]) -> None:
        for key, value in table.items():
            if isinstance(value, dict):
                walk(f"{prefix}{key}.", value)
            else:
                lines.append((f"{prefix}{key}", _short(value)))

    walk("", values)
    return lines


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value, default=str)
    text = " ".join(text.split())
    return text if len(text) <= _MAX_CHARS else text[: _MAX_CHARS - 1] + "…"


def _bytes(count: float) -> str:
    for unit in ("B", "KiB", "MiB"):
        if count < 1024:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:.1f} GiB"
