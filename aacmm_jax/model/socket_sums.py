"""Sums over the poses of each socket, and back: poses are kept socket after socket, along the last axis."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, namespace

# JAX multiplies by a matrix of (sockets, poses) up to this size, which suits batches of few sockets: the product is not
# fused with what surrounds it, so that a trial of a study has the same bits in every block. Larger problems take a
# segmented sum, which needs no memory beyond its result.
_LARGEST_MATRIX = 1_000_000


def sums_over_sockets(rows: Float[AnyArray, "... N"], sizes: tuple[int, ...]) -> Float[AnyArray, "... s"]:
    """The sum of each socket's poses."""
    if namespace(rows) is np:
        return np.add.reduceat(rows, starts(sizes), axis=-1)
    return _product(rows, membership(sizes)) if _is_small(sizes) else _segmented(jax.ops.segment_sum, rows, sizes)


def means_over_sockets(rows: Float[AnyArray, "... N"], sizes: tuple[int, ...]) -> Float[AnyArray, "... s"]:
    """The mean of each socket's poses."""
    if namespace(rows) is jnp and _is_small(sizes):
        return _product(rows, membership(sizes) / np.asarray(sizes, dtype=float)[:, None])
    return sums_over_sockets(rows, sizes) / counts(sizes, rows.ndim)


def _is_small(sizes: tuple[int, ...]) -> bool:
    return len(sizes) * sum(sizes) <= _LARGEST_MATRIX


def _product(rows: Float[AnyArray, "... N"], matrix: Float[np.ndarray, "s N"]) -> Float[AnyArray, "... s"]:
    return rows @ jnp.asarray(matrix.T) if rows.ndim != 2 else (jnp.asarray(matrix) @ rows.T).T


def _segmented(operation: Callable, rows: Float[AnyArray, "... N"], sizes: tuple[int, ...]) -> Float[AnyArray, "... s"]:
    by_pose, owner = jnp.moveaxis(rows, -1, 0), jnp.asarray(owner_of(sizes))
    return jnp.moveaxis(operation(by_pose, owner, num_segments=len(sizes), indices_are_sorted=True), 0, -1)


def counts(sizes: tuple[int, ...], rank: int) -> Float[np.ndarray, "... s"]:
    """The number of poses of each socket, for arrays of a rank."""
    return np.asarray(sizes, dtype=float).reshape((1,) * (rank - 1) + (-1,))


def largest_of_sockets(rows: Float[AnyArray, "... N"], sizes: tuple[int, ...]) -> Float[AnyArray, "... s"]:
    """The largest value of each socket's poses."""
    if namespace(rows) is np:
        return np.maximum.reduceat(rows, starts(sizes), axis=-1)
    return _segmented(jax.ops.segment_max, rows, sizes)


def to_poses(values: Float[AnyArray, "... s"], sizes: tuple[int, ...]) -> Float[AnyArray, "... N"]:
    """Each socket's value at each of its poses."""
    if namespace(values) is np:
        return np.repeat(values, sizes, axis=-1)
    if _is_small(sizes):
        return values @ jnp.asarray(membership(sizes))
    return values[..., owner_of(sizes)]


def owner_of(sizes: tuple[int, ...]) -> np.ndarray:
    """Index of the socket of each pose ``(N,)``."""
    return np.repeat(np.arange(len(sizes)), sizes)


def membership(sizes: tuple[int, ...]) -> Float[np.ndarray, "s N"]:
    """1 where a pose belongs to a socket."""
    return (owner_of(sizes)[None, :] == np.arange(len(sizes))[:, None]).astype(float)


def starts(sizes: tuple[int, ...]) -> np.ndarray:
    """Index of the first pose of each socket."""
    return np.concatenate([[0], np.cumsum(sizes)[:-1]])
