"""Repeatability of tip positions: how far the poses of one socket disagree (DE, Deltam, RMS)."""

from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Repeatability(eqx.Module):
    """How well the poses of a capture agree, over all sockets and socket by socket; mm."""

    # DE (Cheng et al. 2018, eq. 13-15): mean distance from the own socket's centroid, over the poses of all sockets.
    de: Float[Array, ""]
    # Deltam (eq. 11-12): largest over axes, and sockets, of (max - min) / 2.
    deltam: Float[Array, ""]
    rms: Float[Array, ""]  # root mean square distance from the own socket's centroid
    socket_de: Float[Array, " s"]
    socket_deltam: Float[Array, " s"]
    socket_rms: Float[Array, " s"]
    centroids: Float[Array, "s 3"]
    # Standard deviation of one coordinate of one tip, pooled over sockets with 3 (m - 1) degrees of freedom each, less
    # the number of fitted parameters.
    sigma: Float[Array, ""]


def repeatability(tips: Float[Array, "N 3"], sizes: Sequence[int], *, fitted: int = 0) -> Repeatability:
    """Repeatability of tips, socket after socket.

    DE of several sockets is the mean over all poses of sockets with at least two; Deltam is the largest of all sockets.

    Args:
        tips: positions ``(N, 3)``, mm.
        sizes: number of tips of each socket, in their order.
        fitted: number of parameters fitted to them, subtracted from the degrees of freedom of ``sigma``.

    Returns:
        Metrics over all sockets and socket by socket, mm; NaN where no socket has two poses.
    """
    counts = np.asarray(sizes)
    owner = jnp.asarray(np.repeat(np.arange(len(counts)), counts))
    total = partial(jax.ops.segment_sum, segment_ids=owner, num_segments=len(counts), indices_are_sorted=True)
    highest = partial(jax.ops.segment_max, segment_ids=owner, num_segments=len(counts), indices_are_sorted=True)
    centroids = total(tips) / jnp.asarray(counts, dtype=tips.dtype)[:, None]
    squared = jnp.sum((tips - centroids[owner]) ** 2, axis=-1)
    distances = _root(squared)
    half_range = jnp.max(highest(tips) + highest(-tips), axis=-1) / 2
    # One pose in every socket shows no scatter: 0 / 0, which is NaN and not a perfect 0.
    scattering = int(counts[counts > 1].sum())
    degrees_of_freedom = max(3 * int((counts - 1).sum()) - fitted, min(scattering, 1))
    return Repeatability(
        de=_over(jnp.sum(distances), scattering),
        deltam=jnp.max(half_range),
        rms=_root(_over(jnp.sum(squared), scattering)),
        socket_de=total(distances) / jnp.asarray(counts, dtype=tips.dtype),
        socket_deltam=half_range,
        socket_rms=_root(total(squared) / jnp.asarray(counts, dtype=tips.dtype)),
        centroids=centroids,
        sigma=_root(_over(jnp.sum(squared), degrees_of_freedom)),
    )


def _over(total: Float[Array, ""], count: int) -> Float[Array, ""]:
    return total / count if count else jnp.full_like(total, jnp.nan)


def _root(value: Float[Array, "..."]) -> Float[Array, "..."]:
    # sqrt has no derivative at 0, the distance of a single pose from its centroid; there the derivative is set to 0.
    zero = value == 0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, value)))
