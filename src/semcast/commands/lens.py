"""``semcast lens``: focal length, distortion and principal point, from images of the camera alone."""

import argparse
import sys

from semcast.commands.camera_out import add_images, images_of, quiet_reconstruction, write_camera
from semcast.evaluation.lens import LensEstimate, LensTrial, find_lens, lens_report
from semcast.evaluation.report import write_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_images(parser, "the lens found")


def _show(trial: LensTrial) -> None:
    changed = trial.lens.radial[: trial.lens.num_radial]
    bent = "".join(f", k{number} {change:+.4f}" for number, change in enumerate(changed, 1))
    if any(trial.lens.centre):
        x, y = trial.lens.centre
        bent += f", centre {x:+.4f} {y:+.4f}"
    num_frames, mean_px = trial.evidence.num_frames, trial.evidence.mean_px
    error = f", reprojection error {mean_px:.3f} px" if num_frames else ""
    what = f"focal length x {trial.lens.focal:.4f}{bent}: {num_frames} frames with a pose{error}"
    print(what, file=sys.stderr, flush=True)


def _answer(found: LensEstimate) -> str:
    """Return the result in words."""
    camera = found.camera
    low, high = (camera.fx * (1.0 + way * found.focal_reach) for way in (-1, 1))
    words = [f"focal length: {camera.fx:.1f} px ({low:.1f} to {high:.1f})"]
    flags = f"--fx {camera.fx:.2f} --fy {camera.fy:.2f} --cx {camera.cx:.2f} --cy {camera.cy:.2f}"
    if found.radial_reach:
        radial = zip(camera.distortion, found.radial_reach, strict=False)
        told = (f"k{number} {k:.4f} (+- {reach:.4f})" for number, (k, reach) in enumerate(radial, 1))
        words.append("radial distortion: " + ", ".join(told))
    if found.centre_reach_px:
        x, y = found.centre_reach_px
        words.append(f"principal point: {camera.cx:.1f} (+- {x:.1f}), {camera.cy:.1f} (+- {y:.1f}) px")
    if camera.distortion:
        flags += " --distortion " + " ".join(f"{value:.6g}" for value in camera.distortion)
    return "\n".join([*words, flags])


def run(arguments: argparse.Namespace) -> int:
    """Reconstruct with one lens after another, one line on stderr each; then print the one that fits."""
    settings = images_of(arguments)
    with quiet_reconstruction(arguments.debug):
        found = find_lens(settings, _show)
    print(_answer(found), flush=True)  # whatever can be written, the search is not lost
    write_camera(found.camera, arguments.out)
    write_result(settings.json, lens_report(settings, found))
    return 0
