"""Sums over the poses of each socket, and how far these poses disagree (DE, Deltam, RMS).

Poses are kept socket after socket, along the last axis.
"""

from collections.abc import Callable, Sequence
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..core.arguments import ANY_NUMBER, Count, checked_arguments
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, added_to, namespace

_OUTLIER = 8.0  # median distances; see `pose_outliers`
_LEAST_DISTANCE = 1e-6  # mm: below it distances are rounding
# JAX multiplies by a matrix of (sockets, poses) up to this size, which suits batches of few sockets: the product is not
# fused with what surrounds it, so that a trial of a study has the same bits in every block. Larger problems take a
# segmented sum, which needs no memory beyond its result.
_LARGEST_MATRIX = 1_000_000


def sums_over_sockets(rows: Float[AnyArray, "... N"], sizes: tuple[int, ...]) -> Float[AnyArray, "... s"]:
    """The sum of each socket's poses; 0 where it has none."""
    if 0 in sizes:
        sums = sums_over_sockets(rows, tuple(size for size in sizes if size))
        whole = namespace(rows).zeros((*rows.shape[:-1], len(sizes)))
        return added_to(whole, (..., np.flatnonzero(sizes)), sums)
    if namespace(rows) is np:
        return np.add.reduceat(rows, starts(sizes), axis=-1)
    return _product(rows, membership(sizes)) if _is_small(sizes) else _segmented(jax.ops.segment_sum, rows, sizes)


def means_over_sockets(rows: Float[AnyArray, "... N"], sizes: tuple[int, ...]) -> Float[AnyArray, "... s"]:
    """The mean of each socket's poses."""
    if namespace(rows) is jnp and _is_small(sizes):
        return _product(rows, membership(sizes) / np.asarray(sizes, dtype=float)[:, None])
    return sums_over_sockets(rows, sizes) / counts(sizes, rows.ndim)


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


def owner_of(sizes: tuple[int, ...]) -> np.ndarray:
    """Index of the socket of each pose ``(N,)``."""
    return np.repeat(np.arange(len(sizes)), sizes)


def membership(sizes: tuple[int, ...]) -> Float[np.ndarray, "s N"]:
    """1 where a pose belongs to a socket."""
    return (owner_of(sizes)[None, :] == np.arange(len(sizes))[:, None]).astype(float)


def starts(sizes: tuple[int, ...]) -> np.ndarray:
    """Index of the first pose of each socket."""
    return np.concatenate([[0], np.cumsum(sizes)[:-1]])


class Repeatability(eqx.Module):
    """How well the poses of a capture agree, over all sockets and socket by socket; mm.

    Example:
        >>> after = result.after
        >>> print(f"DE {after.de:.4f} mm; by socket", after.socket_de.round(4), "mm")
        DE 0.0124 mm; by socket [0.0125 0.012 ] mm
    """

    # DE (Cheng et al. 2018, eq. 13-15): mean distance from the own socket's centroid, over the poses of all sockets.
    de: Float[AnyArray, ""]
    # Deltam (eq. 11-12): largest over axes, and sockets, of (max - min) / 2.
    deltam: Float[AnyArray, ""]
    rms: Float[AnyArray, ""]  # root mean square distance from the own socket's centroid
    socket_de: Float[AnyArray, " s"]
    socket_deltam: Float[AnyArray, " s"]
    socket_rms: Float[AnyArray, " s"]
    centroids: Float[AnyArray, "s 3"]
    # Standard deviation of one coordinate of one tip, pooled over sockets with 3 (m - 1) degrees of freedom each, less
    # the number of fitted parameters.
    sigma: Float[AnyArray, ""]


@checked_arguments
def repeatability(
    tips: Annotated[Float[AnyArray, "N 3"], ANY_NUMBER], sizes: Sequence[Count], *, fitted: int = 0
) -> Repeatability:
    """Repeatability of tips, socket after socket.

    DE of several sockets is the mean over all poses of sockets with at least two; Deltam is the largest of all sockets.

    Args:
        tips: positions ``(N, 3)``, mm.
        sizes: number of tips of each socket, in their order.
        fitted: number of parameters fitted to them, subtracted from the degrees of freedom of ``sigma``.

    Returns:
        Metrics over all sockets and socket by socket, mm; NaN where no socket has two poses.

    Raises:
        InputError: Sizes and tips do not fit, or sizes are traced.

    Example:
        >>> metrics = aj.model.repeatability(result.arm.position(two_bars.q), two_bars.sizes)
        >>> print(f"DE {metrics.de:.4f} mm, Deltam {metrics.deltam:.4f} mm")
        DE 0.0127 mm, Deltam 0.0199 mm
    """
    sizes = tuple(sizes)
    if not sizes or tips.shape[0] != sum(sizes):
        raise InputError(
            f"tips has shape {tips.shape}, but sizes add up to {sum(sizes)}; give tips of shape ({sum(sizes)}, 3)."
        )
    counts, rows, xp = np.asarray(sizes), tips.T, namespace(tips)
    centroids = means_over_sockets(rows, sizes)
    squared = xp.sum((rows - to_poses(centroids, sizes)) ** 2, axis=0)
    distances = _root(squared)
    half_range = xp.max(largest_of_sockets(rows, sizes) + largest_of_sockets(-rows, sizes), axis=0) / 2
    # One pose in every socket shows no scatter: 0 / 0, which is NaN and not a perfect 0.
    scattering = int(counts[counts > 1].sum())
    degrees_of_freedom = max(3 * int((counts - 1).sum()) - fitted, min(scattering, 1))
    return Repeatability(
        de=_over(xp.sum(distances), scattering),
        deltam=xp.max(half_range),
        rms=_root(_over(xp.sum(squared), scattering)),
        socket_de=means_over_sockets(distances, sizes),
        socket_deltam=half_range,
        socket_rms=_root(means_over_sockets(squared, sizes)),
        centroids=centroids.T,
        sigma=_root(_over(xp.sum(squared), degrees_of_freedom)),
    )


def no_repeatability(sigma: Float[AnyArray, ""]) -> Repeatability:
    """Of a capture without sockets: NaN, but for the standard deviation of a tip coordinate, mm."""
    xp = namespace(sigma)
    none, empty = xp.asarray(np.nan), xp.zeros(0)
    return Repeatability(none, none, none, empty, empty, empty, xp.zeros((0, 3)), sigma)


def pose_outliers(
    distances: Float[np.ndarray, " N"], sizes: Sequence[int]
) -> tuple[Int[np.ndarray, " outliers"], float]:
    """Poses so far from their socket's centroid that the tip was hardly seated: over eight times the median distance.

    Eight, because normal errors that lie along one direction exceed four medians in 0.7 % of all poses, eight in 7e-8,
    and the poses of real arms, whose errors outside the D-H model differ over the workspace, reach 7.9 (the 1,443 poses
    of ``examples/mukca``). The only pose of a socket shows no scatter and is not counted.

    Args:
        distances: of every tip from its socket's centroid, socket after socket, mm.
        sizes: number of poses of each socket.

    Returns:
        Indices of the outliers, and the median distance, mm (0 where no socket has two poses).

    Example:
        >>> distances = np.array([0.011, 0.009, 0.012, 0.010, 0.140])
        >>> indices, median = aj.model.pose_outliers(distances, [5])
        >>> print(indices, median, "mm")
        [4] 0.011 mm
    """
    counted = np.repeat(np.asarray(sizes) > 1, sizes)
    median = float(np.median(distances[counted])) if counted.any() else 0.0
    far = counted & (distances > _OUTLIER * median) & (median > _LEAST_DISTANCE)
    return np.flatnonzero(far), median


def _over(total: Float[AnyArray, ""], count: int) -> Float[AnyArray, ""]:
    return total / count if count else np.nan * total


def _root(value: Float[AnyArray, "..."]) -> Float[AnyArray, "..."]:
    # sqrt has no derivative at 0, the distance of a single pose from its centroid; there the derivative is set to 0.
    zero, xp = value == 0, namespace(value)
    return xp.where(zero, 0.0, xp.sqrt(xp.where(zero, 1.0, value)))
