"""Arrays over the poses of an observation, which all kinds share: columns of unknowns, matrices, covariances."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ...core.numpy_or_jax import AnyArray, namespace, numpy_if_known


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


@numpy_if_known
def taken(values: AnyArray, rows: Int[np.ndarray, " k"]) -> AnyArray:
    """The rows of an array."""
    return values[rows]


def joined_poses(values: Sequence[Any]) -> Any:
    """A field of several observations, arrays or tuples with an item for each pose, as that of one; None of None."""
    if values[0] is None:
        return None
    if isinstance(values[0], tuple):
        return tuple(itertools.chain(*values))
    return namespace(values).concatenate(values)
