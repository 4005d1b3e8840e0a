"""Sums over the poses of each socket, and back: poses are kept socket after socket, along the last axis."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.namespace import AnyArray, namespace

# JAX multiplies by a matrix of (sockets, poses) up to this size, which suits batches of few sockets; larger problems
# take a segmented sum, which needs no memory beyond its result.
_LARGEST_MATRIX = 1_000_000


def sums_over_sockets(rows: Float[AnyArray, "... N"], sizes: tuple[int, ...]) -> Float[AnyArray, "... s"]:
    """The sum of each socket's poses."""
    if namespace(rows) is np:
        return np.add.reduceat(rows, _starts(sizes), axis=-1)
    if len(sizes) * sum(sizes) <= _LARGEST_MATRIX:
        return rows @ jnp.asarray(membership(sizes).T)
    summed = jax.ops.segment_sum(
        jnp.moveaxis(rows, -1, 0), jnp.asarray(owner_of(sizes)), num_segments=len(sizes), indices_are_sorted=True
    )
    return jnp.moveaxis(summed, 0, -1)


def means_over_sockets(rows: Float[AnyArray, "... N"], sizes: tuple[int, ...]) -> Float[AnyArray, "... s"]:
    """The mean of each socket's poses."""
    return sums_over_sockets(rows, sizes) / counts(sizes, rows.ndim)


def counts(sizes: tuple[int, ...], rank: int) -> Float[np.ndarray, "... s"]:
    """The number of poses of each socket, for arrays of a rank."""
    return np.asarray(sizes, dtype=float).reshape((1,) * (rank - 1) + (-1,))


def largest_of_sockets(rows: Float[AnyArray, "... N"], sizes: tuple[int, ...]) -> Float[AnyArray, "... s"]:
    """The largest value of each socket's poses."""
    if namespace(rows) is np:
        return np.maximum.reduceat(rows, _starts(sizes), axis=-1)
    largest = jax.ops.segment_max(
        jnp.moveaxis(rows, -1, 0), jnp.asarray(owner_of(sizes)), num_segments=len(sizes), indices_are_sorted=True
    )
    return jnp.moveaxis(largest, 0, -1)


def to_poses(values: Float[AnyArray, "... s"], sizes: tuple[int, ...]) -> Float[AnyArray, "... N"]:
    """Each socket's value at each of its poses."""
    if namespace(values) is np:
        return np.repeat(values, sizes, axis=-1)
    if len(sizes) * sum(sizes) <= _LARGEST_MATRIX:
        return values @ jnp.asarray(membership(sizes))
    return values[..., owner_of(sizes)]


def owner_of(sizes: tuple[int, ...]) -> np.ndarray:
    """Index of the socket of each pose ``(N,)``."""
    return np.repeat(np.arange(len(sizes)), sizes)


def membership(sizes: tuple[int, ...]) -> Float[np.ndarray, "s N"]:
    """1 where a pose belongs to a socket."""
    return (owner_of(sizes)[None, :] == np.arange(len(sizes))[:, None]).astype(float)


def _starts(sizes: tuple[int, ...]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(sizes)[:-1]])
