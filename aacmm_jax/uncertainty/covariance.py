"""Covariance of an identification: the law of propagation (JCGM 100) from readings and lengths to parameters.

An identification is linearised at its result. `Sensitivity` is how its parameters follow the error of each tip and of
each certified length; a noise model (`NOISE_MODELS`) is the covariance of those errors; the covariance of the
parameters is the product of both.
"""

import math
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..core.linear_algebra import inverse_positive_definite, semidefinite_eigen
from ..core.units import ARCSEC
from ..data.noise import Noise, encoder_covariances, tip_covariances
from ..kinematics.arm import Arm
from ..kinematics.parameters import Parameters
from ..model.measurement import Measurement, differences_matrix, length_directions
from ..model.residuals import measured_lengths
from ..model.weights import membership

# Models of the tips' errors. "given": encoders and seat as stated. "estimated": encoders and seat, both standard
# deviations estimated from the residuals. "common": one variance for every coordinate of every tip. "robust": each
# pose's own residual, corrected for its leverage (a jackknife), whatever the errors are, as long as poses are
# independent.
NoiseModel = Literal["given", "estimated", "common", "robust"]
NOISE_MODELS = ("given", "estimated", "common", "robust")

# A direction whose standard uncertainty exceeds 10 mm or 10 mrad is not determined, whatever its eigenvalue.
_LEAST_INFORMATION = 1e-2
_NULL = 1e-12  # eigenvalues of the information below this, of the largest, are zero
# Where a pose determines its own socket nearly alone, its residual carries no information: "robust" takes the common
# variance there.
_LEAST_REDUNDANCY = 0.05


class Sensitivity(NamedTuple):
    """Derivatives of an identification's parameters by the errors of its data; mm and rad."""

    tips: Float[Array, "p 3 N"]
    lengths: Float[Array, "p l"]


class ParameterCovariance(NamedTuple):
    """Covariance of the free parameters, and what the data leave open."""

    matrix: Float[Array, "p p"]
    determined: Bool[Array, " p"]  # one by one, and not only in combination with others
    open: Float[Array, "p p"]  # projector onto the directions that are not determined, in natural steps
    noise: Noise  # given, or as estimated: one encoder for all


class Linearisation(NamedTuple):
    """Derivatives of an identification at its result, in natural steps (1 mm, 1 mrad), 0 for fixed parameters."""

    scale: Float[Array, " p"]  # natural steps, 0 where fixed
    columns: Float[Array, "p 3 N"]  # of tips less their socket's mean
    counted: Float[Array, "p 3 N"]  # the same as the least squares counts them: whitened by weights
    lengths: Float[Array, "l p"]  # of measured lengths
    lengths_by_tips: Float[Array, "l 3 N"]
    centroid_weights: Float[Array, "3 3 N"]  # of a socket's mean by each of its tips
    residual: Float[Array, "3 N"]  # of tips from their socket's mean, mm


def linearised(arm: Arm, space: Parameters, measurement: Measurement, fixed: Bool[Array, " p"]) -> Linearisation:
    """The identification at an arm; ``fixed`` parameters are the scale anchor, or on a bound."""
    scale = jnp.where(fixed, 0.0, space.scale)
    tips = arm.position(measurement.q)
    jacobian = jnp.moveaxis(arm.jacobian(measurement.q, space.names), 0, -1)  # (3, p, N)
    columns = jnp.swapaxes(jacobian, 0, 1) * scale[:, None, None]
    members, weights, sizes = membership(measurement.sizes), measurement.weights, measurement.sizes
    if weights is None:
        means = columns @ jnp.asarray((members / np.asarray(sizes, dtype=float)[:, None]).T)
        counts = np.repeat(np.asarray(sizes, dtype=float), sizes)
        centroid_weights = jnp.asarray(np.eye(3)[:, :, None] / counts)
    else:
        means = weights.centroids(columns, sizes)
        covariance = weights.centroid_factor @ jnp.asarray(members)
        centroid_weights = jnp.einsum("abN,cbN,cdN->adN", covariance, weights.basis, weights.root)
    columns = columns - means @ jnp.asarray(members)
    if measurement.ends:
        by_parameters = (
            measured_lengths(space.vector(arm), Parameters(arm, space.names), measurement)[1] * scale[None, :]
        )
        ends = differences_matrix(measurement.ends, len(sizes)) @ members
        by_tips = jnp.einsum(
            "lN,lc,cdN->ldN", ends, length_directions(measurement.centroids(tips), measurement), centroid_weights
        )
    else:
        by_parameters, by_tips = jnp.zeros((0, len(space.names))), jnp.zeros((0, *columns.shape[1:]))
    counted = columns if weights is None else weights.whiten(columns)
    return Linearisation(scale, columns, counted, by_parameters, by_tips, centroid_weights, measurement.centred(tips).T)


def information_of(
    linear: Linearisation, sigma: Float[Array, ""], whitening: Float[Array, "l l"] | None = None
) -> Float[Array, "p p"]:
    """J^T W J in natural steps: of poses that scatter by ``sigma``, and with ``whitening`` of the lengths too."""
    rows = linear.counted.reshape(linear.counted.shape[0], -1)
    information = rows @ rows.T / sigma**2
    if whitening is None:
        return information
    lengths = whitening @ linear.lengths
    return information + lengths.T @ lengths


def sensitivity_of(
    linear: Linearisation,
    measurement: Measurement,
    inverse: Float[Array, "p p"],
    sigma: Float[Array, ""],
    whitening: Float[Array, "l l"] | None = None,
) -> Sensitivity:
    """Sensitivity coefficients of one least squares, given the inverse of its information; in natural steps."""
    weighted = linear.counted
    if measurement.weights is not None:
        # Columns are centred under the weights, so a tip's own shift of the mean meets sums that are zero.
        weighted = jnp.einsum("abN,paN->pbN", measurement.weights.root, linear.counted)
    by_tips = -jnp.einsum("pq,qaN->paN", inverse, weighted) / sigma**2
    if whitening is None:
        return Sensitivity(by_tips, jnp.zeros((len(inverse), linear.lengths.shape[0])))
    by_lengths = inverse @ linear.lengths.T @ whitening.T @ whitening
    return Sensitivity(by_tips - jnp.einsum("pl,lcN->pcN", by_lengths, linear.lengths_by_tips), by_lengths)


def inverse_information(
    information: Float[Array, "p p"], fixed: Bool[Array, " p"]
) -> tuple[Float[Array, "p p"], Float[Array, "p p"], Bool[Array, " p"]]:
    """Inverse on the identifiable subspace, the projector onto the undetermined directions, and which parameters are
    determined one by one; natural steps. A poorly determined direction keeps its large variance, which does not affect
    the others.
    """
    free = ~fixed
    information = information + jnp.diag(jnp.where(fixed, 1.0 + jnp.max(jnp.abs(information)), 0.0))
    # Only masks and a basis come from the eigenvectors: their derivative is infinite where eigenvalues repeat.
    values, vectors = semidefinite_eigen(information)
    known = values > _NULL * values[0]
    seen, lost = jnp.where(known[None, :], vectors, 0.0), jnp.where(known[None, :], 0.0, vectors)
    inner = seen.T @ information @ seen + jnp.diag(jnp.where(known, 0.0, 1.0))
    inverse = seen @ inverse_positive_definite(inner) @ seen.T
    hardly = jnp.where((values > _LEAST_INFORMATION)[None, :] & known[None, :], 0.0, vectors)
    determined = fixed | (jnp.sum(hardly**2, axis=1) < 1e-6)
    return jnp.where(free[:, None] & free[None, :], inverse, 0.0), lost @ lost.T, determined


def covariance_of(
    sensitivity: Sensitivity,
    linear: Linearisation,
    measurement: Measurement,
    errors: Float[Array, "3 3 N"],
) -> Float[Array, "p p"]:
    """Covariance of the parameters, natural steps, from the covariance of every tip's error and the lengths' u."""
    moved = jnp.einsum("paN,abN->pbN", sensitivity.tips, errors)
    by_lengths = sensitivity.lengths * measurement.u[None, :]
    moved, straight = moved.reshape(len(moved), -1), sensitivity.tips.reshape(len(moved), -1)
    return moved @ straight.T + by_lengths @ by_lengths.T


def residual_degrees_of_freedom(noise_model: NoiseModel, sizes: tuple[int, ...], fitted: int) -> float:
    """Degrees of freedom of a noise model: of all equations, or of poses where each has a variance of its own."""
    if noise_model == "given":
        return math.inf
    spare = sum(sizes) - len(sizes) - fitted / 3
    return max(spare if noise_model == "robust" else 3 * spare, 1.0)


def tip_errors(
    noise_model: NoiseModel,
    arm: Arm,
    measurement: Measurement,
    linear: Linearisation,
    sensitivity: Sensitivity,
    inverse: Float[Array, "p p"],
    sigma: Float[Array, ""],
    noise: Noise | None,
) -> tuple[Float[Array, "3 3 N"], Noise]:
    """Covariance of every tip's error by a noise model, mm^2, and the noise it stands for (see `NOISE_MODELS`)."""
    common = sigma**2 * jnp.asarray(np.broadcast_to(np.eye(3)[:, :, None], (3, 3, measurement.q.shape[0])))
    geometry = arm.geometry
    if noise_model == "given":
        assert noise is not None
        return tip_covariances(geometry, measurement.sines_cosines, noise), noise
    if noise_model == "estimated":
        unit = encoder_covariances(geometry, measurement.sines_cosines, jnp.asarray(ARCSEC))
        arcsec2, seat2 = _components(linear, measurement, unit, sigma, inverse)
        found = Noise(encoder_arcsec=_root(arcsec2), seating=_root(seat2))
        return arcsec2 * unit + seat2 * jnp.asarray(np.eye(3)[:, :, None]), found
    as_seat = Noise(seating=sigma) if noise is None else noise
    if noise_model == "common":
        if noise is None:
            return common, as_seat
        return sigma**2 * tip_covariances(geometry, measurement.sines_cosines, noise), Noise(
            encoder_arcsec=sigma * noise.encoder_arcsec, seating=sigma * noise.seating
        )
    redundancy = (
        jnp.eye(3)[:, :, None] - linear.centroid_weights + jnp.einsum("paN,pbN->abN", linear.columns, sensitivity.tips)
    )
    # The residual of the pose if it had been left out: redundancy^-1 r, by Cramer's rule.
    cofactors = jnp.stack([jnp.cross(redundancy[(i + 1) % 3], redundancy[(i + 2) % 3], axis=0) for i in range(3)])
    determinant = jnp.sum(redundancy[0] * cofactors[0], axis=0)
    enough = determinant > _LEAST_REDUNDANCY
    alone = jnp.einsum("ibN,iN->bN", cofactors, linear.residual) / jnp.where(enough, determinant, 1.0)[None]
    return jnp.where(enough[None, None], alone[:, None, :] * alone[None, :, :], common), as_seat


def _components(
    linear: Linearisation,
    measurement: Measurement,
    unit: Float[Array, "3 3 N"],
    sigma: Float[Array, ""],
    inverse: Float[Array, "p p"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Variances of the encoders (arcsec^2) and of the seat (mm^2), from two moments of the residuals.

    Residuals are r = M e, M a projector: the identity less the sockets' means less the fit. With D the encoders' part
    for 1 arcsec, E[r.r] = v tr(MD) + s tr(M) and E[r.Dr] = v tr(MDMD) + s tr(MD); a negative one is set to 0 and the
    other taken from the first (variance components by the method of moments, Henderson 1953).
    """
    sizes = np.asarray(measurement.sizes, dtype=float)
    members = jnp.asarray(membership(measurement.sizes))
    columns, r = linear.columns, linear.residual
    rows = columns.reshape(columns.shape[0], -1)
    inverse = inverse / sigma**2  # of the fit as it counts residuals in mm
    seen = jnp.einsum("abN,pbN->paN", unit, columns)
    once = seen.reshape(rows.shape) @ rows.T  # J^T D J
    twice = jnp.einsum("paN,qaN->pq", seen, seen)
    mean = unit @ (members / jnp.asarray(sizes)[:, None]).T  # of D over each socket
    mean2 = jnp.einsum("abN,bcN->acN", unit, unit) @ (members / jnp.asarray(sizes)[:, None]).T
    crossed = (seen @ (members / jnp.sqrt(jnp.asarray(sizes))[:, None]).T).reshape(rows.shape[0], -1)
    free = 3 * jnp.asarray(sizes - 1).sum() - jnp.sum(inverse * (rows @ rows.T))
    md = _trace(unit) - _trace(mean) - jnp.sum(inverse * once)
    mdmd = (
        jnp.sum(unit**2)
        - 2 * (_trace(mean2) + jnp.sum(inverse * twice))
        + jnp.sum(mean**2)
        + 2 * jnp.sum(inverse * (crossed @ crossed.T))
        + jnp.sum((inverse @ once) * (inverse @ once).T)
    )
    plain, turned = jnp.sum(r**2), jnp.einsum("aN,abN,bN->", r, unit, r)
    determinant = md * md - free * mdmd  # negative, or 0 where the two cannot be told apart
    apart = determinant < -1e-9 * md * md
    safe = jnp.where(apart, determinant, 1.0)
    encoder, seat = (plain * md - free * turned) / safe, (md * turned - mdmd * plain) / safe
    alone = plain / jnp.maximum(md, 1e-300)
    everything = sigma**2
    encoder, seat = (
        jnp.where(apart & (encoder > 0), jnp.where(seat > 0, encoder, alone), 0.0),
        jnp.where(apart & (encoder > 0), jnp.maximum(seat, 0.0), everything),
    )
    return encoder, seat


def _root(value: Float[Array, ""]) -> Float[Array, ""]:
    # The square root has no derivative at 0, the value of a variance whose estimate is negative.
    return jnp.where(value > 0, jnp.sqrt(jnp.where(value > 0, value, 1.0)), 0.0)


def _trace(matrices: Float[Array, "3 3 k"]) -> Float[Array, ""]:
    return jnp.einsum("aak->", matrices)
