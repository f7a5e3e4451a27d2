"""Metres and upright from a printed square marker (ArUco, AprilTag) in the pictures of a run.

Garrido-Jurado et al., Automatic generation and detection of highly reliable fiducial markers under occlusion,
2014; Olson, AprilTag: a robust and flexible visual fiducial system, 2011. Found by OpenCV.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import ConfigError, SourceError
from semcast.common.geometry import align_umeyama, exp_so3, invert_transform
from semcast.common.image_file import read_image
from semcast.common.run_folder import RunData
from semcast.server.export.placement import TWO_SIDED_95, Placement
from semcast.server.geometry.grey import to_grey
from semcast.server.geometry.triangulation import triangulate

Array = NDArray[np.float64]

#: Two images and their marker can agree by accident.
MIN_IMAGES = 3
#: An image whose corners are further off than this, and than thrice what is usual, has seen something else.
_OUTLIER_PX = 3.0
#: Corners are not known better than this, however well a few of them fit.
_LEAST_SIGMA_PX = 0.2
#: By which the sides of a marker in soft pictures are further in or out.
_SOFT_EDGE_PX = 0.1
#: Of the marker's width, around it: what its lines and their surroundings are looked for in.
_MARGIN_SHARE = 0.3
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


@dataclass(frozen=True)
class MarkerPlacement(Placement):
    """A placement by a marker.

    Attributes:
        marker_id: The marker's number.
        side_m: Of its black square.
        num_images: That agree about it.
        relative_sigma: Standard deviation of ``scale`` as a share of it.
    """

    marker_id: int
    side_m: float
    num_images: int
    relative_sigma: float

    @property
    def corners_map(self) -> Array:
        """``(4, 3)`` corners of the marker in the map: top left as printed, then clockwise."""
        return np.asarray((_square(self.side_m) - self.t) @ self.R / self.scale)


class Sightings:
    """Where markers of a family are in the images of a run.

    Args:
        dictionary: OpenCV's name of the family, such as ``apriltag_36h11`` or ``4x4_50``.

    Attributes:
        of: Marker number -> frame id -> ``(4, 2)`` pixels.
        num_images: That were looked at.
        num_doubled: Marker number -> images that show it twice, where it is left out.

    Raises:
        ConfigError: There is no such family.
    """

    def __init__(self, dictionary: str) -> None:
        known = dictionaries()
        if dictionary not in known:
            raise ConfigError(f"dictionary must be one of {', '.join(known)}, got {dictionary!r}")
        self._dictionary = dictionary
        family = cv2.aruco.getPredefinedDictionary(known[dictionary])
        self._quick = cv2.aruco.ArucoDetector(family, cv2.aruco.DetectorParameters())
        parameters = cv2.aruco.DetectorParameters()
        # Lines along the sides: of soft pictures the other ways make markers too small.
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
        self._exact = cv2.aruco.ArucoDetector(family, parameters)
        self.of: dict[int, dict[int, Array]] = {}
        self.num_images = 0
        self.num_doubled: Counter[int] = Counter()

    def look(self, frame_id: int, grey: NDArray[np.uint8]) -> None:
        """Look for markers in an image ``(H, W)``.

        Lines are looked for where there is a marker: in a whole image they take several times as long.
        """
        self.num_images += 1
        corners, numbers, _ = self._quick.detectMarkers(grey)
        there = [] if numbers is None else [int(number) for number in np.ravel(numbers)]
        for number, quick in zip(there, corners, strict=True):
            if there.count(number) > 1:
                continue
            xy = self._refined(grey, number, quick[0])
            if xy is not None:
                self.of.setdefault(number, {})[frame_id] = xy
        self.num_doubled.update({number for number in there if there.count(number) > 1})

    def _refined(self, grey: NDArray[np.uint8], number: int, corners_xy: NDArray[np.float32]) -> Array | None:
        """Return the corners by the lines along the sides, None where these show no such marker."""
        low, high = corners_xy.min(axis=0), corners_xy.max(axis=0)
        margin = _MARGIN_SHARE * (high - low).max()
        left, top = np.maximum(low - margin, 0).astype(int)
        right, bottom = (high + margin).astype(int) + 1
        around, numbers, _ = self._exact.detectMarkers(np.ascontiguousarray(grey[top:bottom, left:right]))
        same = [] if numbers is None else np.flatnonzero(np.ravel(numbers) == number)
        if len(same) != 1:
            return None
        in_part = np.asarray(around[same[0]][0], dtype=np.float64)
        return np.asarray(in_part + np.array([left, top]) - _APRILTAG_PIXEL_CENTRE)

    def place(
        self, T_world_cam: Mapping[int, Array], camera: Intrinsics, side_m: float, marker_id: int | None
    ) -> MarkerPlacement:
        """Return the similarity from the map to the frame of a marker, in metres.

        Args:
            T_world_cam: Poses of images of one part of the map, by frame id; others do not count.
            camera: Of the images.
            side_m: Side of the marker's black square.
            marker_id: Its number; None for the one that tells the scale and is in most images.

        Raises:
            SourceError: No marker was found in enough images, or from too few directions to tell the scale;
                of several the one in most images is told.
        """
        ids = {k: sorted(seen.keys() & T_world_cam.keys()) for k, seen in self.of.items()}
        numbers = sorted(ids, key=lambda k: (-len(ids[k]), k)) if marker_id is None else [marker_id]
        why: SourceError | None = None
        for number in numbers:
            if not ids.get(number):
                break
            corners_xy = np.array([self.of[number][k] for k in ids[number]])
            try:
                views = MarkerViews(np.array([T_world_cam[k] for k in ids[number]]), corners_xy)
                return _fit(views, camera, side_m, number)
            except SourceError as err:
                why = why or err
        raise why or SourceError(self.none_found(marker_id))

    def none_found(self, marker_id: int | None) -> str:
        """Say in a line that a marker is in no image, and what is."""
        number = "of any number" if marker_id is None else marker_id
        text = (
            f"marker {number} of {self._dictionary} must be in {MIN_IMAGES} images or more, "
            f"got none of {self.num_images}"
        )
        if self.of:
            text += f"; found: {', '.join(map(str, sorted(self.of)))}"
        for doubled, count in sorted(self.num_doubled.items()):
            text += f"; {doubled} is there twice in {count}"
        return text


def place_by_marker(
    data: RunData,
    images: Mapping[int, Path],
    side_m: float,
    dictionary: str,
    marker_id: int | None = None,
) -> MarkerPlacement:
    """Return the similarity from the map of a finished run to the frame of a marker, in metres.

    The frame's origin is the marker's centre, x points right and y up on the marker as printed, z out of it:
    with a marker on the floor z is up.

    Args:
        data: The run, of one part.
        images: Frame id to file of the kept images.
        side_m: Side of the marker's black square.
        dictionary: OpenCV's name of its family, such as ``apriltag_36h11`` or ``4x4_50``.
        marker_id: Its number; None for the one that tells the scale and is in most images.

    Raises:
        ConfigError: ``side_m`` or ``dictionary`` is not allowed.
        SourceError: No marker was found in enough images, or from too few directions to tell the scale.
    """
    if not (np.isfinite(side_m) and side_m > 0):
        raise ConfigError(f"side of the marker must be above 0 m, got {side_m}")
    T_world_cam = dict(zip(data.frame_ids.tolist(), data.T_world_cam, strict=True))
    posed = {frame_id: path for frame_id, path in images.items() if frame_id in T_world_cam}
    if not posed:
        raise SourceError(
            "the run kept no images, and a marker is looked for in them; run again with --save-images"
        )
    sightings = Sightings(dictionary)
    for frame_id, path in posed.items():
        expected = f"{path} must be an image of {data.intrinsics.width}x{data.intrinsics.height}"
        try:
            grey = to_grey(read_image(path))
        except SourceError as err:
            raise SourceError(expected) from err
        if grey.shape != data.intrinsics.shape_hw:
            raise SourceError(expected)
        sightings.look(frame_id, grey)
    return sightings.place(T_world_cam, data.intrinsics, side_m, marker_id)


def dictionaries() -> dict[str, int]:
    """Return names of marker families, as OpenCV has them in lower case, to its numbers for them."""
    names = sorted(name for name in vars(cv2.aruco) if name.startswith("DICT_"))
    return {name.removeprefix("DICT_").lower(): getattr(cv2.aruco, name) for name in names}


def _fit(views: MarkerViews, camera: Intrinsics, side_m: float, marker_id: int) -> MarkerPlacement:
    """Fit position, rotation and size of the marker in the map to its corners in all images."""
    num_found, name = len(views), f"marker {marker_id}"
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
    uncertainty = TWO_SIDED_95 * fit.sigma_log_scale
    if not uncertainty <= MAX_UNCERTAINTY:
        by = f" by {100 * uncertainty:.0f} %" if np.isfinite(uncertainty) else ""
        raise SourceError(
            f"{name} must be seen from several places to tell the scale; its {len(views)} images leave it "
            f"open{by}"
        )
    scale = 1.0 / fit.scale
    return MarkerPlacement(
        scale=scale,
        R=fit.R.T,
        t=-scale * fit.R.T @ fit.t,
        frame=f"x right, y up, z out of {name}; metres",
        words=(
            f"{name}: {len(views)} images, {rms_px:.2f} px; 1 unit of the map is {scale:.4g} m, "
            f"within {100 * uncertainty:.2g} % (95 %)"
        ),
        marker_id=marker_id,
        side_m=side_m,
        num_images=len(views),
        relative_sigma=fit.sigma_log_scale,
    )


@dataclass(frozen=True)
class _Fit:
    """A marker in the map: ``p_map = scale * R @ p_marker + t``.

    Attributes:
        residuals: ``(N, 4, 2)`` pixels.
        sigma_log_scale: Standard deviation of log ``scale``; infinite where the images leave it open.
    """

    scale: float
    R: Array
    t: Array
    residuals: Array
    sigma_log_scale: float


def _square(side_m: float) -> Array:
    return 0.5 * side_m * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])


def _view_errors_px(residuals: Array) -> Array:
    return np.asarray(np.sqrt((residuals**2).sum(axis=2).mean(axis=1)))


def _least_squares(views: MarkerViews, camera: Intrinsics, side_m: float) -> _Fit:
    """Minimise the reprojection error over seven parameters (Levenberg-Marquardt)."""
    square = _square(side_m)
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
    return _Fit(float(np.exp(x[0])), x[1], x[2], r, _sigma_log_scale(J, r, views.corners_xy))


def _sigma_log_scale(J: Array, r: Array, corners_xy: Array) -> float:
    """Return the standard deviation of the logarithm of the scale, infinite where that is open.

    Corners err each for itself; the four of an image together, as its pose does; and all of them inwards or
    outwards, as soft edges do in every image alike.
    """
    if np.linalg.matrix_rank(J.T @ J) < J.shape[1]:
        return np.inf
    per_px = np.linalg.pinv(J)[0].reshape(corners_xy.shape)
    outwards = corners_xy - corners_xy.mean(axis=1, keepdims=True)
    outwards /= np.linalg.norm(outwards, axis=2, keepdims=True)
    sigma_px = max(float(np.sqrt((r**2).mean())), _LEAST_SIGMA_PX)
    alone, together = (per_px**2).sum(), (per_px.sum(axis=1) ** 2).sum()
    soft_px = _SOFT_EDGE_PX * (per_px * outwards).sum()
    return float(np.sqrt(sigma_px**2 * (alone + together) + soft_px**2))
