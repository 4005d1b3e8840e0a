"""Covariance of an identification: the law of propagation (JCGM 100) from readings and lengths to parameters.

An identification is linearised at its result. `Sensitivity` is how its parameters follow the error of each tip and of
each certified length; a noise model (`NOISE_MODELS`) is the covariance of those errors; the covariance of the
parameters is the product of both.
"""

import math
from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..core.linear_algebra import inverse_positive_definite, semidefinite_eigen
from ..core.numpy_or_jax import AnyArray, namespace
from ..core.units import ARCSEC
from ..data.noise import Noise, encoder_covariances, noise_of, one_arcsec, tip_covariances
from ..kinematics.arm import Arm
from ..kinematics.parameters import Parameters
from ..model.measurement import Measurement, between_ends, length_directions
from ..model.residuals import measured_lengths
from ..model.socket_sums import counts, means_over_sockets, sums_over_sockets, to_poses
from .degrees_of_freedom import Components

# Models of the tips' errors. "given": encoders and seat as stated. "estimated": encoders and seat, both standard
# deviations estimated from the residuals. "common": one variance for every coordinate of every tip. "robust": each
# pose's own residual, corrected for its leverage (a jackknife), whatever the errors are, as long as poses are
# independent.
NoiseModel = Literal["given", "estimated", "common", "robust"]
NOISE_MODELS = ("given", "estimated", "common", "robust")

# Parts of a covariance: what certificates and instruments state, and the disagreement of the lengths beyond that.
STATED, DISAGREEMENT = "stated", "disagreement of lengths"
# A direction whose standard uncertainty exceeds 10 mm or 10 mrad is not determined, whatever its eigenvalue.
_LEAST_INFORMATION = 1e-2
_NULL = 1e-12  # eigenvalues of the information below this, of the largest, are zero
# Where a pose determines its own socket nearly alone, its residual carries no information: "robust" takes the common
# variance there.
_LEAST_REDUNDANCY = 0.05


class Sensitivity(NamedTuple):
    """Derivatives of an identification's parameters by the errors of its data; mm and rad."""

    tips: Float[AnyArray, "p 3 N"]
    lengths: Float[AnyArray, "p l"]


class ParameterCovariance(NamedTuple):
    """Covariance of the free parameters, and what the data leave open."""

    matrix: Float[AnyArray, "p p"]
    determined: Bool[AnyArray, " p"]  # one by one, and not only in combination with others
    open: Float[AnyArray, "p p"]  # projector onto the directions that are not determined, in natural steps
    noise: Noise  # given, or as estimated: one encoder for all
    # Its parts that do not rest on the scatter of single poses; None: there is none.
    components: Components | None = None

    def without(self, name: str) -> "ParameterCovariance":
        """Less one of its parts."""
        if self.components is None or name not in self.components.names:
            return self
        part = self.components.matrices[self.components.names.index(name)]
        return self._replace(matrix=self.matrix - part, components=self.components.without(name))


class Linearisation(NamedTuple):
    """Derivatives of an identification at its result, in natural steps (1 mm, 1 mrad), 0 for fixed parameters."""

    scale: Float[AnyArray, " p"]  # natural steps, 0 where fixed
    columns: Float[AnyArray, "p 3 N"]  # of tips less their socket's mean
    counted: Float[AnyArray, "p 3 N"]  # the same as the least squares counts them: whitened by weights
    lengths: Float[AnyArray, "l p"]  # of measured lengths
    lengths_by_tips: Float[AnyArray, "l 3 N"]
    centroid_weights: Float[AnyArray, "3 3 N"]  # of a socket's mean by each of its tips
    residual: Float[AnyArray, "3 N"]  # of tips from their socket's mean, mm


def linearised(arm: Arm, space: Parameters, measurement: Measurement, fixed: Bool[AnyArray, " p"]) -> Linearisation:
    """The identification at an arm; ``fixed`` parameters are the scale anchor, or on a bound."""
    xp = namespace(arm, space, measurement, fixed)
    scale = xp.where(fixed, 0.0, space.scale)
    tips = arm.position(measurement.q)
    jacobian = xp.moveaxis(arm.jacobian(measurement.q, space.names), 0, -1)  # (3, p, N)
    columns = xp.swapaxes(jacobian, 0, 1) * scale[:, None, None]
    weights, sizes = measurement.weights, measurement.sizes
    if weights is None:
        means = means_over_sockets(columns, sizes)
        centroid_weights = xp.asarray(np.eye(3)[:, :, None] / to_poses(counts(sizes, 1), sizes))
    else:
        means = weights.centroids(columns, sizes)
        covariance = to_poses(weights.centroid_factor, sizes)
        centroid_weights = xp.einsum("abN,cbN,cdN->adN", covariance, weights.basis, weights.root)
    columns = columns - to_poses(means, sizes)
    if measurement.ends:
        by_parameters = (
            measured_lengths(space.vector(arm), Parameters(arm, space.names), measurement)[1] * scale[None, :]
        )
        ends = xp.asarray(to_poses(between_ends(np.eye(len(sizes)), measurement.ends).T, sizes))
        directions = length_directions(measurement.centroids(tips), measurement)
        by_tips = ends[:, None, :] * xp.einsum("lc,cdN->ldN", directions, centroid_weights)
    else:
        by_parameters, by_tips = xp.zeros((0, len(space.names))), xp.zeros((0, *columns.shape[1:]))
    counted = columns if weights is None else weights.whiten(columns)
    return Linearisation(scale, columns, counted, by_parameters, by_tips, centroid_weights, measurement.centred(tips).T)


def information_of(
    linear: Linearisation, sigma: Float[AnyArray, ""], whitening: Float[AnyArray, "l l"] | None = None
) -> Float[AnyArray, "p p"]:
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
    inverse: Float[AnyArray, "p p"],
    sigma: Float[AnyArray, ""],
    whitening: Float[AnyArray, "l l"] | None = None,
) -> Sensitivity:
    """Sensitivity coefficients of one least squares, given the inverse of its information; in natural steps."""
    xp = namespace(linear, measurement, inverse, sigma, whitening)
    weighted = linear.counted
    if measurement.weights is not None:
        # Columns are centred under the weights, so a tip's own shift of the mean meets sums that are zero.
        weighted = xp.einsum("abN,paN->pbN", measurement.weights.root, linear.counted)
    by_tips = -xp.einsum("pq,qaN->paN", inverse, weighted) / sigma**2
    if whitening is None:
        return Sensitivity(by_tips, xp.zeros((len(inverse), linear.lengths.shape[0])))
    by_lengths = inverse @ linear.lengths.T @ whitening.T @ whitening
    return Sensitivity(by_tips - xp.einsum("pl,lcN->pcN", by_lengths, linear.lengths_by_tips), by_lengths)


def inverse_information(
    information: Float[AnyArray, "p p"], fixed: Bool[AnyArray, " p"]
) -> tuple[Float[AnyArray, "p p"], Float[AnyArray, "p p"], Bool[AnyArray, " p"]]:
    """Inverse on the identifiable subspace, the projector onto the undetermined directions, and which parameters are
    determined one by one; natural steps. A poorly determined direction keeps its large variance, which does not affect
    the others.
    """
    xp = namespace(information, fixed)
    free = ~fixed
    information = information + xp.diag(xp.where(fixed, 1.0 + xp.max(xp.abs(information)), 0.0))
    # Only masks and a basis come from the eigenvectors: their derivative is infinite where eigenvalues repeat.
    values, vectors = semidefinite_eigen(information)
    known = values > _NULL * values[0]
    seen, lost = xp.where(known[None, :], vectors, 0.0), xp.where(known[None, :], 0.0, vectors)
    inner = seen.T @ information @ seen + xp.diag(xp.where(known, 0.0, 1.0))
    inverse = seen @ inverse_positive_definite(inner) @ seen.T
    hardly = xp.where((values > _LEAST_INFORMATION)[None, :] & known[None, :], 0.0, vectors)
    determined = fixed | (xp.sum(hardly**2, axis=1) < 1e-6)
    return xp.where(free[:, None] & free[None, :], inverse, 0.0), lost @ lost.T, determined


def covariance_of(
    sensitivity: Sensitivity,
    linear: Linearisation,
    measurement: Measurement,
    errors: Float[AnyArray, "3 3 N"],
) -> Float[AnyArray, "p p"]:
    """Covariance of the parameters, natural steps, from the covariance of every tip's error and the lengths' u."""
    xp = namespace(sensitivity, linear, measurement, errors)
    moved = xp.einsum("paN,abN->pbN", sensitivity.tips, errors)
    moved, straight = moved.reshape(len(moved), -1), sensitivity.tips.reshape(len(moved), -1)
    return moved @ straight.T + by_lengths(sensitivity, measurement)


def by_lengths(sensitivity: Sensitivity, measurement: Measurement) -> Float[AnyArray, "p p"]:
    """The part of it by the lengths' u."""
    moved = sensitivity.lengths * measurement.u[None, :]
    return moved @ moved.T


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
    inverse: Float[AnyArray, "p p"],
    sigma: Float[AnyArray, ""],
    noise: Noise | None,
) -> tuple[Float[AnyArray, "3 3 N"], Noise]:
    """Covariance of every tip's error by a noise model, mm^2, and the noise it stands for (see `NOISE_MODELS`)."""
    xp = namespace(noise_model, arm, measurement, linear, sensitivity, inverse, sigma, noise)
    common = sigma**2 * xp.asarray(np.broadcast_to(np.eye(3)[:, :, None], (3, 3, measurement.q.shape[0])))
    geometry = arm.geometry
    if noise_model == "given":
        assert noise is not None
        return tip_covariances(geometry, measurement.motion, noise), noise
    if noise_model == "estimated":
        unit = encoder_covariances(geometry, measurement.motion, xp.asarray(one_arcsec(geometry.kinds)))
        arcsec2, seat2 = _components(linear, measurement, unit, sigma, inverse)
        found = noise_of(ARCSEC * _root(arcsec2), _root(seat2))
        return arcsec2 * unit + seat2 * xp.asarray(np.eye(3)[:, :, None]), found
    as_seat = noise_of(xp.zeros_like(sigma), sigma) if noise is None else noise
    if noise_model == "common":
        if noise is None:
            return common, as_seat
        covariances = sigma**2 * tip_covariances(geometry, measurement.motion, noise)
        return covariances, jax.tree.map(lambda leaf: sigma * leaf, noise)
    redundancy = (
        xp.eye(3)[:, :, None] - linear.centroid_weights + xp.einsum("paN,pbN->abN", linear.columns, sensitivity.tips)
    )
    # The residual of the pose if it had been left out: redundancy^-1 r, by Cramer's rule.
    cofactors = xp.stack([xp.cross(redundancy[(i + 1) % 3], redundancy[(i + 2) % 3], axis=0) for i in range(3)])
    determinant = xp.sum(redundancy[0] * cofactors[0], axis=0)
    enough = determinant > _LEAST_REDUNDANCY
    alone = xp.einsum("ibN,iN->bN", cofactors, linear.residual) / xp.where(enough, determinant, 1.0)[None]
    return xp.where(enough[None, None], alone[:, None, :] * alone[None, :, :], common), as_seat


def _components(
    linear: Linearisation,
    measurement: Measurement,
    unit: Float[AnyArray, "3 3 N"],
    sigma: Float[AnyArray, ""],
    inverse: Float[AnyArray, "p p"],
) -> tuple[Float[AnyArray, ""], Float[AnyArray, ""]]:
    """Variances of the encoders (arcsec^2) and of the seat (mm^2), from two moments of the residuals.

    Residuals are r = M e, M a projector: the identity less the sockets' means less the fit. With D the encoders' part
    for 1 arcsec, E[r.r] = v tr(MD) + s tr(M) and E[r.Dr] = v tr(MDMD) + s tr(MD); a negative one is set to 0 and the
    other taken from the first (variance components by the method of moments, Henderson 1953).
    """
    xp = namespace(linear, measurement, unit, sigma, inverse)
    sizes = measurement.sizes
    columns, r = linear.columns, linear.residual
    rows = columns.reshape(columns.shape[0], -1)
    inverse = inverse / sigma**2  # of the fit as it counts residuals in mm
    seen = xp.einsum("abN,pbN->paN", unit, columns)
    once = seen.reshape(rows.shape) @ rows.T  # J^T D J
    twice = xp.einsum("paN,qaN->pq", seen, seen)
    mean = means_over_sockets(unit, sizes)  # of D over each socket
    mean2 = means_over_sockets(xp.einsum("abN,bcN->acN", unit, unit), sizes)
    crossed = (sums_over_sockets(seen, sizes) / np.sqrt(counts(sizes, 3))).reshape(rows.shape[0], -1)
    free = 3 * (sum(sizes) - len(sizes)) - xp.sum(inverse * (rows @ rows.T))
    md = _trace(unit) - _trace(mean) - xp.sum(inverse * once)
    mdmd = (
        xp.sum(unit**2)
        - 2 * (_trace(mean2) + xp.sum(inverse * twice))
        + xp.sum(mean**2)
        + 2 * xp.sum(inverse * (crossed @ crossed.T))
        + xp.sum((inverse @ once) * (inverse @ once).T)
    )
    plain, turned = xp.sum(r**2), xp.einsum("aN,abN,bN->", r, unit, r)
    determinant = md * md - free * mdmd  # negative, or 0 where the two cannot be told apart
    apart = determinant < -1e-9 * md * md
    safe = xp.where(apart, determinant, 1.0)
    encoder, seat = (plain * md - free * turned) / safe, (md * turned - mdmd * plain) / safe
    alone = plain / xp.maximum(md, 1e-300)
    everything = sigma**2
    encoder, seat = (
        xp.where(apart & (encoder > 0), xp.where(seat > 0, encoder, alone), 0.0),
        xp.where(apart & (encoder > 0), xp.maximum(seat, 0.0), everything),
    )
    return encoder, seat


def _root(value: Float[AnyArray, ""]) -> Float[AnyArray, ""]:
    # The square root has no derivative at 0, the value of a variance whose estimate is negative.
    xp = namespace(value)
    return xp.where(value > 0, xp.sqrt(xp.where(value > 0, value, 1.0)), 0.0)


def _trace(matrices: Float[AnyArray, "3 3 k"]) -> Float[AnyArray, ""]:
    xp = namespace(matrices)
    return xp.einsum("aak->", matrices)
