"""Rotations: their vectors (axis times angle, rad), matrices and derivatives, and the frame that fits points best.

A frame is six numbers: the rotation vector, and the origin in mm. It takes coordinates y in the frame to R y + origin.
Where a function takes vectors ``(3, ...)``, these are columns, and matrices of them are ``(3, 3, ...)``.
"""

import numpy as np
from jaxtyping import Float

from .linear_algebra import semidefinite_eigen
from .numpy_or_jax import AnyArray, namespace

Vectors = Float[AnyArray, "3 ..."]
Matrices = Float[AnyArray, "3 3 ..."]
_SMALL = 1e-6  # rad^2: below it the series are exact to rounding
# The matrix W of a cross product, W v = w x v, by the components of w: its nine entries as rows.
_CROSS = np.zeros((9, 3))
_CROSS[[7, 2, 3], [0, 1, 2]], _CROSS[[5, 6, 1], [0, 1, 2]] = 1.0, -1.0


def cross(u: Float[AnyArray, "... 3 m"], v: Float[AnyArray, "... 3 m"]) -> Float[AnyArray, "... 3 m"]:
    """Cross products of vectors that are columns."""
    (u0, u1, u2), (v0, v1, v2) = ((w[..., 0, :], w[..., 1, :], w[..., 2, :]) for w in (u, v))
    return namespace(u, v).stack([u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0], axis=-2)


def cross_matrix(w: Vectors) -> Matrices:
    """The matrices that take vectors v to the cross products w x v."""
    return (namespace(w).asarray(_CROSS) @ w.reshape(3, -1)).reshape(3, 3, *w.shape[1:])


def _coefficients(w: Vectors) -> tuple[AnyArray, AnyArray, AnyArray]:
    """sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3 of the angle t; by series near 0."""
    xp = namespace(w)
    square = xp.sum(w**2, axis=0)
    small = square < _SMALL
    safe = xp.where(small, 1.0, square)
    t = xp.sqrt(safe)
    return (
        xp.where(small, 1 - square / 6, xp.sin(t) / t),
        xp.where(small, 0.5 - square / 24, (1 - xp.cos(t)) / safe),
        xp.where(small, 1 / 6 - square / 120, (t - xp.sin(t)) / (t * safe)),
    )


def rotation_matrix(w: Vectors) -> Matrices:
    """The rotation by the angle ``|w|`` about the axis ``w`` (Rodrigues 1840)."""
    sine, cosine, _ = _coefficients(w)
    return _polynomial(w, sine, cosine)


def rotation_and_derivative(w: Vectors) -> tuple[Matrices, Matrices]:
    """`rotation_matrix`, and J with exp(w + dw) = exp(J dw) exp(w) to first order: the group's left Jacobian."""
    sine, cosine, cubic = _coefficients(w)
    return _polynomial(w, sine, cosine), _polynomial(w, cosine, cubic)


def _polynomial(w: Vectors, first: Float[AnyArray, "..."], second: Float[AnyArray, "..."]) -> Matrices:
    """I + first W + second W^2, with W the matrix of the cross product by w, and W^2 = w w^T - |w|^2 I."""
    xp = namespace(w, first, second)
    identity = xp.asarray(np.eye(3).reshape(3, 3, *(1,) * (w.ndim - 1)))
    diagonal = (1 - second * xp.sum(w**2, axis=0))[None, None]
    return diagonal * identity + first[None, None] * cross_matrix(w) + second[None, None] * (w[:, None] * w[None])


def inverse_frame(frame: Float[AnyArray, " 6"]) -> tuple[Float[AnyArray, " 6"], Float[AnyArray, "6 6"]]:
    """The outer frame as seen in the given one, and the derivatives of its six numbers by those of the given one."""
    xp, rotation, origin = namespace(frame), rotation_matrix(frame[:3]).T, frame[3:]
    identity, none = xp.asarray(np.eye(3)), xp.zeros((3, 3))
    by_rotation = -rotation @ cross_matrix(origin) @ rotation_and_derivative(frame[:3])[1]
    derivative = xp.concatenate(
        [xp.concatenate([-identity, none], axis=1), xp.concatenate([by_rotation, -rotation], axis=1)]
    )
    return xp.concatenate([-frame[:3], -rotation @ origin]), derivative


def rotation_vector(matrix: Float[AnyArray, "3 3"]) -> Float[AnyArray, " 3"]:
    """The rotation vector of a matrix, of length pi at most; by its quaternion (Shepperd 1978)."""
    xp, r = namespace(matrix), matrix
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    rows = [[1 + trace, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]]
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        row = [r[k, j] - r[j, k], 0.0, 0.0, 0.0]
        row[1 + i] = 1 + 2 * r[i, i] - trace
        row[1 + j], row[1 + k] = r[i, j] + r[j, i], r[i, k] + r[k, i]
        rows.append(row)
    candidates = xp.stack([xp.stack([xp.asarray(x, dtype=float) for x in row]) for row in rows])
    quaternion = candidates[xp.argmax(xp.stack([row[i] for i, row in enumerate(candidates)]))]
    return _vector_of_quaternion(quaternion)


def _vector_of_quaternion(quaternion: Float[AnyArray, " 4"]) -> Float[AnyArray, " 3"]:
    xp = namespace(quaternion)
    quaternion = xp.where(quaternion[0] < 0, -quaternion, quaternion)
    real, imaginary = quaternion[0], quaternion[1:]
    square = xp.sum(imaginary**2)
    small = square < 1e-24 * real**2
    size = xp.sqrt(xp.where(small, 1.0, square))
    return xp.where(small, 2 / xp.where(small, real, 1.0), 2 * xp.arctan2(size, real) / size) * imaginary


def roll_pitch_yaw_matrix(angles: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation Rz(yaw) Ry(pitch) Rx(roll): about the fixed axes x, y and z, as URDF has it; rad."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def roll_pitch_yaw(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 3"]:
    """Roll, pitch and yaw of a rotation, rad; the product is exact also where the pitch is a right angle.

    There roll and yaw have the same axis: yaw is then known badly, but roll is that of what yaw and pitch leave.
    """
    yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
    pitch = np.arctan2(-matrix[2, 0], np.hypot(matrix[0, 0], matrix[1, 0]))
    # The second row of what is left is (0, cos roll, -sin roll).
    side = np.array([-np.sin(yaw), np.cos(yaw), 0.0]) @ matrix
    return np.array([np.arctan2(-side[2], side[1]), pitch, yaw])


def fitted_frame(coordinates: Float[AnyArray, "3 m"], targets: Float[AnyArray, "3 m"]) -> Float[AnyArray, " 6"]:
    """The frame in which points of these coordinates come closest to their targets, in the sense of least squares.

    Horn 1987: the rotation is the eigenvector of the largest eigenvalue of a symmetric 4 x 4 matrix.
    """
    xp = namespace(coordinates, targets)
    centres = xp.mean(coordinates, axis=1), xp.mean(targets, axis=1)
    s = (coordinates - centres[0][:, None]) @ (targets - centres[1][:, None]).T
    imaginary = [s[1, 2] - s[2, 1], s[2, 0] - s[0, 2], s[0, 1] - s[1, 0]]
    trace = s[0, 0] + s[1, 1] + s[2, 2]
    top = xp.stack([trace, *imaginary])
    rest = xp.concatenate([xp.stack(imaginary)[:, None], s + s.T - trace * xp.asarray(np.eye(3))], axis=1)
    matrix = xp.concatenate([top[None], rest])
    # Shifted by more than its norm, so that all eigenvalues are positive; scaled for the sake of rounding.
    size = xp.sqrt(xp.sum(matrix**2)) + 1e-300
    _, vectors = semidefinite_eigen(matrix / size + 1.01 * xp.asarray(np.eye(4)))
    w = _vector_of_quaternion(vectors[:, 0])
    return xp.concatenate([w, centres[1] - rotation_matrix(w) @ centres[0]])
