"""The trajectory benchmark on drawn scenes: needs no recording, and nothing was tuned on it.

Run by ``make bench-scenes``. Some hours of one core with the default three seeds.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from semcast.channel.settings import ChannelSettings
from semcast.evaluation.report import RESULTS, check_outputs
from semcast.evaluation.scenes.motion import Pace
from semcast.evaluation.scenes.render import RenderSettings, SceneName, render_scene
from semcast.evaluation.trajectory import TrajectorySettings, evaluate_trajectory

SCENES_FOLDER = Path("runs/scenes")
#: Seeds of the scenes; those below 100 were looked at while the renderer was written.
_SEEDS = {
    "room": 100,
    "street": 101,
    "orbit": 102,
    "block": 103,
    "room_night": 104,
    "street_night": 105,
    "survey": 106,
    "corridor": 107,
    "flat": 108,
    "office": 110,
}
#: Other drawings of the same scenes, of which none was looked at before all were measured. Over the poor link
#: alone: what confidence is worth there takes many recordings to tell.
_SEEDS_AGAIN: dict[SceneName, int] = {
    "room": 3100,
    "flat": 3108,
    "street": 3101,
    "orbit": 3102,
    "survey": 3106,
    "corridor": 3107,
    "office": 3110,
}
#: Scenes whose fast pace is mostly blank walls, or was never measured.
_NORMAL_ONLY_AGAIN = ("flat", "office")
_LINK_DB = 6.0
#: The longest scene and the nights are measured behind that link alone, all others behind a worse one too.
_POOR_LINK_DB = 2.0
_PACES: tuple[Pace, ...] = ("normal", "fast")
#: Most recordings have 100 to 300 frames; round the block, a lap and a bit. Behind a lorry, where cameras get
#: lost, is measured apart: evaluation/results/lorry_*.json name the commands.
SCENE_SECONDS: dict[SceneName, tuple[float, float]] = {
    "room": (10.0, 10.0),
    "flat": (12.0, 12.0),
    "street": (20.0, 20.0),
    "orbit": (10.0, 10.0),
    "block": (44.0, 30.0),
    "survey": (20.0, 14.0),
    "corridor": (20.0, 12.0),
    "office": (20.0, 12.0),
}
#: Scenes that are drawn at night as well: a fifth of the light, twice the noise.
NIGHTS: tuple[SceneName, ...] = ("room", "street")
_NIGHT_BRIGHTNESS, _NIGHT_NOISE_SD = 0.2, 3.0


@dataclass(frozen=True)
class Run:
    """A recording to draw and what to measure on it."""

    render: RenderSettings
    settings: TrajectorySettings


def suite(folder: Path, results: Path, seeds: int) -> Iterator[Run]:
    """Yield scenes at normal and fast pace, some at night, most drawn again, behind a Rayleigh fading link.

    Args:
        folder: Where the recordings are written.
        results: Folder of the result files.
        seeds: Seeds of channel and estimation.
    """
    for scene, seconds in SCENE_SECONDS.items():
        for pace, length_s in zip(_PACES, seconds, strict=True):
            out = folder / f"{scene}_{pace}"
            render = RenderSettings(scene=scene, pace=pace, seed=_SEEDS[scene], seconds=length_s, out=out)
            links_db = (_LINK_DB,) if scene == "block" else (_POOR_LINK_DB, _LINK_DB)
            yield from _runs(render, links_db, results, seeds)
    for scene in NIGHTS:
        render = RenderSettings(
            scene=scene,
            seed=_SEEDS[f"{scene}_night"],
            seconds=SCENE_SECONDS[scene][0],
            brightness=_NIGHT_BRIGHTNESS,
            noise_sd=_NIGHT_NOISE_SD,
            out=folder / f"{scene}_night",
        )
        yield from _runs(render, (_LINK_DB,), results, seeds)
    for scene, seed in _SEEDS_AGAIN.items():
        for pace, length_s in zip(_PACES, SCENE_SECONDS[scene], strict=True):
            if pace == "normal" or scene not in _NORMAL_ONLY_AGAIN:
                out = folder / f"{scene}_again_{pace}"
                render = RenderSettings(scene=scene, pace=pace, seed=seed, seconds=length_s, out=out)
                yield from _runs(render, (_POOR_LINK_DB,), results, seeds)


def _runs(render: RenderSettings, links_db: tuple[float, ...], results: Path, seeds: int) -> Iterator[Run]:
    """Yield the run with confidence and without, and over the poor link what tells of confidence itself."""
    settings = TrajectorySettings(
        sequence=render.out,
        link=ChannelSettings(channel="rayleigh"),
        snr_db=links_db,
        seeds=seeds,
        threads=1,
        confidence=("robust", "off"),
        rows=False,
        json=results / f"trajectory_rayleigh_{render.out.name}.json",
    )
    yield Run(render, settings)
    if _POOR_LINK_DB in links_db:
        json = results / f"trajectory_rayleigh_{render.out.name}_shuffled.json"
        yield Run(render, replace(settings, snr_db=(_POOR_LINK_DB,), confidence=("shuffled",), json=json))


def main() -> None:
    """Draw what is not there yet and run the benchmark, or the part whose names hold a word."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=SCENES_FOLDER, help="folder of the recordings")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the result files")
    parser.add_argument("--seeds", type=int, default=3, help="seeds of each run")
    parser.add_argument("--only", default="", help="run only what has this in its name")
    arguments = parser.parse_args()
    for run in suite(arguments.folder, arguments.results, arguments.seeds):
        if arguments.only in run.render.out.name:
            check_outputs(run.settings.json, run.settings.out)
            # The path is written last: with it the recording is whole.
            if not (run.render.out / "groundtruth.txt").exists():
                render_scene(run.render)
            evaluate_trajectory(run.settings)
            sys.stderr.write(f"{run.render.out.name}\n")


if __name__ == "__main__":
    main()
