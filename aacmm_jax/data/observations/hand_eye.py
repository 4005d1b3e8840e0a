"""Where a camera and its target are, from the poses of the arm and the views of the target: A X = Y B.

Of each pose, T is the transform of the last frame in the base frame, and W that from what stands still to what the arm
carries, as the view shows it. X, the place in the last frame of what the arm carries, and Y, the place of what stands
still, fulfil T X W = Y in every pose. This start takes all poses at once, in closed form, and counts bad ones less.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from ...core.linear_algebra import semidefinite_eigen, solve_positive_definite
from ...core.numpy_or_jax import AnyArray, namespace
from ...core.rotations import rotation_vector

_ROUNDS = 6  # of weights against bad poses
_LEAST = 1e-6  # rad, and of the sizes, mm: residuals below it all count alike


def hand_eye(
    tips: Float[AnyArray, "3 m"],
    axes: Float[AnyArray, "3 3 m"],
    turns: Float[AnyArray, "m 3 3"],
    origins: Float[AnyArray, "m 3"],
    counted: Float[AnyArray, " m"],
) -> tuple[AnyArray, AnyArray, AnyArray]:
    """X as a position and a rotation vector, and Y as a frame.

    Args:
        tips: origins of the last frame in the base frame, mm.
        axes: its axes; column i of a matrix is ``axes[:, i]``.
        turns: rotations of W.
        origins: its translations, mm.
        counted: 1 for each pose whose view is known, else 0.
    """
    xp = namespace(tips, axes, turns, origins)
    arm = xp.moveaxis(axes, -1, 0)  # (m, 3, 3)
    # T X W = Y is linear in the nine numbers of X: with K of all poses, |K x - y|^2 is least where x^T (sum K)^T y is
    # largest (Shah 2013).
    products = xp.einsum("mij,mlk->mikjl", arm, turns).reshape(-1, 9, 9)
    weight = counted
    x = y = xp.asarray(np.eye(3))
    for _ in range(_ROUNDS):
        total = xp.einsum("m,mij->ij", weight, products) / xp.sum(weight)
        _, vectors = semidefinite_eigen(total.T @ total)
        x = _rotation((vectors[:, 0]).reshape(3, 3))
        y = _rotation(xp.einsum("m,mij,jk,mkl->il", weight, arm, x, turns))
        rest = xp.sqrt(xp.sum((arm @ x @ turns - y[None]) ** 2, axis=(1, 2)))
        weight = counted * _weights(rest, counted, _LEAST)
    # Now R_T p + t + R_T R_X w = c is linear in p, the position of X, and in c.
    known = tips.T + xp.einsum("mij,mj->mi", arm @ x, origins)
    size = xp.sqrt(xp.mean(xp.sum(known**2, axis=1))) + 1e-12
    identity = xp.broadcast_to(xp.asarray(np.eye(3)), arm.shape)
    design, solution = xp.concatenate([arm, -identity], axis=2), xp.zeros(6)
    weight = counted * _weights(rest, counted, _LEAST)
    for _ in range(_ROUNDS):
        normal = xp.einsum("m,mia,mib->ab", weight, design, design) + 1e-9 * xp.sum(weight) * xp.asarray(np.eye(6))
        solution = solve_positive_definite(normal, -xp.einsum("m,mia,mi->a", weight, design, known))
        rest = xp.sqrt(xp.sum(((design @ solution[:, None])[..., 0] + known) ** 2, axis=1))
        weight = counted * _weights(rest, counted, _LEAST * size)
    return solution[:3], rotation_vector(x), xp.concatenate([rotation_vector(y), solution[3:]])


def _weights(rest: Float[AnyArray, " m"], counted: Float[AnyArray, " m"], least: Any) -> Float[AnyArray, " m"]:
    """Of poses by how far they are off: less than 1 beyond three times the median, none beyond nine times."""
    xp = namespace(rest, counted)
    order = xp.sort(xp.where(counted > 0, rest, np.inf))
    median = xp.where(counted > 0, order[(xp.sum(counted > 0) - 1) // 2], 0.0)
    ratio = rest / (3 * xp.maximum(median, least))
    return xp.where(ratio < 1, 1.0, xp.where(ratio < 3, 1 / xp.maximum(ratio, 1.0), 1e-6))


def _rotation(matrix: Float[AnyArray, "3 3"]) -> Float[AnyArray, "3 3"]:
    """The rotation nearest to a multiple, also a negative one, of a rotation."""
    xp = namespace(matrix)
    a, b, c = matrix
    matrix = xp.where(a @ xp.linalg.cross(b, c) < 0, -matrix, matrix)
    _, right = semidefinite_eigen(matrix.T @ matrix)
    left = matrix @ right
    left = left / xp.maximum(xp.sqrt(xp.sum(left**2, axis=0)), 1e-300)[None]
    left = xp.stack([left[:, 0], left[:, 1], xp.linalg.cross(left[:, 0], left[:, 1])], axis=1)
    right = xp.stack([right[:, 0], right[:, 1], xp.linalg.cross(right[:, 0], right[:, 1])], axis=1)
    return left @ right.T
