"""Metres and upright from a printed square marker (ArUco, AprilTag) in the pictures of a run.

Garrido-Jurado et al., Automatic generation and detection of highly reliable fiducial markers under occlusion,
2014; Olson, AprilTag: a robust and flexible visual fiducial system, 2011. Found by OpenCV.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import ConfigError, SourceError
from semcast.common.geometry import align_umeyama, exp_so3, invert_transform
from semcast.common.run_folder import RunData
from semcast.server.export.placement import Placement
from semcast.server.geometry.triangulation import triangulate

Array = NDArray[np.float64]

#: Few false alarms; the family robots know best.
DEFAULT_DICTIONARY = "apriltag_36h11"
#: Two images and their marker can agree by accident.
MIN_IMAGES = 3
#: An image whose corners are further off than this, and than thrice what is usual, has seen something else.
_OUTLIER_PX = 3.0
#: Corners are not known better than this, however well a few of them fit.
_LEAST_SIGMA_PX = 0.2
#: A scale less certain than this (95 %) is none.
MAX_UNCERTAINTY = 0.1
#: Where its refinement of corners has the middle of the first pixel; ours is at 0.
_APRILTAG_PIXEL_CENTRE = 0.5
#: What a corner behind the camera is off by.
_BEHIND_PX = 1e4
_ITERATIONS = 20
#: Of a marker in the map, whose logarithm is fitted.
_LEAST_SCALE = 1e-9


@dataclass(frozen=True)
class MarkerViews:
    """Where one marker was seen.

    Attributes:
        T_world_cam: ``(N, 4, 4)`` poses of the images it was found in, map units.
        corners_xy: ``(N, 4, 2)`` pixels: the top left corner of the marker as printed, then clockwise.
    """

    T_world_cam: Array
    corners_xy: Array

    def __len__(self) -> int:
        return len(self.corners_xy)

    def only(self, kept: NDArray[np.bool_]) -> "MarkerViews":
        """Return some of the views."""
        return MarkerViews(self.T_world_cam[kept], self.corners_xy[kept])


def place_by_marker(
    data: RunData,
    images: Mapping[int, Path],
    side_m: float,
    dictionary: str,
    marker_id: int | None = None,
) -> Placement:
    """Return the similarity from the map to the frame of a marker, in metres.

    The frame's origin is the marker's centre, x points right and y up on the marker as printed, z out of it:
    with a marker on the floor z is up.

    Args:
        data: The run, of one part.
        images: Frame id to file of the kept images.
        side_m: Side of the marker's black square.
        dictionary: OpenCV's name of its family, such as ``apriltag_36h11`` or ``4x4_50``.
        marker_id: Its number; None for the one found in most images.

    Raises:
        ConfigError: ``side_m`` or ``dictionary`` is not allowed.
        SourceError: No marker was found in enough images, or from too few directions to tell the scale.
    """
    if not (np.isfinite(side_m) and side_m > 0):
        raise ConfigError(f"side of the marker must be above 0 m, got {side_m}")
    row_of = {frame_id: k for k, frame_id in enumerate(data.frame_ids.tolist())}
    posed = {frame_id: path for frame_id, path in images.items() if frame_id in row_of}
    if not posed:
        raise SourceError(
            "the run kept no images, and a marker is looked for in them; run again with --save-images"
        )
    detector = _detector(dictionary)
    rows, corners = defaultdict(list), defaultdict(list)
    for frame_id, path in posed.items():
        for found, xy in _find_markers(path, data.intrinsics, detector).items():
            rows[found].append(row_of[frame_id])
            corners[found].append(xy)
    number = max(rows, key=lambda k: (len(rows[k]), -k), default=None) if marker_id is None else marker_id
    if number is None or number not in rows:
        others = f"; found: {', '.join(map(str, sorted(rows)))}" if rows else ""
        raise SourceError(
            f"marker {'of any number' if number is None else number} of {dictionary} must be in "
            f"{MIN_IMAGES} images or more, got none of {len(posed)}{others}"
        )
    views = MarkerViews(data.T_world_cam[rows[number]], np.array(corners[number]))
    return _fit(views, data.intrinsics, side_m, f"marker {number}")


def dictionaries() -> dict[str, int]:
    """Return names of marker families, as OpenCV has them in lower case, to its numbers for them."""
    names = sorted(name for name in vars(cv2.aruco) if name.startswith("DICT_"))
    return {name.removeprefix("DICT_").lower(): getattr(cv2.aruco, name) for name in names}


def _detector(dictionary: str) -> cv2.aruco.ArucoDetector:
    """Return what finds markers of a family.

    Raises:
        ConfigError: There is no such dictionary.
    """
    known = dictionaries()
    if dictionary not in known:
        raise ConfigError(f"dictionary must be one of {', '.join(known)}, got {dictionary!r}")
    parameters = cv2.aruco.DetectorParameters()
    # Lines along the sides: of soft pictures the other ways make markers too small.
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(known[dictionary]), parameters)


def _find_markers(path: Path, camera: Intrinsics, detector: cv2.aruco.ArucoDetector) -> dict[int, Array]:
    """Return marker number to corners ``(4, 2)`` in pixels; a number that is there twice is left out.

    Raises:
        SourceError: The image can't be read, or is not the camera's.
    """
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if grey is None or grey.shape != camera.shape_hw:
        raise SourceError(f"{path} must be an image of {camera.width}x{camera.height}")
    corners, numbers, _ = detector.detectMarkers(grey)
    flat = [] if numbers is None else [int(number) for number in np.ravel(numbers)]
    return {
        number: np.asarray(xy, dtype=np.float64).reshape(4, 2) - _APRILTAG_PIXEL_CENTRE
        for number, xy in zip(flat, corners, strict=True)
        if flat.count(number) == 1
    }


def _fit(views: MarkerViews, camera: Intrinsics, side_m: float, name: str) -> Placement:
    """Fit position, rotation and size of the marker in the map to its corners in all images."""
    num_found = len(views)
    fit = None
    while len(views) >= MIN_IMAGES:
        fit = _least_squares(views, camera, side_m)
        error_px = _view_errors_px(fit.residuals)
        far = error_px > max(_OUTLIER_PX, 3.0 * float(np.median(error_px)))
        if not far.any():
            break
        # One at a time: a view that is wrong makes others look so.
        views = views.only(np.arange(len(views)) != int(error_px.argmax()))
    if fit is None or len(views) < MIN_IMAGES:
        raise SourceError(
            f"{name} must be seen alike in {MIN_IMAGES} images or more, got {len(views)} of {num_found}"
        )
    rms_px = float(np.sqrt((fit.residuals**2).mean()))
    uncertainty = 1.96 * fit.sigma_log_scale * max(rms_px, _LEAST_SIGMA_PX)
    if not uncertainty <= MAX_UNCERTAINTY:
        by = f" by {100 * uncertainty:.0f} %" if np.isfinite(uncertainty) else ""
        raise SourceError(
            f"{name} must be seen from several places to tell the scale; its {len(views)} images leave it "
            f"open{by}"
        )
    scale = 1.0 / fit.scale
    words = (
        f"{name}: {len(views)} images, {rms_px:.2f} px; 1 unit of the map is {scale:.4g} m, "
        f"within {100 * uncertainty:.2g} % (95 %)"
    )
    frame = f"x right, y up, z out of {name}; metres"
    return Placement(scale, fit.R.T, -scale * fit.R.T @ fit.t, frame, words)


@dataclass(frozen=True)
class _Fit:
    """A marker in the map: ``p_map = scale * R @ p_marker + t``.

    Attributes:
        residuals: ``(N, 4, 2)`` pixels.
        sigma_log_scale: Standard deviation of log ``scale`` for corners known to one pixel; infinite where
            they leave it open.
    """

    scale: float
    R: Array
    t: Array
    residuals: Array
    sigma_log_scale: float


def _view_errors_px(residuals: Array) -> Array:
    return np.asarray(np.sqrt((residuals**2).sum(axis=2).mean(axis=1)))


def _least_squares(views: MarkerViews, camera: Intrinsics, side_m: float) -> _Fit:
    """Minimise the reprojection error over seven parameters (Levenberg-Marquardt)."""
    square = 0.5 * side_m * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    T_cam_world = invert_transform(views.T_world_cam)
    view, corner = (k.ravel() for k in np.indices((len(views), 4)))
    seen_xy = views.corners_xy.reshape(-1, 2)
    corners_map = triangulate(camera, T_cam_world, view, corner, seen_xy, np.ones(len(seen_xy)), 4).xyz
    start = align_umeyama(square, corners_map)
    # Rays of cameras in one place meet there.
    start = (max(start[0], _LEAST_SCALE), *start[1:])

    def residuals(log_scale: float, R: Array, t: Array) -> Array:
        corners = np.exp(log_scale) * square @ R.T + t
        in_cameras = np.einsum("nij,kj->nki", T_cam_world[:, :3, :3], corners) + T_cam_world[:, None, :3, 3]
        error = camera.project(in_cameras.reshape(-1, 3)).reshape(-1, 4, 2) - views.corners_xy
        return np.nan_to_num(error, nan=_BEHIND_PX)  # an image that has it behind it is an outlier

    def moved(x: tuple[float, Array, Array], step: Array) -> tuple[float, Array, Array]:
        # Positions in sides of the marker, so that all seven are of one size.
        return x[0] + float(step[0]), exp_so3(step[1:4]) @ x[1], x[2] + start[0] * side_m * step[4:]

    x = (float(np.log(start[0])), start[1], start[2])
    damping = 1e-3
    r = residuals(*x)
    J = np.zeros((r.size, 7))
    for _ in range(_ITERATIONS):
        nudges = 1e-6 * np.eye(7)
        J = np.stack([(residuals(*moved(x, d)) - residuals(*moved(x, -d))).ravel() / 2e-6 for d in nudges], 1)
        JtJ = J.T @ J
        damped = JtJ + damping * np.diag(np.diag(JtJ))
        step = np.asarray(-np.linalg.lstsq(damped, J.T @ r.ravel(), rcond=None)[0], dtype=np.float64)
        there = moved(x, step)
        r_there = residuals(*there)
        if (r_there**2).sum() < (r**2).sum():
            x, r, damping = there, r_there, 0.1 * damping
            if np.abs(step).max() < 1e-9:
                break
        else:
            damping *= 10.0
    JtJ = J.T @ J
    sigma = float(np.sqrt(np.linalg.inv(JtJ)[0, 0])) if np.linalg.matrix_rank(JtJ) == len(JtJ) else np.inf
    return _Fit(float(np.exp(x[0])), x[1], x[2], r, sigma)
