"""Two-view geometry: residuals of a relative pose, cheirality, and refinement.

What both cameras see lies on one half of its epipolar line, which begins where the point would be if it were
infinitely far away. The Sampson distance knows the whole line: with it alone a pose fits as well whose
translation is turned round and whose rotation makes up for some of that, and a refinement ends there.

The error of a match may have a shape, see ``edges``: what slid along an edge is off its epipolar line by no
more than its error across the line, whichever way that lies. *Shapes* are the covariances of both ends,
``(N, 2, 2)`` each and of determinant 1; distances are then those of matches known alike in all directions.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from semcast.common.camera import Intrinsics
from semcast.common.geometry import angles_between_deg, exp_so3, make_transform, project_to_so3, skew
from semcast.server.geometry.edges import whiteners
from semcast.server.geometry.weighting import HUBER_K

Array = NDArray[np.float64]
Shapes = tuple[Array, Array]

_HALF_ROOT = 0.5**0.5
#: Derivatives of a rotation at the identity, ``(3, 3, 3)``.
_GENERATORS = np.stack([skew(axis) for axis in np.eye(3)])


def essential_matrix(T_cam1_cam0: Array) -> Array:
    """``E = [t]x R (3, 3)`` with ``p1^T E p0 = 0`` for rays ``p0`` and ``p1`` (Eq. 14)."""
    return skew(T_cam1_cam0[:3, 3]) @ T_cam1_cam0[:3, :3]


def fundamental_matrix(camera: Intrinsics, T_cam1_cam0: Array) -> Array:
    """``F = K^-T [t]x R K^-1 (3, 3)`` for pixels of one camera, without distortion (Eq. 14)."""
    K_inv = np.linalg.inv(camera.K)
    return np.asarray(K_inv.T @ essential_matrix(T_cam1_cam0) @ K_inv)


def shape_of(edge: Array) -> Array:
    """Covariances ``(N, 2, 2)`` of determinant 1 of errors at points with edges ``(N, 2)``."""
    # What whitens twice the edge turned across itself is as long along the edge as it would be short.
    return whiteners(2.0 * np.column_stack([-edge[:, 1], edge[:, 0]]))


def sampson_px(F: Array, keypoints0_xy: Array, keypoints1_xy: Array, shapes: Shapes | None = None) -> Array:
    """Signed Sampson distance in pixels: first-order distance of a match to the epipolar constraint.

    Args:
        F: ``(3, 3)`` or ``(B, 3, 3)`` fundamental matrices.
        keypoints0_xy: ``(N, 2)``.
        keypoints1_xy: ``(N, 2)``.
        shapes: Of the errors; None where they are alike in all directions.

    Returns:
        ``(N,)`` or ``(B, N)``.
    """
    x0 = np.concatenate([keypoints0_xy, np.ones((len(keypoints0_xy), 1))], axis=1)
    x1 = np.concatenate([keypoints1_xy, np.ones((len(keypoints1_xy), 1))], axis=1)
    line1 = x0 @ np.swapaxes(F, -1, -2)
    line0 = x1 @ F
    algebraic = (x1 * line1).sum(axis=-1)
    spread0, spread1 = _spreads(line0, line1, shapes)
    square = (line1[..., :2] * spread1).sum(axis=-1) + (line0[..., :2] * spread0).sum(axis=-1)
    return np.asarray(algebraic / np.sqrt(np.maximum(square, 1e-18)))


def _spreads(line0: Array, line1: Array, shapes: Shapes | None) -> tuple[Array, Array]:
    """How errors move matches across their epipolar lines: shapes times normals, ``(..., N, 2)`` each."""
    if shapes is None:
        return line0[..., :2], line1[..., :2]
    return (shapes[0] @ line0[..., :2, None])[..., 0], (shapes[1] @ line1[..., :2, None])[..., 0]


def half_line_px(
    camera: Intrinsics, T_cam1_cam0: Array, xy0: Array, xy1: Array, shapes: Shapes | None = None
) -> Array:
    """Distance in pixels of matches to the half of their epipolar line in front of the cameras, ``(N,)``.

    It is the Sampson distance, and for a point behind the cameras also the way along the line to where its
    image would be at infinity, scaled alike.

    Args:
        camera: Of both images.
        T_cam1_cam0: ``(4, 4)`` relative pose.
        xy0: ``(N, 2)`` pixels.
        xy1: ``(N, 2)`` pixels, matched row by row.
        shapes: Of the errors across the line; None where they are alike in all directions.
    """
    across = sampson_px(fundamental_matrix(camera, T_cam1_cam0), xy0, xy1, shapes)
    return np.hypot(across, beyond_infinity_px(camera, T_cam1_cam0, xy0, xy1))


def beyond_infinity_px(camera: Intrinsics, T_cam1_cam0: Array, xy0: Array, xy1: Array) -> Array:
    """How far matches lie beyond infinity along their epipolar lines, ``(N,)``: 0 in front, else negative.

    Pixels are divided by the root of 2, as the Sampson distance shares an error between two images. Arguments
    as ``half_line_px``.
    """
    return np.minimum(_from_infinity(camera, T_cam1_cam0, xy0, xy1)[0], 0.0)


def beyond_infinity_jacobian(
    camera: Intrinsics, T_cam1_cam0: Array, tangent: Array, xy0: Array, xy1: Array
) -> tuple[Array, Array]:
    """``beyond_infinity_px`` and its derivatives by the pose, ``(N, 5)``: those of ``sampson_jacobian``."""
    along, way, length, offset, x, y = _from_infinity(camera, T_cam1_cam0, xy0, xy1)
    focal_px = np.array([camera.fx, camera.fy])
    # As the pose changes, the point at infinity moves, and the way turns by what it then lies to the side.
    side = (_HALF_ROOT * offset - along[:, None] * way) / length[:, None]
    pull = (_HALF_ROOT * way + T_cam1_cam0[2, 3] * side) * focal_px
    J = np.empty((len(x), 5))
    J[:, 0] = pull[:, 0] * x * y + pull[:, 1] * (1.0 + y * y)
    J[:, 1] = -pull[:, 0] * (1.0 + x * x) - pull[:, 1] * x * y
    J[:, 2] = pull[:, 0] * y - pull[:, 1] * x
    side *= focal_px
    J[:, 3:] = side @ tangent[:, :2].T - (side[:, :1] * x[:, None] + side[:, 1:] * y[:, None]) * tangent[:, 2]
    is_behind = along < 0.0
    return np.where(is_behind, along, 0.0), np.where(is_behind[:, None], J, 0.0)


def _from_infinity(
    camera: Intrinsics, T_cam1_cam0: Array, xy0: Array, xy1: Array
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Where matches lie on their epipolar lines, seen from the point at infinity.

    Returns:
        Pixels over the root of 2 along the line, ``(N,)``, positive towards a near point; the unit vector of
        that way, ``(N, 2)``; how long it is for a unit of inverse depth; pixels from infinity ``(N, 2)``; and
        the turned rays at a depth of 1, ``(N,)`` each.
    """
    ray = camera.unproject(xy0) @ T_cam1_cam0[:3, :3].T
    z = np.maximum(ray[:, 2], 1e-6)
    x, y = ray[:, 0] / z, ray[:, 1] / z
    t = T_cam1_cam0[:3, 3]
    way = np.stack([camera.fx * (t[0] - x * t[2]), camera.fy * (t[1] - y * t[2])], axis=1)
    length = np.maximum(np.sqrt((way * way).sum(axis=1)), 1e-9)
    way /= length[:, None]
    offset = xy1 - np.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], axis=1)
    return _HALF_ROOT * (offset * way).sum(axis=1), way, length, offset, x, y


def msac_score(residual_px: Array, threshold_px: float, weight: Array | None = None) -> float:
    """Mean truncated squared residual in units of the squared threshold: 0 is perfect, 1 is no inlier.

    Args:
        residual_px: ``(N,)``.
        threshold_px: From which a residual counts in full.
        weight: ``(N,)`` of the mean, None for equal ones.
    """
    if len(residual_px) == 0:
        return 1.0
    return float(np.average(np.minimum(1.0, (residual_px / threshold_px) ** 2), weights=weight))


def depths(camera: Intrinsics, T_cam1_cam0: Array, xy0: Array, xy1: Array) -> tuple[Array, Array]:
    """Depths of matches in both cameras, where their rays come nearest to each other.

    Args:
        camera: Of both images.
        T_cam1_cam0: ``(4, 4)``; its translation is the unit of the depths.
        xy0: ``(N, 2)`` pixels.
        xy1: ``(N, 2)`` pixels, matched row by row.

    Returns:
        ``(N,)`` depths along the axis of the first camera, and of the second; negative behind it, and without
        meaning where rays are parallel.
    """
    ray0 = camera.unproject(xy0) @ T_cam1_cam0[:3, :3].T
    ray1 = camera.unproject(xy1)
    t = T_cam1_cam0[:3, 3]
    a = (ray0 * ray0).sum(axis=1)
    b = (ray0 * ray1).sum(axis=1)
    c = (ray1 * ray1).sum(axis=1)
    determinant = np.maximum(a * c - b * b, 1e-15)
    ray0_t, ray1_t = ray0 @ t, ray1 @ t
    return (b * ray1_t - c * ray0_t) / determinant, (a * ray1_t - b * ray0_t) / determinant


def most_in_front(camera: Intrinsics, candidates: Sequence[Array], xy0: Array, xy1: Array) -> Array:
    """Of relative poses ``(4, 4)`` the one with most points in front of both cameras; of equals the first.

    Args:
        camera: Of both images.
        candidates: ``T_cam1_cam0`` each, with a translation.
        xy0: ``(N, 2)`` pixels.
        xy1: ``(N, 2)`` pixels, matched row by row.
    """
    counts = []
    for T in candidates:
        depth0, depth1 = depths(camera, T, xy0, xy1)
        counts.append(int(((depth0 > 0) & (depth1 > 0)).sum()))
    return candidates[int(np.argmax(counts))]


def rays_angle_deg(camera: Intrinsics, T_cam1_cam0: Array, xy0: Array, xy1: Array) -> Array:
    """Angle between the two rays of each match, ``(N,)`` degrees: the parallax.

    Of the pose the rotation alone counts; pixels are ``(N, 2)``, matched row by row.
    """
    return angles_between_deg(camera.unproject(xy0) @ T_cam1_cam0[:3, :3].T, camera.unproject(xy1))


def rotation_residual_px(camera: Intrinsics, R_cam1_cam0: Array, xy0: Array, xy1: Array) -> Array:
    """Distance in pixels between ``xy1 (N, 2)`` and ``xy0 (N, 2)`` turned by a rotation alone, ``(N,)``.

    Where the turned ray points behind the camera it is as a rule huge.
    """
    turned = camera.unproject(xy0) @ R_cam1_cam0.T
    z = np.maximum(turned[:, 2], 1e-6)
    x = camera.fx * turned[:, 0] / z + camera.cx
    y = camera.fy * turned[:, 1] / z + camera.cy
    return np.asarray(np.hypot(x - xy1[:, 0], y - xy1[:, 1]))


def fit_rotation(camera: Intrinsics, xy0: Array, xy1: Array, iterations: int = 8) -> Array:
    """Rotation ``R_cam1_cam0`` that explains matches best, reweighted towards the majority.

    Args:
        camera: Of both images.
        xy0: ``(N, 2)`` pixels.
        xy1: ``(N, 2)`` pixels, matched row by row.
        iterations: Fits, each with weights of the one before.

    Returns:
        ``(3, 3)``; the identity without matches.
    """
    # Rays keep their length: a pixel is a smaller angle away from the middle, and so such matches count more.
    ray0, ray1 = camera.unproject(xy0), camera.unproject(xy1)
    weight = np.ones(len(ray0))
    R = np.eye(3)
    for _ in range(iterations):
        R = project_to_so3((ray1 * weight[:, None]).T @ ray0)
        weight = 1.0 / (1.0 + rotation_residual_px(camera, R, xy0, xy1) ** 2)
    return R


def _tangent(t: Array) -> Array:
    """Two directions across a unit vector, ``(2, 3)``."""
    a = _cross(t, np.eye(3)[int(np.argmin(np.abs(t)))])
    a /= np.linalg.norm(a)
    return np.stack([a, _cross(t, a)])


def _cross(a: Array, b: Array) -> Array:
    # numpy's own is made for stacks of vectors and takes far longer for a single one.
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _moved(T: Array, step: Array, tangent: Array) -> Array:
    t = T[:3, 3] + step[3:] @ tangent
    return make_transform(exp_so3(step[:3]) @ T[:3, :3], t / np.linalg.norm(t))


def sampson_jacobian(
    camera: Intrinsics,
    T_cam1_cam0: Array,
    tangent: Array,
    xy0: Array,
    xy1: Array,
    shapes: Shapes | None = None,
) -> tuple[Array, Array]:
    """Sampson distances of a pose and how they change with it.

    Args:
        camera: Of both images.
        T_cam1_cam0: Pose, translation of length 1.
        tangent: ``(2, 3)`` unit vectors across the translation.
        xy0: ``(N, 2)``.
        xy1: ``(N, 2)``.
        shapes: Of the errors; None where they are alike in all directions.

    Returns:
        ``(N,)`` pixels, and ``(N, 5)`` their derivatives by a turn applied from the left (3, radians) and by
        the way of the translation along ``tangent`` (2).
    """
    R, t = T_cam1_cam0[:3, :3], T_cam1_cam0[:3, 3]
    dE = np.stack([*(skew(t) @ _GENERATORS @ R), *(skew(a) @ R for a in tangent)])
    K_inv = np.linalg.inv(camera.K)
    F, dF = K_inv.T @ skew(t) @ R @ K_inv, K_inv.T @ dE @ K_inv
    x0 = np.concatenate([xy0, np.ones((len(xy0), 1))], axis=1)
    x1 = np.concatenate([xy1, np.ones((len(xy1), 1))], axis=1)
    line1, dline1 = x0 @ F.T, x0 @ np.swapaxes(dF, 1, 2)
    line0, dline0 = x1 @ F[:, :2], x1 @ dF[:, :, :2]
    spread0, spread1 = _spreads(line0, line1, shapes)
    square = np.maximum((line1[:, :2] * spread1).sum(axis=1) + (line0 * spread0).sum(axis=1), 1e-18)
    residual = (x1 * line1).sum(axis=1) / np.sqrt(square)
    dsquare = (spread1 * dline1[..., :2]).sum(axis=2) + (spread0 * dline0).sum(axis=2)
    J = (x1 * dline1).sum(axis=2) / np.sqrt(square) - residual * dsquare / square
    return residual, J.T


def turn_in_doubt_deg(camera: Intrinsics, T_cam1_cam0: Array, xy0: Array, xy1: Array) -> float:
    """Standard deviation in degrees of a relative pose's turn about its least certain axis.

    Across a narrow strip of the image, a camera that goes sideways looks like one that turns.

    Args:
        camera: Of both images.
        T_cam1_cam0: Pose, translation of length 1.
        xy0: ``(N, 2)`` of matches that agree with it, each with an error of one pixel across its line.
        xy1: ``(N, 2)``.
    """
    _, J = sampson_jacobian(camera, T_cam1_cam0, _tangent(T_cam1_cam0[:3, 3]), xy0, xy1)
    # With next to nothing added, what the matches do not tell at all is in great doubt, and no error.
    covariance = np.linalg.inv(J.T @ J + 1e-6 * np.eye(5))[:3, :3]
    return float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance)[-1])))


def refine_relative_pose(
    camera: Intrinsics,
    T_cam1_cam0: Array,
    xy0: Array,
    xy1: Array,
    sigma_px: Array,
    *,
    shapes: Shapes | None = None,
    cut_sigmas: float = 4.0,
    iterations: int = 10,
) -> Array:
    """Minimise the weighted distance to epipolar half lines over rotation and translation direction.

    Args:
        camera: Of both images.
        T_cam1_cam0: Start, translation of length 1.
        xy0: ``(N, 2)``.
        xy1: ``(N, 2)``.
        sigma_px: ``(N,)`` standard deviation of each match's distance.
        shapes: Of the errors across the lines; None where they are alike in all directions.
        cut_sigmas: Residuals beyond it pull no longer (Huber up to there).
        iterations: Gauss-Newton steps at most.

    Returns:
        The refined pose; the start where it got no better.
    """
    T = T_cam1_cam0.copy()
    cost, tangent, H, g = _linearised(camera, T, xy0, xy1, sigma_px, shapes, cut_sigmas)
    damping = 1e-4
    for _ in range(iterations):
        try:
            step = np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-12 * np.eye(5), g)
        except np.linalg.LinAlgError:
            break
        if not np.isfinite(step).all() or float(np.abs(step).max()) > 1.0:
            break
        candidate = _moved(T, np.asarray(step), tangent)
        at_candidate = _linearised(camera, candidate, xy0, xy1, sigma_px, shapes, cut_sigmas)
        if at_candidate[0] < cost:
            gain = cost - at_candidate[0]
            T, damping = candidate, damping * 0.3
            cost, tangent, H, g = at_candidate
            if gain < 1e-6 * cost:
                break
        else:
            damping *= 10.0
            if damping > 1e3:
                break
    return make_transform(project_to_so3(T[:3, :3]), T[:3, 3])


def _linearised(
    camera: Intrinsics,
    T_cam1_cam0: Array,
    xy0: Array,
    xy1: Array,
    sigma_px: Array,
    shapes: Shapes | None,
    cut_sigmas: float,
) -> tuple[float, Array, Array, Array]:
    """Linearise the cost of ``refine_relative_pose`` at a pose.

    Returns:
        Cost; ``(2, 3)`` directions across the translation; Hessian ``(5, 5)`` and gradient ``(5,)`` of the
        normal equations of a Gauss-Newton step.
    """
    tangent = _tangent(T_cam1_cam0[:3, 3])
    across, J = sampson_jacobian(camera, T_cam1_cam0, tangent, xy0, xy1, shapes)
    beyond, J_beyond = beyond_infinity_jacobian(camera, T_cam1_cam0, tangent, xy0, xy1)
    size = np.hypot(across, beyond) / sigma_px
    a = np.minimum(size, cut_sigmas)
    cost = float(np.where(a < HUBER_K, 0.5 * a * a, HUBER_K * (a - 0.5 * HUBER_K)).sum())
    w = np.where(size < cut_sigmas, np.minimum(1.0, HUBER_K / np.maximum(size, 1e-9)), 0.0)
    w /= sigma_px * sigma_px
    J_w, J_beyond_w = J * w[:, None], J_beyond * w[:, None]
    H = J_w.T @ J + J_beyond_w.T @ J_beyond
    g = -J_w.T @ across - J_beyond_w.T @ beyond
    return cost, tangent, H, g
