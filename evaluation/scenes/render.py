"""Write a drawn scene as a recorded sequence with its exact path."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError
from semcast.common.lens import DistortionModel, check_distortion
from semcast.common.new_folder import new_folder
from semcast.common.trajectory import Trajectory, write_tum
from semcast.common.whole_file import write_whole
from semcast.evaluation.scenes.block import Block
from semcast.evaluation.scenes.corridor import Corridor
from semcast.evaluation.scenes.flat import Flat
from semcast.evaluation.scenes.lorry import Lorry
from semcast.evaluation.scenes.motion import Pace
from semcast.evaluation.scenes.office import Office
from semcast.evaluation.scenes.optics import Optics
from semcast.evaluation.scenes.orbit import Orbit
from semcast.evaluation.scenes.room import Room
from semcast.evaluation.scenes.street import Street
from semcast.evaluation.scenes.surfaces import Surface, draw
from semcast.evaluation.scenes.survey import Survey

Array = NDArray[np.float64]

#: Samples of a pixel, in place and over the exposure: they soften edges and blur what moves.
_SAMPLES = ((-0.25, -0.25), (0.25, 0.25), (-0.25, 0.25), (0.25, -0.25))
#: Rows of a rolling shutter that are drawn together: so many bands an image.
_NUM_BANDS = 24


class Scene(Protocol):
    """Something to see and a camera that moves in it; metres, z up."""

    camera: Intrinsics
    rate_hz: float
    exposure_s: float

    def surfaces(self, t_s: float) -> list[Surface]:
        """Return what there is to see at a time."""

    def T_world_cam(self, t_s: float) -> Array:
        """Return the ``(4, 4)`` pose of the camera at a time."""

    def background(self) -> NDArray[np.float32]:
        """Return ``(H, W, 3)`` grey levels of what is seen where no surface is."""


SceneName = Literal["room", "flat", "street", "block", "lorry", "orbit", "survey", "corridor", "office"]
SCENES: dict[SceneName, type[Room] | type[Orbit] | type[Street] | type[Survey] | type[Corridor]] = {
    "room": Room,
    "flat": Flat,
    "street": Street,
    "block": Block,
    "lorry": Lorry,
    "orbit": Orbit,
    "survey": Survey,
    "corridor": Corridor,
    "office": Office,
}


def frame_of(
    scene: Scene,
    t_s: float,
    noise_sd: float,
    rng: np.random.Generator,
    readout_s: float = 0.0,
    brightness: float = 1.0,
) -> NDArray[np.uint8]:
    """Return the ``(H, W, 3)`` RGB picture of a scene, with blur of motion and noise of the sensor.

    Args:
        scene: What to see.
        t_s: Middle of the exposure of the middle row.
        noise_sd: In grey levels.
        rng: Of the noise.
        readout_s: Time a rolling shutter takes from the top to the bottom, 0 for a global one.
        brightness: Factor on the grey levels, before the noise.
    """
    height = scene.camera.height
    optics = Optics.of(scene.camera)
    edges = np.linspace(0, height, 2 if readout_s == 0 else _NUM_BANDS + 1, dtype=int)
    total = np.zeros((height, scene.camera.width, 3), np.float32)
    around = (optics.margin, optics.margin)
    background = np.pad(scene.background(), (around, around, (0, 0)), mode="edge")
    for top, bottom in pairwise(edges.tolist()):
        first, end = optics.rows(top, bottom)
        late_s = readout_s * (0.5 * (top + bottom) / height - 0.5)
        for index, (dx, dy) in enumerate(_SAMPLES):
            moment_s = t_s + late_s + scene.exposure_s * ((index + 0.5) / len(_SAMPLES) - 0.5)
            band = replace(
                optics.pinhole,
                cx=optics.pinhole.cx - dx,
                cy=optics.pinhole.cy - dy - first,
                height=end - first,
            )
            T_world_cam = scene.T_world_cam(moment_s)
            drawn = draw(scene.surfaces(moment_s), band, T_world_cam, background[first:end])
            total[top:bottom] += optics.bend(drawn, top, bottom)
    noisy = total * (brightness / len(_SAMPLES)) + rng.normal(0, noise_sd, total.shape[:2])[..., None]
    return np.asarray(np.clip(np.rint(noisy), 0, 255), np.uint8)


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """Settings of ``render_scene``.

    Raises:
        ValueError: A value is out of range.
    """

    scene: SceneName = field(
        default="room",
        metadata={
            "help": "room: handheld, 30 Hz; flat: a room with bare walls, handheld, 15 Hz; street: from a "
            "car, 10 Hz; block: the same round a block of houses and on; lorry: the street behind a lorry; "
            "orbit: round a still life, 10 Hz; survey: fields from a drone that looks down, 10 Hz; corridor: "
            "bare walls from a small robot, 15 Hz; office: desks, shelves and bare corners, handheld, 15 Hz"
        },
    )
    pace: Pace = field(default="normal", metadata={"help": "how fast the camera moves and shakes"})
    seed: int = field(default=0, metadata={"help": "seed of the scene, the path and the noise"})
    seconds: float = field(default=10.0, metadata={"help": "length of the recording, at most 120"})
    noise_sd: float = field(default=1.5, metadata={"help": "noise of the sensor in grey levels of 255"})
    brightness: float = field(
        default=1.0, metadata={"help": "factor on all grey levels, at most 1: less light and the same noise"}
    )
    readout_ms: float = field(
        default=0.0,
        metadata={"help": "time a rolling shutter takes from the top row to the bottom, 0 for none"},
    )
    distortion: tuple[float, ...] = field(
        default=(),
        metadata={"help": "of the lens: OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]], or k1 k2 k3 k4 of a fisheye"},
    )
    distortion_model: DistortionModel = field(
        default="radtan", metadata={"help": "what the coefficients are of; equidistant is a fisheye"}
    )
    out: Path = field(metadata={"help": "folder to write; it must not exist or be empty"})

    def __post_init__(self) -> None:
        """Check ranges."""
        if self.seed < 0:
            raise ValueError(f"seed must be at least 0, got {self.seed}")
        if not 0 < self.seconds <= 120:
            raise ValueError(f"seconds must be in (0, 120], got {self.seconds:g}")
        if not 0 <= self.noise_sd <= 50:
            raise ValueError(f"noise_sd must be in [0, 50], got {self.noise_sd:g}")
        if not 0 < self.brightness <= 1:
            raise ValueError(f"brightness must be in (0, 1], got {self.brightness:g}")
        most_ms = 1e3 / SCENES[self.scene].rate_hz  # the next frame begins
        if not 0 <= self.readout_ms <= most_ms:
            raise ValueError(
                f"readout_ms must be in [0, {most_ms:.3g}] for scene {self.scene!r}, got {self.readout_ms:g}"
            )
        check_distortion(self.distortion_model, self.distortion)


def render_scene(settings: RenderSettings, progress: Callable[[int, int], None] | None = None) -> int:
    """Write a scene as a sequence of the native layout: images, times, intrinsics and the exact path.

    The same settings give the same files.

    Args:
        settings: What to draw.
        progress: Takes how many frames are drawn, and of how many.

    Returns:
        Number of frames.

    Raises:
        SourceError: The folder has files in it or can't be written, no lens has such a distortion, or a road
            ends before the recording does.
    """
    scene_type = SCENES[settings.scene]
    with new_folder(settings.out) as folder:  # this and the lens are refused before the scene is painted
        camera = replace(
            scene_type.camera,
            readout_ms=settings.readout_ms,
            distortion=settings.distortion,
            distortion_model=settings.distortion_model,
        )
        Optics.of(camera)
        scene = scene_type(settings.seed, settings.pace)
        scene.camera = camera
        if isinstance(scene, Street) and settings.seconds > scene.lasts_s:
            raise SourceError(
                f"seconds must be at most {int(scene.lasts_s)} on this road, which ends then, "
                f"got {settings.seconds:g}"
            )
        (folder / "images").mkdir()
        return _draw_into(folder, settings, scene, progress or (lambda _done, _total: None))


def _draw_into(
    folder: Path, settings: RenderSettings, scene: Scene, progress: Callable[[int, int], None]
) -> int:
    times_s = np.arange(max(1, round(settings.seconds * scene.rate_hz))) / scene.rate_hz
    T_world_cams = np.stack([scene.T_world_cam(float(t_s)) for t_s in times_s])
    for index, t_s in enumerate(times_s):
        rng = np.random.default_rng([settings.seed, index, 4])
        readout_s = 1e-3 * settings.readout_ms
        image = frame_of(scene, float(t_s), settings.noise_sd, rng, readout_s, settings.brightness)
        _, png = cv2.imencode(".png", image[..., ::-1])
        write_whole(folder / "images" / f"{index:06d}.png", png.tobytes())
        progress(index + 1, len(times_s))
    write_whole(folder / "times.txt", "".join(f"{t_s:.6f}\n" for t_s in times_s))
    scene.camera.save(folder / "intrinsics.json")
    write_tum(folder / "groundtruth.txt", Trajectory(times_s, T_world_cams))
    return len(times_s)
