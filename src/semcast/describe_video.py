"""What a video or a calibration file is, for ``semcast info``."""

import json
import shlex
from pathlib import Path

import cv2

from semcast.agent.video import calibration_beside, open_capture
from semcast.common.camera import Intrinsics
from semcast.common.camera_file import read_intrinsics
from semcast.common.camera_settings import HOW_TO_GIVE, check_size
from semcast.common.errors import SourceError

Facts = list[tuple[str, str]]


def video_facts(path: Path) -> Facts | None:
    """Return what a video holds; None where the file is none that OpenCV can read.

    Its images are read upright, as the file says; they are counted as the file counts them.
    """
    try:
        capture = open_capture(str(path), live=False)
    except SourceError:
        return None
    good, image = capture.read()
    rate_hz, count = capture.get(cv2.CAP_PROP_FPS), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    turned_deg = int(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360
    capture.release()
    if not good or image is None:
        return None
    height, width = image.shape[:2]
    turned = f", turned by {turned_deg} degrees as the file says" if turned_deg else ""
    facts = [("images", f"{count if count > 0 else 'unknown how many'}, {width}x{height} px{turned}")]
    if rate_hz > 0.0 and count > 0:
        facts.append(("time", f"{count / rate_hz:.1f} s, {rate_hz:.1f} images a second"))
    beside = calibration_beside(path)
    command = f"semcast demo --sequence {shlex.quote(str(path))}"
    if beside is None:
        facts.append(("camera", f"unknown: {HOW_TO_GIVE}"))
        command += " --focal-35mm 26"
    else:
        try:
            camera = Intrinsics.load(beside)
            check_size(camera, width, height, path.name)
            facts += [*camera_facts(camera, camera), ("", f"as {beside} says")]
        except SourceError as err:
            facts.append(("camera", str(err)))
    facts.append(("is reconstructed by", command))
    return facts


def is_calibration(path: Path) -> bool:
    """Tell whether a file is meant for intrinsics: any YAML, and JSON with a focal length and no frames."""
    if path.suffix.lower() != ".json":
        return path.suffix.lower() in (".yaml", ".yml")
    try:
        values = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError):
        return False
    return isinstance(values, dict) and "fx" in values and "frames" not in values


def calibration_facts(path: Path) -> Facts:
    """Return what a calibration file says.

    Raises:
        SourceError: It can't be read, or misses a value.
    """
    camera = read_intrinsics(path)
    return [("images", f"{camera.width}x{camera.height} px"), *camera_facts(camera, camera)]


def camera_facts(camera: Intrinsics, stored: Intrinsics) -> Facts:
    """Return a camera's numbers in words.

    Args:
        camera: Its pinhole and shutter.
        stored: Camera of its images as stored, with their distortion.
    """
    coefficients = " ".join(f"{k:.4g}" for k in stored.distortion)
    what = "distortion" if stored.distortion_model == "radtan" else f"{stored.distortion_model} distortion"
    bent = f", with {what} {coefficients}" if coefficients else ""
    centre = f"cx {camera.cx:.1f} cy {camera.cy:.1f} px"
    facts = [("camera", f"fx {camera.fx:.1f} fy {camera.fy:.1f} {centre}{bent}")]
    if camera.readout_ms:
        facts.append(("shutter", f"rolling, {camera.readout_ms:g} ms from {camera.readout_from}"))
    return facts
