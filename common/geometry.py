"""Rotations, rigid and similarity transforms.

``T_a_b`` is 4x4 and maps coordinates in frame b to frame a: ``p_a = T_a_b @ p_b``.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: OpenGL's camera axes (x right, y up, z backward) in ours (x right, y down, z forward); its own inverse.
T_opencv_opengl = np.diag([1.0, -1.0, -1.0, 1.0])

#: Square of an angle (rad) of whose powers the first two are enough.
_SMALL_ANGLE2 = 1e-8


def make_transform(R_a_b: ArrayLike, t_a_b: ArrayLike) -> Array:
    """Assemble a 4x4 rigid transform from a 3x3 rotation and a translation of length 3."""
    T_a_b = np.eye(4)
    T_a_b[:3, :3] = R_a_b
    T_a_b[:3, 3] = np.asarray(t_a_b, dtype=np.float64).reshape(3)
    return T_a_b


def invert_transform(T_a_b: ArrayLike) -> Array:
    """Invert rigid transforms of shape ``(..., 4, 4)`` without a general matrix inverse."""
    T = np.asarray(T_a_b, dtype=np.float64)
    R_b_a = np.swapaxes(T[..., :3, :3], -1, -2)
    T_b_a = np.zeros_like(T)
    T_b_a[..., :3, :3] = R_b_a
    T_b_a[..., :3, 3] = -(R_b_a @ T[..., :3, 3:])[..., 0]
    T_b_a[..., 3, 3] = 1.0
    return T_b_a


def transform_points(T_a_b: ArrayLike, points_b: ArrayLike) -> Array:
    """Map ``(N, 3)`` points from frame b to frame a."""
    T = np.asarray(T_a_b, dtype=np.float64)
    return np.asarray(points_b, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]


def skew(v: ArrayLike) -> Array:
    """Return the matrices ``(..., 3, 3)`` with ``skew(v) @ w == cross(v, w)`` of vectors ``(..., 3)``."""
    v = np.asarray(v, dtype=np.float64)
    W = np.zeros((*v.shape, 3))
    W[..., 2, 1], W[..., 0, 2], W[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    return np.asarray(W - W.swapaxes(-1, -2))


def exp_so3(rotation_vector_rad: ArrayLike) -> Array:
    """Rodrigues' formula: rotation vectors ``(..., 3)`` in radians to rotations ``(..., 3, 3)``."""
    w = np.asarray(rotation_vector_rad, dtype=np.float64)
    W = skew(w)
    first, second, _ = _series(w)
    return np.asarray(np.eye(3) + first * W + second * (W @ W))


def _series(rotation_vector_rad: Array) -> tuple[Array, Array, Array]:
    """``sin(a) / a``, ``(1 - cos(a)) / a^2``, ``(a - sin(a)) / a^3``, each ``(..., 1, 1)``, of angles a."""
    square = (rotation_vector_rad**2).sum(axis=-1)[..., None, None]
    is_small = square < _SMALL_ANGLE2
    square_or_1 = np.where(is_small, 1.0, square)
    angle_rad = np.sqrt(square_or_1)
    first = np.where(is_small, 1.0 - square / 6.0, np.sin(angle_rad) / angle_rad)
    second = np.where(is_small, 0.5 - square / 24.0, (1.0 - np.cos(angle_rad)) / square_or_1)
    third = np.where(is_small, 1.0 / 6.0, (1.0 - first) / square_or_1)
    return first, second, third


def log_so3(R: ArrayLike) -> Array:
    """Rotation vector (radians) of a 3x3 rotation, angle in [0, pi]."""
    quat_wxyz = quat_wxyz_from_rotation(R)
    sin_half = float(np.linalg.norm(quat_wxyz[1:]))
    angle_rad = 2.0 * np.arctan2(sin_half, quat_wxyz[0])
    scale = 2.0 if sin_half < 1e-12 else angle_rad / sin_half
    return np.asarray(scale * quat_wxyz[1:])


def logs_so3(R: Array) -> Array:
    """Rotation vectors ``(..., 3)`` (radians) of many rotations ``(..., 3, 3)``, in a small part of the time.

    Of half a turn itself nothing is told; ``log_so3`` takes one at a time and tells that too.
    """
    sine = 0.5 * np.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1
    )
    size = np.linalg.norm(sine, axis=-1, keepdims=True)
    angle_rad = np.arctan2(size, 0.5 * (np.trace(R, axis1=-2, axis2=-1)[..., None] - 1.0))
    return np.asarray(sine * angle_rad / np.maximum(size, 1e-12))


def exp_se3(xi: ArrayLike) -> Array:
    """Rigid transforms ``(..., 4, 4)`` of twists ``(..., 6)``, by the closed form.

    Args:
        xi: ``[rotation (rad), translation]``, gtsam's order.
    """
    xi = np.asarray(xi, dtype=np.float64)
    w = xi[..., :3]
    W = skew(w)
    W2 = W @ W
    first, second, third = _series(w)
    T = np.zeros((*xi.shape[:-1], 4, 4))
    T[..., :3, :3] = np.eye(3) + first * W + second * W2
    T[..., :3, 3:] = (np.eye(3) + second * W + third * W2) @ xi[..., 3:, None]
    T[..., 3, 3] = 1.0
    return T


def project_to_so3(M: ArrayLike) -> Array:
    """Nearest rotation (Frobenius norm) to a 3x3 matrix.

    gtsam's ``Rot3`` ends the interpreter on a non-orthonormal matrix, so every rotation passes here first.
    """
    U, _, Vt = np.linalg.svd(np.asarray(M, dtype=np.float64))
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def interpolate_pose(T_w_a: ArrayLike, T_w_b: ArrayLike, share: float) -> Array:
    """Return the pose between two, rotation along the geodesic; ``share`` 0 is the first, 1 the second."""
    a, b = np.asarray(T_w_a, dtype=np.float64), np.asarray(T_w_b, dtype=np.float64)
    R_a = a[:3, :3]
    R = R_a @ exp_so3(share * log_so3(R_a.T @ b[:3, :3]))
    return make_transform(R, (1.0 - share) * a[:3, 3] + share * b[:3, 3])


def quat_wxyz_from_rotation(R: ArrayLike) -> Array:
    """Unit quaternion ``(w, x, y, z)`` with ``w >= 0`` of a 3x3 rotation (Shepperd's method)."""
    R = np.asarray(R, dtype=np.float64)
    trace = np.trace(R)
    choices = np.array([trace, R[0, 0], R[1, 1], R[2, 2]])
    k = int(np.argmax(choices))
    if k == 0:
        q = np.array([1.0 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    else:
        i = k - 1
        j, m = (i + 1) % 3, (i + 2) % 3
        q = np.empty(4)
        q[0] = R[m, j] - R[j, m]
        q[1 + i] = 1.0 + R[i, i] - R[j, j] - R[m, m]
        q[1 + j] = R[j, i] + R[i, j]
        q[1 + m] = R[m, i] + R[i, m]
    q /= np.linalg.norm(q)
    return np.asarray(-q if q[0] < 0 else q)


def rotation_from_quat_wxyz(quat_wxyz: ArrayLike) -> Array:
    """3x3 rotation of a quaternion ``(w, x, y, z)``; it is normalised first.

    Raises:
        ValueError: The quaternion has no length.
    """
    q = np.asarray(quat_wxyz, dtype=np.float64)
    norm = float(np.linalg.norm(q))
    if not np.isfinite(norm) or norm < 1e-12:
        raise ValueError(f"quat_wxyz must have a length, got {q.tolist()}")
    w, x, y, z = q / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation_angle_deg(R: ArrayLike) -> float:
    """Angle of a 3x3 rotation in degrees, accurate near 0 and 180."""
    return float(np.degrees(np.linalg.norm(log_so3(R))))


def angle_between_deg(a: ArrayLike, b: ArrayLike) -> float:
    """Angle between two vectors of length 3 in degrees; 90 when one of them has no length."""
    a = np.asarray(a, dtype=np.float64)
    b = np.asarray(b, dtype=np.float64)
    if np.linalg.norm(a) == 0.0 or np.linalg.norm(b) == 0.0:
        return 90.0
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def angles_between_deg(a: Array, b: Array) -> Array:
    """Angles between vectors ``(N, 3)`` row by row, ``(N,)`` degrees; 0 when one of them has no length."""
    sine = np.linalg.norm(np.cross(a, b), axis=1)
    return np.asarray(np.degrees(np.arctan2(sine, (a * b).sum(axis=1))))


def align_umeyama(points_from: ArrayLike, points_to: ArrayLike) -> tuple[float, Array, Array]:
    """Least-squares similarity with ``points_to = scale * R @ points_from + t`` (Umeyama 1991).

    Args:
        points_from: ``(N, 3)``.
        points_to: ``(N, 3)``, row i belongs to row i of ``points_from``.

    Returns:
        ``(scale, R, t)``. Collinear points leave the rotation about their line free; any one is returned.

    Raises:
        ValueError: Fewer than two points, or no extent to take a scale from.
    """
    x = np.asarray(points_from, dtype=np.float64)
    y = np.asarray(points_to, dtype=np.float64)
    if x.shape != y.shape or x.ndim != 2 or x.shape[1] != 3 or len(x) < 2:
        raise ValueError(f"points must be two (N, 3) arrays with N >= 2, got {x.shape} and {y.shape}")
    mean_x, mean_y = x.mean(axis=0), y.mean(axis=0)
    variance_x = float(((x - mean_x) ** 2).sum(axis=1).mean())
    if variance_x == 0.0:
        raise ValueError("points_from must have an extent, got N equal points")
    U, D, Vt = np.linalg.svd((y - mean_y).T @ (x - mean_x) / len(x))
    S = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = U @ np.diag(S) @ Vt
    scale = float((D * S).sum() / variance_x)
    return scale, R, mean_y - scale * R @ mean_x
