"""``semcast shutter``: how long a rolling shutter takes, from images of the camera alone."""

import argparse
import sys

from semcast.commands.camera_out import add_images, images_of, quiet_reconstruction, write_camera
from semcast.evaluation.readout import ReadoutEstimate, Trial, find_readout, readout_report
from semcast.evaluation.report import write_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_images(parser, "the readout found")


def _show(trial: Trial) -> None:
    error = f", reprojection error {trial.evidence.mean_px:.3f} px" if trial.evidence.num_frames else ""
    what = f"{trial.readout!s:>20}: {trial.evidence.num_frames} frames with a pose{error}"
    print(what, file=sys.stderr, flush=True)


def _answer(found: ReadoutEstimate) -> str:
    """Return the result in words."""
    low_ms, high_ms = sorted((found.low_ms, found.high_ms), key=abs)
    if found.is_global:
        return f"global shutter, or as good as one ({found.low_ms:.1f} to {found.high_ms:.1f} ms)"
    return (
        f"rolling shutter: {found.readout} ({abs(low_ms):.1f} to {abs(high_ms):.1f})\n"
        f"--readout-ms {found.camera.readout_ms:g} --readout-from {found.camera.readout_from}"
    )


def run(arguments: argparse.Namespace) -> int:
    """Reconstruct with one readout time after another, a line on stderr each; print the one that fits."""
    settings = images_of(arguments)
    with quiet_reconstruction(arguments.debug):
        found = find_readout(settings, _show)
    print(_answer(found), flush=True)  # whatever can be written, the search is not lost
    write_camera(found.camera, arguments.out)
    write_result(settings.json, readout_report(settings, found))
    return 0
