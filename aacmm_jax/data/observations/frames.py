"""Residuals of tips from points that are known in an unknown frame, which several kinds of observations share."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...core.linear_algebra import products_by_column, solve_positive_definite
from ...core.numpy_or_jax import AnyArray, namespace
from ...core.rotations import cross_matrix, fitted_frame, rotation_and_derivative, rotation_matrix
from .columns import as_columns, each_pose
from .observation import Tips


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


def turned_z(direction: Float[AnyArray, " 3"]) -> Float[AnyArray, " 2"]:
    """The first two components of the rotation vector, whose third is 0, that turns z to a unit vector upwards."""
    xp = namespace(direction)
    sine = xp.sqrt(direction[0] ** 2 + direction[1] ** 2)
    level = sine < 1e-12
    factor = xp.where(level, 1.0, xp.arctan2(sine, direction[2]) / xp.where(level, 1.0, sine))
    return xp.stack([-direction[1] * factor, direction[0] * factor])


def frame_and_offset(
    coordinates: Float[AnyArray, "3 m"], tips: Tips, offset: Float[AnyArray, " 3"]
) -> tuple[Float[AnyArray, " 6"], Float[AnyArray, " 3"]]:
    """A station's frame and the place of its target in the last frame, from points that the station measured.

    The tips are o + A p, with A the axes of the last frame; in the station's frame, whose rotation in the base frame is
    R, the points y are R y + c = o + A p. In R, c and p this is linear, so R is found as a matrix first, which then
    becomes the nearest rotation.
    """
    xp = namespace(coordinates, tips, offset)
    axes = xp.stack(tips.axes, axis=1)  # (3, 3, m): columns are axes
    origin = tips.position - xp.einsum("cpm,p->cm", axes, offset)
    size = xp.sqrt(xp.mean((coordinates - xp.mean(coordinates, axis=1, keepdims=True)) ** 2)) + 1e-9
    centred = (coordinates - xp.mean(coordinates, axis=1, keepdims=True)) / size
    m = coordinates.shape[1]
    identity = xp.asarray(np.eye(3))
    # Unknowns: R by rows (9, times the size), the station's centre (3), minus p (3).
    by_matrix = (identity[:, :, None, None] * centred[None, None]).reshape(3, 9, m)
    by_centre = xp.broadcast_to(identity[:, :, None], (3, 3, m))
    design = xp.concatenate([by_matrix, by_centre, -axes], axis=1)
    normal = xp.einsum("cum,cvm->uv", design, design)
    right = xp.einsum("cum,cm->u", design, origin)
    solution = solve_positive_definite(normal + 1e-9 * m * xp.asarray(np.eye(15)), right)
    found = solution[12:]
    target = origin + xp.einsum("cpm,p->cm", axes, found)
    return fitted_frame(coordinates, target), found


def moved(frame: Float[np.ndarray, " 6"], point: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """A point turned by a frame's rotation and moved by its origin, mm."""
    return np.asarray(rotation_matrix(frame[:3])) @ point + frame[3:]
