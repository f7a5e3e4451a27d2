"""Intrinsics from views of a chessboard (Zhang 2000, by OpenCV), and what makes a result doubtful."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.errors import SourceError
from semcast.common.sequence import ImageRectifier

Array = NDArray[np.float64]
Corners = NDArray[np.float32]
#: What is fitted: radial-tangential coefficients, five of them, four or none, or a fisheye's four.
FittedLens = Literal["radtan5", "radtan4", "none", "equidistant"]

MIN_VIEWS = 4
GOOD_VIEWS = 10
GOOD_COVERAGE = 0.5
GOOD_RMS_PX = 1.0
GOOD_FOCAL_DEVIATION = 0.01
#: Boards that are parallel to within this fit any focal length, and the deviations that OpenCV gives are then
#: of rounding: tenths of a pixel for one that is wrong by half.
_MIN_TILT_DEG = 2.0
_UNDETERMINED = (
    "the views don't determine the camera: show the board from several directions, "
    "tilted by 20-45 degrees and not only moved"
)
_COVERAGE_GRID = 6
#: A view this many times worse than the median one is left out.
_OUTLIER_FACTOR = 4.0
_CV_FLAGS: dict[str, int] = {
    "none": cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
    "radtan4": cv2.CALIB_FIX_K3,
    "radtan5": 0,
}
_NUM_COEFFICIENTS = {"none": 0, "radtan4": 4, "radtan5": 5, "equidistant": 4}
#: Boards are placed anew after each step, and pixels are not skewed. OpenCV 4 has the names elsewhere.
_FISHEYE_NAMES = cv2 if hasattr(cv2, "CALIB_RECOMPUTE_EXTRINSIC") else cv2.fisheye
_FISHEYE_FLAGS: int = _FISHEYE_NAMES.CALIB_RECOMPUTE_EXTRINSIC | _FISHEYE_NAMES.CALIB_FIX_SKEW
#: Fisheyes take more and smaller steps than the 30 that OpenCV would.
_FISHEYE_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-9)


@dataclass(frozen=True)
class BoardView:
    """One picture in which the board was found.

    Attributes:
        name: File name or frame number.
        corners_xy: ``(columns * rows, 2)`` float32 pixels, row by row.
    """

    name: str
    corners_xy: Corners


@dataclass(frozen=True)
class CalibrationResult:
    """A calibrated camera and how far to trust it.

    Attributes:
        intrinsics: With distortion.
        rms_px: Root mean square reprojection error over all corners used.
        views: Views used.
        view_rms_px: ``(V,)`` root mean square error of each.
        residuals_xy: ``(V, C, 2)`` observed minus projected corners in pixels.
        rejected: Names of views left out because they fit far worse than the others.
        deviations: Standard deviations of fx, fy, cx, cy in pixels.
        coverage: Share of a 6x6 grid over the image in which corners were seen.
    """

    intrinsics: Intrinsics
    rms_px: float
    views: tuple[BoardView, ...]
    view_rms_px: Array
    residuals_xy: Array
    rejected: tuple[str, ...]
    deviations: tuple[float, float, float, float]
    coverage: float

    def warnings(self) -> list[str]:
        """Return what makes the result doubtful and what to do about it; empty for a good one."""
        found = []
        if len(self.views) < GOOD_VIEWS:
            found.append(f"only {len(self.views)} views: take at least {GOOD_VIEWS}")
        if self.rms_px > GOOD_RMS_PX:
            found.append(
                f"reprojection error {self.rms_px:.2f} px, good is below {GOOD_RMS_PX:g}: "
                "hold the board flat, avoid blur, and check --board"
            )
        if self.coverage < GOOD_COVERAGE:
            found.append(
                f"corners cover {100 * self.coverage:.0f} % of the image: also show the board in the corners"
            )
        deviation = max(self.deviations[0] / self.intrinsics.fx, self.deviations[1] / self.intrinsics.fy)
        if deviation > GOOD_FOCAL_DEVIATION:
            found.append(
                f"focal length known to {100 * deviation:.1f} % only: tilt the board by 20-45 degrees"
            )
        return found


def find_board(image: NDArray[np.uint8], board: tuple[int, int]) -> Corners | None:
    """Return the ``(columns * rows, 2)`` inner corners of a chessboard to a fraction of a pixel, or None.

    Args:
        image: ``(H, W, 3)`` or ``(H, W)`` uint8.
        board: Inner corners: columns and rows, one less than squares.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(grey, board, flags=flags)
    if not found:
        return None
    # The detector is off by up to 0.7 px on tilted boards; a window inside the squares mends that.
    grid = np.asarray(corners, dtype=np.float64).reshape(board[1], board[0], 2)
    spacing_px = min(float(np.linalg.norm(np.diff(grid, axis=k), axis=-1).min()) for k in (0, 1))
    half = int(np.clip(0.3 * spacing_px, 2, 11))
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3)
    refined = cv2.cornerSubPix(grey, np.asarray(corners, dtype=np.float32), (half, half), (-1, -1), stop)
    return np.asarray(refined, dtype=np.float32).reshape(-1, 2)


def board_points(board: tuple[int, int]) -> NDArray[np.float32]:
    """Return the corners on the board's plane, ``(columns * rows, 3)``, one square apart."""
    columns, rows = board
    grid = np.mgrid[0:columns, 0:rows].T.reshape(-1, 2)
    return np.column_stack([grid, np.zeros(len(grid))]).astype(np.float32)


def calibrate(
    views: Sequence[BoardView],
    board: tuple[int, int],
    size_wh: tuple[int, int],
    distortion: FittedLens = "radtan5",
) -> CalibrationResult:
    """Fit pinhole and distortion to views of the board.

    Views that fit more than four times worse than the median one are left out and the fit is repeated once.
    The size of a square does not matter: it only scales the distances to the board.

    Args:
        views: At least ``MIN_VIEWS``, not all from the same direction.
        board: Inner corners: columns and rows.
        size_wh: Width and height of the pictures in pixels.
        distortion: ``none``, ``radtan4`` (k1 k2 p1 p2), ``radtan5`` (and k3), or a fisheye's ``equidistant``.

    Raises:
        SourceError: Too few views, or they do not determine the camera.
    """
    if len(views) < MIN_VIEWS:
        raise SourceError(f"calibration needs at least {MIN_VIEWS} views of the board, got {len(views)}")
    result = _fit(list(views), board, size_wh, distortion)
    limit = _OUTLIER_FACTOR * float(np.median(result.view_rms_px))
    good = [view for view, rms in zip(views, result.view_rms_px, strict=True) if rms <= limit]
    if len(good) == len(views) or len(good) < MIN_VIEWS:
        return result
    rejected = tuple(view.name for view, rms in zip(views, result.view_rms_px, strict=True) if rms > limit)
    return replace(_fit(good, board, size_wh, distortion), rejected=rejected)


def _fit(
    views: list[BoardView], board: tuple[int, int], size_wh: tuple[int, int], distortion: FittedLens
) -> CalibrationResult:
    solve = _solved_fisheye if distortion == "equidistant" else _solved_pinhole
    try:
        K, coefficients, rotations, residuals, deviations = solve(
            views, board_points(board), size_wh, distortion
        )
        intrinsics = Intrinsics(
            fx=float(K[0, 0]),
            fy=float(K[1, 1]),
            cx=float(K[0, 2]),
            cy=float(K[1, 2]),
            width=size_wh[0],
            height=size_wh[1],
            distortion=tuple(float(c) for c in coefficients.ravel()[: _NUM_COEFFICIENTS[distortion]]),
            distortion_model="equidistant" if distortion == "equidistant" else "radtan",
        )
    except (cv2.error, ValueError) as err:
        raise SourceError(f"{_UNDETERMINED} ({err})") from err
    tilt_deg = _largest_angle_deg(rotations)
    if tilt_deg < _MIN_TILT_DEG:
        raise SourceError(f"{_UNDETERMINED} (all are parallel to within {tilt_deg:.1f} degrees)")
    fx_fy_cx_cy = tuple(float(v) for v in deviations)
    view_rms_px = np.sqrt((residuals**2).sum(axis=2).mean(axis=1))
    return CalibrationResult(
        intrinsics=intrinsics,
        rms_px=float(np.sqrt((view_rms_px**2).mean())),
        views=tuple(views),
        view_rms_px=view_rms_px,
        residuals_xy=residuals,
        rejected=(),
        deviations=(fx_fy_cx_cy[0], fx_fy_cx_cy[1], fx_fy_cx_cy[2], fx_fy_cx_cy[3]),
        coverage=coverage(views, size_wh),
    )


#: ``K (3, 3)``, coefficients, rotation vectors of the boards, residuals ``(V, N, 2)`` in pixels, and standard
#: deviations of fx, fy, cx, cy.
_Solution = tuple[Array, Array, Sequence[Array], Array, Array]


def _solved_pinhole(
    views: list[BoardView], points: NDArray[np.float32], size_wh: tuple[int, int], distortion: FittedLens
) -> _Solution:
    observed = [np.ascontiguousarray(view.corners_xy[:, None]) for view in views]
    _, K, coefficients, rotations, translations, deviations, _, _ = cv2.calibrateCameraExtended(  # type: ignore[call-overload]  # the stubs refuse None matrices
        [points] * len(views), observed, size_wh, None, None, flags=_CV_FLAGS[distortion]
    )
    residuals = [
        o[:, 0] - cv2.projectPoints(points, r, t, K, coefficients)[0].reshape(-1, 2)
        for o, r, t in zip(observed, rotations, translations, strict=True)
    ]
    return K, coefficients, rotations, np.array(residuals, np.float64), deviations.ravel()[:4]


def _solved_fisheye(
    views: list[BoardView], points: NDArray[np.float32], size_wh: tuple[int, int], _distortion: FittedLens
) -> _Solution:
    board = points.astype(np.float64)[None]
    observed = [view.corners_xy.astype(np.float64)[None] for view in views]
    _, K, coefficients, turns, places = cv2.fisheye.calibrate(
        [board] * len(views),
        observed,
        size_wh,
        np.zeros((3, 3)),
        np.zeros(4),
        flags=_FISHEYE_FLAGS,
        criteria=_FISHEYE_STOP,
    )
    rotations = [np.asarray(turn, np.float64).ravel() for turn in turns]
    seen = [
        cv2.fisheye.projectPoints(board, r, np.ravel(t), K, coefficients)
        for r, t in zip(rotations, places, strict=True)
    ]
    residuals = np.array([o[0] - xy[0] for o, (xy, _) in zip(observed, seen, strict=True)])
    # OpenCV gives a fisheye no deviations. Its Jacobians begin with fx fy cx cy, k1 to k4 and the pose.
    normal = np.zeros((8, 8))
    for _, by_all in seen:
        jacobian = np.asarray(by_all, np.float64)
        lens, pose = jacobian[:, :8], jacobian[:, 8:14]
        normal += lens.T @ (lens - pose @ np.linalg.lstsq(pose, lens, rcond=None)[0])
    num_free = residuals.size - 8 - 6 * len(views)
    variance = (residuals**2).sum() / num_free * np.diag(np.linalg.inv(normal))
    return (
        np.asarray(K, np.float64),
        np.asarray(coefficients, np.float64),
        rotations,
        residuals,
        variance[:4] ** 0.5,
    )


def _largest_angle_deg(rotations: Sequence[Array]) -> float:
    """Return the largest angle between the normals of two boards, given as rotation vectors."""
    normals = np.array([cv2.Rodrigues(rotation)[0][:, 2] for rotation in rotations])
    return float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1)).max()))


def coverage(views: Sequence[BoardView], size_wh: tuple[int, int]) -> float:
    """Return the share of a 6x6 grid over the image in which corners were seen."""
    xy = np.concatenate([view.corners_xy for view in views]).astype(np.float64)
    cells = np.floor((xy + 0.5) / np.asarray(size_wh) * _COVERAGE_GRID).astype(int)
    cells = np.clip(cells, 0, _COVERAGE_GRID - 1)
    return len(np.unique(cells, axis=0)) / _COVERAGE_GRID**2


def is_new_view(corners_xy: Corners, known: Sequence[BoardView], width: int) -> bool:
    """Tell whether the board moved by at least 4 % of the image width against every known view."""
    return all(
        float(np.linalg.norm(corners_xy - view.corners_xy, axis=1).mean()) >= 0.04 * width for view in known
    )


def calibration_picture(result: CalibrationResult, sample: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Draw what a person judges the result by.

    Left, a view without its distortion: straight edges must be straight. Right, all corners of all views,
    with their residuals magnified so that the root mean square one is a fortieth of the image width.

    Args:
        result: The calibration.
        sample: ``(H, W, 3)`` uint8 RGB, one of the views.

    Returns:
        ``(H, 2 W, 3)`` uint8 RGB.
    """
    c = result.intrinsics
    straight = ImageRectifier(c, (c.width, c.height))(sample)
    canvas = np.full_like(sample, 255)
    magnification = c.width / 40 / max(result.rms_px, 1e-6)
    radius = max(1, c.width // 400)
    for view, residuals in zip(result.views, result.residuals_xy, strict=True):
        for corner, residual in zip(view.corners_xy, residuals, strict=True):
            start = (round(float(corner[0])), round(float(corner[1])))
            end = (
                round(float(corner[0] + magnification * residual[0])),
                round(float(corner[1] + magnification * residual[1])),
            )
            cv2.line(canvas, start, end, (200, 60, 40), radius, cv2.LINE_AA)
            cv2.circle(canvas, start, radius, (40, 70, 160), cv2.FILLED, cv2.LINE_AA)
    text = f"rms {result.rms_px:.3f} px, {len(result.views)} views, residuals x {magnification:.0f}"
    scale = c.width / 900
    place = (round(10 * scale), round(28 * scale))
    cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.8 * scale, (0, 0, 0), radius, cv2.LINE_AA)
    return np.hstack([straight, canvas])
