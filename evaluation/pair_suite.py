"""The whole pair benchmark: every recording, channel and codec, one result file each.

Run by ``make bench-pairs DATA=<folder>``. About ten minutes of one core per seed.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

from semcast.channel.settings import ChannelName, ChannelSettings
from semcast.common.codec import DEFAULT_CODEC
from semcast.evaluation.pairs import PairSettings, evaluate_pairs
from semcast.evaluation.pipeline import CLEAN
from semcast.evaluation.report import RESULTS, check_outputs
from semcast.server.geometry.weighting import ConfidenceMode

_ALL_MODES: tuple[ConfidenceMode, ...] = get_args(ConfidenceMode)


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A recording of the benchmark.

    Attributes:
        path: Below the data folder.
        values: Settings of its pairs.
        thorough: True for the recordings with a curve over the SNR; the others have few SNRs.
        held_out: No constant of the estimator was chosen by it; those were tuned on parts of the others. The
            half lines of ``epipolar`` came from looking at what failed on all.
    """

    path: str
    values: dict[str, Any] = field(default_factory=dict)
    thorough: bool = False
    held_out: bool = False


RECORDINGS = {
    "kitti_06": Recording(
        path="sequences/kitti_06_first51", values={"stride": 2, "resize": 0.74}, thorough=True
    ),
    "chair": Recording(
        path="blender/chair/transforms_test.json", values={"stride": 3, "resize": 0.5}, thorough=True
    ),
    "shelf": Recording(
        path="sequences/shelf_50", values={"stride": 2, "gap": (1, 3), "min_baseline_m": 0.01}
    ),
    "parking": Recording(path="sequences/parking_synth_60", values={"stride": 2, "gap": (2,)}, held_out=True),
    "phone": Recording(
        path="sequences/phone_150",
        values={"stride": 6, "gap": (2,), "resize": 0.667, "max_frames": 25},
        held_out=True,
    ),
}
_SNRS_DB: dict[ChannelName, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "awgn": ((2.0, 4.0, 6.0, 8.0, 10.0, 12.0), (2.0, 6.0)),
    "rayleigh": ((2.0, 6.0, 10.0), (6.0,)),
    "erasure": ((2.0, 6.0, 10.0), (6.0,)),
}


@dataclass(frozen=True)
class Run:
    """One result file and the settings that make it."""

    name: str
    settings: PairSettings


def suite(data: Path, results: Path, seeds: int) -> Iterator[Run]:
    """Yield all runs of the benchmark.

    Args:
        data: Folder with ``sequences`` and ``blender``.
        results: Folder of the result files.
        seeds: Seeds of channel and estimation of each run.
    """
    for name, recording in RECORDINGS.items():
        for channel, (many, few) in _SNRS_DB.items():
            yield _run(data, results, seeds, name, channel, many if recording.thorough else few)
        # What images that nothing was done to give: the floor that noise of matches and references set.
        yield _run(data, results, seeds, name, "awgn", (10.0,), codec=CLEAN)
    # Below 8 dB this codec delivers nothing: no confidence can help.
    yield _run(data, results, seeds, "kitti_06", "awgn", (6.0, 8.0, 12.0), codec="jpeg-ldpc")
    yield _run(data, results, seeds, "chair", "awgn", (6.0, 8.0, 12.0), codec="jpeg-ldpc")


def _run(
    data: Path,
    results: Path,
    seeds: int,
    name: str,
    channel: ChannelName,
    snr_db: tuple[float, ...],
    codec: str = DEFAULT_CODEC,
) -> Run:
    recording = RECORDINGS[name]
    suffix = "" if codec == DEFAULT_CODEC else f"_{codec.replace('-', '_')}"
    file = f"pairs_{name}_clean" if codec == CLEAN else f"pairs_{name}_{channel}{suffix}"
    settings = PairSettings(
        sequence=data / recording.path,
        codec=codec,
        link=ChannelSettings(channel=channel),
        snr_db=snr_db,
        seeds=seeds,
        threads=1,
        features=("klt", "sift"),
        max_matches=(0, 40),
        confidence=_ALL_MODES,
        json=results / f"{file}.json",
        **recording.values,
    )
    return Run(file, settings)


def main() -> None:
    """Run the benchmark, or the part whose names hold a word."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path, help="folder with sequences/ and blender/")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the result files")
    parser.add_argument("--seeds", type=int, default=1, help="seeds of each run")
    parser.add_argument("--only", default="", help="run only what has this in its name")
    arguments = parser.parse_args()
    for run in suite(arguments.data, arguments.results, arguments.seeds):
        if arguments.only in run.name:
            check_outputs(run.settings.json, run.settings.out)
            evaluate_pairs(run.settings)
            sys.stderr.write(f"{run.name}\n")


if __name__ == "__main__":
    main()
