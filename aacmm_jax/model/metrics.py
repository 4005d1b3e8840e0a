"""Repeatability of tip positions: how far the poses of one socket disagree (DE, Deltam, RMS)."""

from collections.abc import Sequence
from typing import Annotated

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from ..core.arguments import ANY_NUMBER, Count, checked_arguments
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, namespace
from .socket_sums import largest_of_sockets, means_over_sockets, to_poses

_OUTLIER = 8.0  # median distances; see `pose_outliers`
_LEAST_DISTANCE = 1e-6  # mm: below it distances are rounding


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
        >>> found = aj.model.repeatability(result.arm.position(two_bars.q), two_bars.sizes)
        >>> print(f"DE {found.de:.4f} mm, Deltam {found.deltam:.4f} mm")
        DE 0.0127 mm, Deltam 0.0199 mm
    """
    sizes = tuple(sizes)
    if not sizes or tips.shape[0] != sum(sizes):
        raise InputError(f"tips has shape {tips.shape}, but sizes add up to {sum(sizes)}; give ({sum(sizes)}, 3).")
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
