"""How uncertain an identification is: covariance of its parameters, of measured lengths, and of the scale (JCGM 100)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .parameters import Parameters
from .residuals import Measurement, measured_lengths, repeatability_model

# Standard deviation of a tip coordinate (mm) below which noise-free data would get infinite weight.
LEAST_SIGMA = 1e-9
# A direction whose standard uncertainty exceeds 10 mm or 10 mrad is not determined, whatever its eigenvalue.
_LEAST_INFORMATION = 1e-2


class Covariance(NamedTuple):
    """Covariance of the free parameters, and which of them are determined one by one."""

    matrix: Float[Array, "p p"]
    determined: Bool[Array, " p"]


def length_covariance(
    centroids: Float[Array, "s 3"],
    measurement: Measurement,
    sigma: Float[Array, ""],
    stretch: Float[Array, "..."] | float = 1.0,
) -> Float[Array, "l l"]:
    """Covariance of measured minus nominal lengths, mm^2, by an arm that is ``stretch`` times too large.

    Each length's own u, and the scatter of the poses over their number at each end. Lengths that share a socket share its
    scatter, so they are correlated.
    """
    between = measurement.differences @ centroids
    direction = between / jnp.linalg.norm(between, axis=-1, keepdims=True)
    pull = measurement.differences[:, :, None] * direction[:, None, :]  # how a length follows each socket's centroid
    share = jnp.asarray(1 / np.asarray(measurement.sizes, dtype=float))
    scatter = jnp.einsum("lsc,s,ksc->lk", pull, share, pull)
    # The floor (1e-12 mm) only keeps a noise-free simulation's weights finite.
    return jnp.diag((stretch * measurement.u) ** 2 + 1e-24) + sigma**2 * scatter


def of_parameters(
    space: Parameters,
    measurement: Measurement,
    parameters: Float[Array, " p"],
    fixed: Bool[Array, " p"],
    sigma: Float[Array, ""],
    whitening: Float[Array, "l l"] | None = None,
) -> Covariance:
    """Inverse of J^T W J on the identifiable subspace; rows of ``fixed`` parameters (held, or on a bound) are 0.

    Poses weigh by the variance ``sigma``^2 of a tip coordinate; reference lengths too, where ``whitening`` (the inverse
    Cholesky factor of their covariance) is given.
    """
    sigma = jnp.maximum(sigma, LEAST_SIGMA)
    information = repeatability_model(parameters, (space, measurement)).gram / sigma**2
    if whitening is not None:
        rows = whitening @ measured_lengths(parameters, space, measurement)[1]
        information = information + rows.T @ rows
    scale = jnp.where(fixed, 0.0, space.scale)
    scaled = scale[:, None] * information * scale[None, :]
    inverse = jnp.linalg.pinv(scaled, rtol=1e-12, hermitian=True)
    # Only a mask comes from the eigenvectors: their derivative is infinite where eigenvalues repeat.
    values, vectors = jnp.linalg.eigh(jax.lax.stop_gradient(scaled))
    known = values > jnp.maximum(1e-12 * values[-1], _LEAST_INFORMATION)
    determined = fixed | (jnp.sum(jnp.where(known[None, :], 0.0, vectors**2), axis=1) < 1e-6)
    return Covariance(scale[:, None] * inverse * scale[None, :], determined)


def after_division(
    stage1: Covariance,
    by_parameters: Float[Array, " p"],
    variance: Float[Array, ""],
    space: Parameters,
    divided: Float[Array, " p"],
    k: Float[Array, ""],
) -> Covariance:
    """Covariance after every length was divided by k, which itself depends on the parameters and on the lengths.

    x = y / k for lengths, so dx = dy / k - (x / k) dk, with dk = ``by_parameters`` . dy + what the lengths add
    (``variance``).
    """
    divides = jnp.asarray([name != "d_1" and bool(length) for name, length in zip(space.names, space.lengths, strict=True)])
    shift = jnp.where(divides, divided / k, 0.0)
    change = jnp.diag(jnp.where(divides, 1 / k, 1.0)) - shift[:, None] * by_parameters[None, :]
    matrix = change @ stage1.matrix @ change.T + variance * shift[:, None] * shift[None, :]
    return Covariance(matrix, stage1.determined)
