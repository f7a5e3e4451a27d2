"""``semcast eval depth``: depth maps from decoded images, beside the truth or those of the originals.

Fig. 11 of the paper with figures. Poses are the same for all codecs, so that only depth differs; only
keyframes are sent.
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.channel.link import Link
from semcast.channel.settings import ChannelSettings
from semcast.common.camera_settings import CameraSettings
from semcast.common.codec import DEFAULT_CODEC, MODULATION_HELP, PRECISION_HELP, Codec, Modulation, Precision
from semcast.common.codecs import load_codec
from semcast.common.config import check_at_least
from semcast.common.cores import check_threads
from semcast.common.errors import SourceError
from semcast.common.image import psnr_db
from semcast.common.sequence import Sequence as RecordedSequence
from semcast.common.sequence import open_sequence
from semcast.common.trajectory import Trajectory
from semcast.common.trajectory_error import ate, match_times
from semcast.evaluation.cloud_error import CloudError, TrueView, cloud_error
from semcast.evaluation.interruption import until_interrupted
from semcast.evaluation.keyframe_depth import DepthKeyframe, cloud_points, confirmed_depths, reconstructed
from semcast.evaluation.picture_strip import write_picture_strip
from semcast.evaluation.pipeline import CLEAN, UNUSED_LINK_FIELDS, check_seeds, run_frames
from semcast.evaluation.report import naming, provenance, short_names, write_result
from semcast.evaluation.scenes.motion import Pace
from semcast.evaluation.scenes.render import SCENES, RenderSettings, SceneName, render_scene
from semcast.evaluation.scenes.surfaces import exact_depth
from semcast.evaluation.statistics import finite_mean
from semcast.evaluation.trace_snr import check_snrs, snr_label, stated_snr_db
from semcast.server.dense.depth_map import DepthImage
from semcast.server.dense.view import View, view_of
from semcast.server.export.outputs import trajectory_of
from semcast.server.mapping.settings import ReconstructionSettings

VERB = "eval depth"
UNUSED_FIELDS = UNUSED_LINK_FIELDS
_SNRS_DB = (10.0, 2.0)
#: Depths off by a larger share are outliers.
_OUTLIER = 0.05
#: Whether the codec's pixel confidence is used.
ConfidenceUse = Literal["on", "off"]


@dataclass(frozen=True, kw_only=True)
class DepthSettings:
    """Settings of ``evaluate_depth``.

    Raises:
        ValueError: A value is out of range.
    """

    sequence: Path | None = field(
        default=None,
        metadata={
            "help": "recorded sequence, measured against depth from its original images; without it a scene "
            "is drawn, and its depth is known exactly"
        },
    )
    camera: CameraSettings = field(
        default=CameraSettings(), metadata={"help": "intrinsics, where the recording has none"}
    )
    scene: SceneName = field(default="room", metadata={"help": "scene to draw: " + ", ".join(SCENES)})
    pace: Pace = field(default="normal", metadata={"help": "how fast the camera of a scene moves"})
    scene_seed: int = field(default=0, metadata={"help": "seed of the scene and its path"})
    seconds: float = field(default=4.0, metadata={"help": "length of the scene, at most 120"})
    poses: Literal["estimated", "true"] = field(
        default="estimated",
        metadata={"help": "poses of all codecs: estimated from the original images, or true ones"},
    )
    codec: tuple[str, ...] = field(
        default=(DEFAULT_CODEC, "jpeg-ldpc"),
        metadata={"help": "codecs by name or .safetensors file, one or more"},
    )
    modulation: Modulation = field(default="16qam", metadata={"help": MODULATION_HELP})
    snr_db: tuple[float, ...] = field(default=_SNRS_DB, metadata={"help": "SNRs in dB, one or more"})
    link: ChannelSettings = field(default=ChannelSettings(), metadata={"help": "the channel"})
    confidence: tuple[ConfidenceUse, ...] = field(
        default=("on", "off"), metadata={"help": "with or without the codec's confidence, or both: on, off"}
    )
    seed: int = field(default=0, metadata={"help": "first seed of the channel"})
    seeds: int = field(default=1, metadata={"help": "number of seeds, from --seed upwards"})
    max_frames: int | None = field(default=None, metadata={"help": "frames used at most"})
    stride: int = field(default=1, metadata={"help": "use every n-th frame"})
    threads: int = field(default=2, metadata={"help": "threads of a learned codec"})
    precision: Precision = field(default="auto", metadata={"help": PRECISION_HELP})
    json: Path | None = field(default=None, metadata={"help": "file for the result, - for stdout"})
    out: Path | None = field(
        default=None, metadata={"help": "folder for pictures of depth and, without --json, result.json"}
    )

    def __post_init__(self) -> None:
        """Check ranges."""
        check_snrs(self.snr_db, self.link, _SNRS_DB)
        for name in ("codec", "confidence"):
            values = getattr(self, name)
            if not values or len(set(values)) != len(values):
                raise ValueError(f"{name} must be one or more different names, got {values}")
        check_at_least(self, scene_seed=0, stride=1, max_frames=1)
        check_seeds(self.seed, self.seeds)
        if not 0 < self.seconds <= 120:
            raise ValueError(f"seconds must be in (0, 120], got {self.seconds:g}")
        check_threads(self.threads)
        self._check_of_use()

    def _check_of_use(self) -> None:
        """Check that nothing is set that is of a scene where a recording is measured, or the other way."""
        if self.sequence is None and self.camera != CameraSettings():
            raise ValueError("camera values are of a recording, and there is none (--sequence)")
        for entry in fields(self):
            of_scene = entry.name in ("scene", "pace", "scene_seed", "seconds")
            if self.sequence is not None and of_scene and getattr(self, entry.name) != entry.default:
                raise ValueError(
                    f"{entry.name} is of a scene to draw, and none is drawn with --sequence, "
                    f"got {getattr(self, entry.name)}"
                )


@dataclass(frozen=True)
class _Scene:
    """Keyframes of the originals with what their depth is measured against.

    Attributes:
        sequence: The original images.
        keyframes: By frame id; poses in the units of ``metres``.
        metres: Metres in a unit of the poses; 1 where there is no truth.
        truth: What each keyframe saw; None for sequences that were not drawn.
    """

    sequence: RecordedSequence
    keyframes: dict[int, DepthKeyframe]
    metres: float
    truth: dict[int, TrueView] | None


def evaluate_depth(settings: DepthSettings, codecs: Sequence[Codec] | None = None) -> dict[str, Any]:
    """Estimate depth of keyframes from original and from decoded images and compare.

    Args:
        settings: What to measure.
        codecs: Used instead of the codecs that ``settings.codec`` names.

    Returns:
        Provenance, ``sequence``, ``num_keyframes``, ``reference`` (``exact`` depth of a drawn scene, or that
        from ``original`` images) and ``results``: a row for the original images where depth is exact, and one
        per codec, SNR and use of confidence, over keyframes and seeds: ``coverage``, the share of pixels with
        a reference that have a confirmed depth too; of these ``median_error``, relative, and
        ``outlier_share``, off by more than 5 % or where there is nothing; ``psnr_db``; and ``lost``, the
        share of keyframes that did not arrive, whose pixels have no depth. Of drawn scenes ``cloud`` holds
        figures of the points that these depths become, see ``CloudError``.

    Raises:
        SourceError: The recording can't be read, or has no keyframes to tell depth from.
        ConfigError: A codec is unknown.
        SemcastError: A result can't be written.
    """
    settings = naming(settings, codecs)
    if codecs is None:
        codecs = [
            load_codec(
                name,
                modulation=settings.modulation,
                num_threads=settings.threads,
                precision=settings.precision,
            )
            for name in settings.codec
        ]
    under_name = dict(zip(short_names(settings.codec), codecs, strict=True))
    with tempfile.TemporaryDirectory() as folder:
        scene = _prepared(settings, Path(folder))
        originals = {k: scene.sequence.image(k) for k in scene.keyframes}
        views = {k: view_of(k, image, None, scene.sequence.intrinsics) for k, image in originals.items()}
        clean = _Depths.of(scene, views)
        against = _Reference(scene, views, clean.inverse)
        shown = sorted(views)[len(views) // 2]
        strip = [against.pictures(shown, views[shown])]
        results = [] if scene.truth is None else [_row(CLEAN, None, "off", against, [clean], [], 0.0)]
        with until_interrupted(results) as part:
            for snr_db in settings.snr_db[:1] if settings.link.has_own_snr else settings.snr_db:
                pictures = {}
                for name, codec in under_name.items():
                    rows, picture = _measured(settings, scene, against, name, codec, snr_db, shown)
                    results += rows
                    pictures[f"{name}, {snr_label(snr_db, settings.link)}"] = picture
                strip.append(pictures)
    report = write_result(
        settings.json,
        {
            **provenance(VERB, settings),
            "sequence": settings.scene if settings.sequence is None else scene.sequence.name,
            "num_keyframes": len(scene.keyframes),
            "reference": "original" if scene.truth is None else "exact",
            "results": results,
        },
        part,
    )
    if settings.out is not None:
        write_picture_strip(settings.out / "depth.png", strip)
    return report


def _prepared(settings: DepthSettings, folder: Path) -> _Scene:
    """Draw or open the originals, and find keyframes, poses and true depth."""
    if settings.sequence is None:
        drawing = RenderSettings(
            scene=settings.scene,
            pace=settings.pace,
            seed=settings.scene_seed,
            seconds=settings.seconds,
            out=folder,
        )
        render_scene(drawing)
    sequence = open_sequence(settings.sequence or folder, settings.camera)
    ids = list(range(0, len(sequence), settings.stride))[: settings.max_frames]
    frames = run_frames(sequence, ids, None, None)
    poses, keyframes = reconstructed(frames, sequence.intrinsics, ReconstructionSettings())
    if not keyframes:
        raise SourceError(f"{sequence.name} has no keyframes: its images tell no movement of the camera")
    truth, metres = sequence.groundtruth(), 1.0
    estimated = trajectory_of(poses, {k: int(sequence.times_ns[k]) for k in ids})
    aligned = ate(estimated, truth) if truth is not None else None
    if settings.poses == "true":
        if truth is None or aligned is None:
            raise SourceError(f"{sequence.name} has no true poses that fit the estimated ones")
        keyframes = _at_true_poses(keyframes, sequence, truth, aligned.scale)
    elif settings.sequence is None:
        if aligned is None:
            raise SourceError(f"too few frames of {sequence.name} have poses to tell their scale")
        metres = aligned.scale
    exact = None
    if settings.sequence is None:
        scene = SCENES[settings.scene](settings.scene_seed, settings.pace)
        exact = {}
        for k in keyframes:
            t_s = float(sequence.times_ns[k]) * 1e-9
            surfaces, T_world_cam = scene.surfaces(t_s), scene.T_world_cam(t_s)
            seen = exact_depth(surfaces, scene.camera, T_world_cam)
            exact[k] = TrueView(T_world_cam, scene.camera, seen, surfaces)
    return _Scene(sequence, keyframes, metres, exact)


def _at_true_poses(
    keyframes: Mapping[int, DepthKeyframe], sequence: RecordedSequence, truth: Trajectory, scale: float
) -> dict[int, DepthKeyframe]:
    ids = sorted(keyframes)
    found, true = match_times(np.array([sequence.times_ns[k] for k in ids]) * 1e-9, truth.t_s)
    return {
        ids[i]: keyframes[ids[i]].with_poses_of(truth.T_world_cam[j], scale)
        for i, j in zip(found.tolist(), true.tolist(), strict=True)
    }


@dataclass(frozen=True)
class _Depths:
    """What some images told.

    Attributes:
        inverse: Confirmed inverse depth by keyframe, ``(H, W)`` each.
        cloud: What of it becomes points, ``(N, 3)`` in each keyframe's camera frame.
    """

    inverse: dict[int, DepthImage]
    cloud: dict[int, NDArray[np.float32]]

    @classmethod
    def of(cls, scene: _Scene, views: Mapping[int, View]) -> "_Depths":
        """Estimate them from views of a scene's keyframes."""
        confirmed = confirmed_depths(scene.keyframes, views)
        inverse = {k: found.inverse_depth for k, found in confirmed.items()}
        return cls(inverse, cloud_points(confirmed, scene.keyframes, views))


class _Reference:
    """Depth that others are measured against."""

    def __init__(self, scene: _Scene, views: Mapping[int, View], clean: Mapping[int, DepthImage]) -> None:
        self._metres = scene.metres
        self._clean = clean
        self._truth = scene.truth
        self._limits = {k: (1 / f.sought.farthest, 1 / f.sought.nearest) for k, f in scene.keyframes.items()}
        self.is_exact = scene.truth is not None
        if scene.truth is not None:
            self._depth = {k: _at_centres(scene.truth[k].depth, views[k].shape_hw) for k in views}
        else:
            self._depth = {k: 1.0 / inverse for k, inverse in clean.items()}

    def cloud(self, clouds: Sequence[Mapping[int, NDArray[np.float32]]]) -> CloudError | None:
        """Return figures of clouds in units of the poses; None where the truth is not known."""
        if self._truth is None:
            return None
        in_metres = ({k: self._metres * points for k, points in cloud.items()} for cloud in clouds)
        return cloud_error(in_metres, self._truth)

    def errors(self, found: Mapping[int, DepthImage]) -> tuple[NDArray[np.float64], int]:
        """Return relative errors of all pixels with both depths, and how many have a reference.

        An error is infinite where a drawn scene has nothing; where the reference is not known it is left out.
        """
        errors, num_pixels = [], 0
        for k, truth in self._depth.items():
            num_pixels += int(np.isfinite(truth).sum())
            if k in found:
                known = np.isfinite(found[k]) & ~np.isnan(truth)
                with np.errstate(invalid="ignore"):
                    ratio = self._metres / (found[k][known].astype(np.float64) * truth[known])
                errors.append(np.where(np.isinf(truth[known]), np.inf, np.abs(ratio - 1.0)))
        return np.concatenate([np.zeros(0), *errors]), num_pixels

    def pictures(self, k: int, view: View) -> dict[str, NDArray[np.uint8]]:
        """Return a keyframe's original, its exact depth where known, and its depth from originals."""
        found = {"original": view.rgb}
        if self.is_exact:
            found["exact depth"] = self.coloured(k, self._metres / self._depth[k])
        return {**found, "from originals": self.coloured(k, self._clean.get(k), view.shape_hw)}

    def coloured(
        self, k: int, inverse_depth: NDArray[Any] | None, shape_hw: tuple[int, int] = (1, 1)
    ) -> NDArray[np.uint8]:
        """Return ``(H, W, 3)`` colours from blue for far to red for near, black where it is not known."""
        if inverse_depth is None:
            return np.zeros((*shape_hw, 3), np.uint8)
        low, high = self._limits[k]
        share = np.nan_to_num((inverse_depth - low) / (high - low))
        levels = np.clip(255.0 * share, 0, 255).astype(np.uint8)
        colours = cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
        colours[~(inverse_depth > 0.0)] = 0
        return np.asarray(colours, np.uint8)


def _at_centres(depth: NDArray[np.float32], shape_hw: tuple[int, int]) -> NDArray[np.float32]:
    """Return the depth at the centres of the pixels of a smaller image."""
    rows, columns = (
        np.clip(np.rint((np.arange(n) + 0.5) * full / n - 0.5), 0, full - 1).astype(int)
        for n, full in zip(shape_hw, depth.shape, strict=True)
    )
    return depth[np.ix_(rows, columns)]


def _measured(
    settings: DepthSettings,
    scene: _Scene,
    against: _Reference,
    name: str,
    codec: Codec,
    snr_db: float,
    shown: int,
) -> tuple[list[dict[str, Any]], NDArray[np.uint8]]:
    """Return a row for each use of confidence, and a keyframe's depth with the first of them."""
    camera, ids = scene.sequence.intrinsics, sorted(scene.keyframes)
    told: dict[str, list[_Depths]] = {use: [] for use in settings.confidence}
    psnrs_db: list[float | None] = []
    picture, num_lost = None, 0
    for seed in range(settings.seed, settings.seed + settings.seeds):
        link = Link(replace(settings.link, snr_db=snr_db), seed)
        arrived = {}
        for frame in run_frames(scene.sequence, ids, codec, link):
            if frame.decoded is None:
                num_lost += 1
                continue
            arrived[frame.frame_id] = frame.decoded
            psnrs_db.append(psnr_db(frame.original, frame.decoded.image))
        for use in settings.confidence:
            views = {
                k: view_of(k, d.image, d.confidence if use == "on" else None, camera)
                for k, d in arrived.items()
            }
            told[use].append(_Depths.of(scene, views))
            if picture is None:
                size_hw = view_of(shown, scene.sequence.image(shown), None, camera).shape_hw
                picture = against.coloured(shown, told[use][-1].inverse.get(shown), size_hw)
    lost = num_lost / (len(ids) * settings.seeds)
    assert picture is not None, "there is a seed and a use of confidence"
    stated_db = stated_snr_db(snr_db, settings.link)
    rows = [_row(name, stated_db, use, against, found, psnrs_db, lost) for use, found in told.items()]
    return rows, picture


def _row(
    codec: str,
    snr_db: float | None,
    confidence: str,
    against: _Reference,
    told: Sequence[_Depths],
    psnrs_db: list[float | None],
    lost: float,
) -> dict[str, Any]:
    errors = [against.errors(depths.inverse) for depths in told]
    every = np.concatenate([found for found, _ in errors])
    num_pixels = sum(num for _, num in errors)
    in_scene = np.isfinite(every)
    return {
        "codec": codec,
        "snr_db": snr_db,
        "confidence": confidence,
        "coverage": float(in_scene.sum() / num_pixels) if num_pixels else None,
        "median_error": float(np.median(every[in_scene])) if in_scene.any() else None,
        "outlier_share": float(np.mean(every > _OUTLIER)) if len(every) else None,
        "psnr_db": finite_mean(psnrs_db),
        "lost": lost,
        "cloud": against.cloud([depths.cloud for depths in told]),
    }
