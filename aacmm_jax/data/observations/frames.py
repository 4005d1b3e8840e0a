"""Arrays over the poses of an observation, and points in an unknown frame: what several kinds share."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...core.linear_algebra import products_by_column
from ...core.numpy_or_jax import AnyArray, namespace
from ...core.rotations import cross, cross_matrix, rotation_and_derivative, rotation_matrix


def as_columns(values: Float[AnyArray, "k ..."]) -> Float[AnyArray, "k p"]:
    """Numbers ``(k,)`` as one column; columns as they are."""
    return values.reshape(len(values), -1)


def each_pose(matrix: Float[AnyArray, "r c"], poses: int) -> Float[AnyArray, "r c m"]:
    """The same matrix for every pose."""
    return namespace(matrix).broadcast_to(matrix[:, :, None], (*matrix.shape, poses))


def variances(u: Float[AnyArray, "..."], poses: int) -> Float[AnyArray, "m 1 1"]:
    """Covariances of one residual a pose, from one standard uncertainty for all or from one each."""
    xp = namespace(u)
    square = xp.reshape(xp.asarray(u**2), (-1, 1, 1))
    return square if len(square) == poses else xp.broadcast_to(square, (poses, 1, 1))


def no_covariance(rows: int, poses: int) -> Float[np.ndarray, "m r r"]:
    """Of observations in which nothing was measured but the poses."""
    return np.zeros((poses, rows, rows))


class Placed(NamedTuple):
    """Points of a frame as they are in the frame around it; p is 1 for one frame, m for a frame of each point."""

    points: Float[AnyArray, "3 m"]  # mm
    by_frame: Float[AnyArray, "6 3 m"]  # derivatives by the six numbers of the frame
    rotation: Float[AnyArray, "3 3 p"]


def placed(frame: Float[AnyArray, "6 ..."], coordinates: Float[AnyArray, "3 m"]) -> Placed:
    """Points (mm) of a frame, ``(6,)`` or ``(6, 1)``, or of a frame each ``(6, m)``, in the frame around it."""
    xp, columns, m = namespace(frame, coordinates), as_columns(frame), coordinates.shape[1]
    rotation, axes = rotation_and_derivative(columns[:3])
    turned = products_by_column(rotation, coordinates)
    # A change of component k turns the points by a small rotation about column k of the derivative.
    small = cross_matrix(axes)  # (3, 3, k, p)
    by_rotation = products_by_column(xp.moveaxis(small, 2, 0).reshape(9, 3, -1), turned).reshape(3, 3, m)
    identity = each_pose(xp.asarray(np.eye(3)), m)
    return Placed(turned + columns[3:], xp.concatenate([by_rotation, identity]), rotation)


def turned_covariances(
    rotation: Float[AnyArray, "3 3 p"], covariance: Float[AnyArray, "m 3 3"]
) -> Float[AnyArray, "m 3 3"]:
    """Covariances R C R^T of what is turned, by one rotation (p = 1) or by one each (p = m)."""
    # As one product with the nine numbers of a covariance: for one rotation that takes an eighth of the time of two.
    both = (rotation[:, None, :, None] * rotation[None, :, None, :]).reshape(9, 9, -1)
    return products_by_column(both, covariance.reshape(-1, 9).T).T.reshape(-1, 3, 3)


def seen_from(frame: Float[AnyArray, " 6"], points: Float[AnyArray, "m 3"]) -> Float[AnyArray, "m 3"]:
    """Points of the frame around a frame, as coordinates in that frame, mm; undoes `placed`."""
    return (points - frame[3:]) @ rotation_matrix(frame[:3])


def rotation_logarithm(
    matrix: Float[AnyArray, "3 3 m"],
) -> tuple[Float[AnyArray, "3 m"], Float[AnyArray, "3 3 m"], Float[AnyArray, "3 3 m"]]:
    """Vectors of rotations well below a right angle, and their derivatives by a small rotation before and after.

    With w the vector: log(exp(e) exp(w)) = w + J^-1(w) e, J^-1(w) = I - W / 2 + c W^2, and after: J^-1(-w).
    """
    xp = namespace(matrix)
    half = [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    sine_axis = xp.stack(half) / 2
    square = xp.sum(sine_axis**2, axis=0)
    cosine = (matrix[0, 0] + matrix[1, 1] + matrix[2, 2] - 1) / 2
    small = square < 1e-12
    sine = xp.sqrt(xp.where(small, 1.0, square))
    angle = xp.arctan2(sine, cosine)
    w = xp.where(small, 1 + square / 6, angle / sine)[None] * sine_axis
    t2 = xp.sum(w**2, axis=0)
    near = t2 < 1e-6
    t = xp.sqrt(xp.where(near, 1.0, t2))
    c = xp.where(near, 1 / 12 + t2 / 720, 1 / t**2 - (1 + xp.cos(t)) / (2 * t * xp.sin(t)))
    identity = xp.asarray(np.eye(3))[:, :, None]
    columns = [cross(w, xp.broadcast_to(identity[:, i], w.shape)) for i in range(3)]
    skew = xp.stack(columns, axis=1)
    twice = xp.einsum("ijm,jkm->ikm", skew, skew)
    return w, identity - skew / 2 + c[None, None] * twice, identity + skew / 2 + c[None, None] * twice
