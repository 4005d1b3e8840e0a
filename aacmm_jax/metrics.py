"""Repeatability figures of tip positions: how far the poses of one socket disagree."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def mean_error_distance(tips: Float[Array, "m 3"]) -> Float[Array, ""]:
    """DE of one socket, mm: mean over poses of the distance from the centroid (Cheng et al. 2018, eq. 13-15)."""
    return jnp.mean(_distances(tips))


def largest_half_range(tips: Float[Array, "m 3"]) -> Float[Array, ""]:
    """Deltam of one socket, mm: largest over the axes of (max - min) / 2 (Cheng et al. 2018, eq. 11-12)."""
    return jnp.max(jnp.max(tips, axis=0) - jnp.min(tips, axis=0)) / 2


def _distances(tips: Float[Array, "m 3"]) -> Float[Array, " m"]:
    squared = jnp.sum((tips - jnp.mean(tips, axis=0, keepdims=True)) ** 2, axis=-1)
    # sqrt has no derivative at 0, which a socket of one pose meets exactly; its distance there is 0 and so is the slope.
    positive = squared > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)


class Repeatability(eqx.Module):
    """How well the poses of a capture agree, over all sockets and socket by socket; mm."""

    de: Float[Array, ""]  # mean distance from the own socket's centroid, over the poses of all sockets
    deltam: Float[Array, ""]  # largest Deltam of any socket
    rms: Float[Array, ""]  # root mean square distance from the own socket's centroid
    socket_de: Float[Array, " s"]
    socket_deltam: Float[Array, " s"]
    socket_rms: Float[Array, " s"]
    centroids: Float[Array, "s 3"]
    # Standard deviation of one coordinate of one tip, pooled over sockets with 3 (m - 1) degrees of freedom each, less
    # the number of fitted parameters.
    sigma: Float[Array, ""]


def repeatability(tips: Float[Array, "N 3"], sizes: Sequence[int], *, fitted: int = 0) -> Repeatability:
    """Figures of tips that lie socket after socket, ``sizes[i]`` of them in socket i.

    DE of several sockets is the mean over all poses of sockets with at least two (a single pose has no spread to show);
    Deltam is the worst socket's. ``fitted`` parameters are taken off the degrees of freedom of ``sigma``.
    """
    blocks = jnp.split(tips, np.cumsum(np.asarray(sizes))[:-1].tolist(), axis=0)
    distances = [_distances(block) for block in blocks]
    spread = [d for d, size in zip(distances, sizes, strict=True) if size > 1] or distances
    everything = jnp.concatenate(spread)
    freedom = max(3 * sum(size - 1 for size in sizes) - fitted, 1)
    squares = jnp.sum(everything**2)
    return Repeatability(
        de=jnp.mean(everything),
        deltam=jnp.max(jnp.stack([largest_half_range(block) for block in blocks])),
        rms=_root(squares / everything.shape[0]),
        socket_de=jnp.stack([jnp.mean(d) for d in distances]),
        socket_deltam=jnp.stack([largest_half_range(block) for block in blocks]),
        socket_rms=jnp.stack([_root(jnp.mean(d**2)) for d in distances]),
        centroids=jnp.stack([jnp.mean(block, axis=0) for block in blocks]),
        sigma=_root(squares / freedom),
    )


def _root(value: Float[Array, ""]) -> Float[Array, ""]:
    positive = value > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, value, 1.0)), 0.0)
