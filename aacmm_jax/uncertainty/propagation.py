"""The uncertainty of each kind of identification: of stage 1, of stage 2, of the joint solve; and that of k.

k follows the tips and the certified lengths directly, and the tips once more through the identified parameters:
`propagated_scale` is its uncertainty, `propagate_division` and `propagate_adjustment` what it contributes to the
parameters of a two-stage calibration.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..core.linear_algebra import inverse_cholesky
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.parameters import Parameters
from ..model.measurement import LEAST_SIGMA, Measurement, length_covariance
from ..model.residuals import JointWeights
from ..model.scale import Scale, divisible, scale_and_weights
from .covariance import (
    Linearisation,
    NoiseModel,
    ParameterCovariance,
    Sensitivity,
    covariance_of,
    information_of,
    inverse_information,
    linearised,
    sensitivity_of,
    tip_errors,
)


class Propagated(NamedTuple):
    """How the errors of the data reach the parameters, and the uncertainty of these that follows."""

    linear: Linearisation
    sensitivity: Sensitivity  # natural steps
    errors: Float[Array, "3 3 N"]  # covariance of every tip's error, mm^2
    parameter_covariance: ParameterCovariance


def propagate_solve(
    arm: Arm,
    space: Parameters,
    measurement: Measurement,
    fixed: Bool[Array, " p"],
    sigma: Float[Array, ""],
    noise_model: NoiseModel,
    noise: Noise | None,
    joint_weights: JointWeights | None = None,
) -> Propagated:
    """Of one least squares: of the poses alone (stage 1), or with ``joint_weights`` of poses and lengths (the joint
    solve); ``fixed`` parameters are the scale anchor, or on a bound."""
    whitening = None if joint_weights is None else joint_weights.whitening
    sigma = jnp.maximum(sigma, LEAST_SIGMA)
    counted = sigma if measurement.weights is None else jnp.ones_like(sigma)
    linear = linearised(arm, space, measurement, fixed)
    information = information_of(linear, counted, whitening)
    inverse, lost, determined = inverse_information(information, fixed)
    sensitivity = sensitivity_of(linear, measurement, inverse, counted, whitening)
    errors, behind = tip_errors(
        noise_model, arm, measurement, linear, sensitivity, inverse, _typical(linear, measurement, sigma), noise
    )
    matrix = _in_units(covariance_of(sensitivity, linear, measurement, errors), space)
    return Propagated(linear, sensitivity, errors, ParameterCovariance(matrix, determined, lost, behind))


def joint_weights(arm: Arm, measurement: Measurement, sigma: Float[Array, ""]) -> JointWeights:
    """Weights of poses and lengths in a joint solve, given the scatter of a tip coordinate by a nearly right arm."""
    safe = jnp.maximum(sigma, LEAST_SIGMA)
    centroids = measurement.centroids(arm.position(measurement.q))
    whitening = inverse_cholesky(length_covariance(centroids, measurement, safe))
    counted = safe if measurement.weights is None else jnp.ones_like(safe)  # weights are in standard deviations already
    return JointWeights(measurement.ends, measurement.nominal, counted, whitening)


def propagate_division(
    before: Propagated,
    arm: Arm,
    space: Parameters,
    measurement: Measurement,
    sigma: Float[Array, ""],
    divided: Float[Array, " p"],
    replaced: Float[Array, " p"],
) -> Propagated:
    """After the lengths of stage 1's ``arm`` were divided by k, which itself follows the poses and the lengths.

    x' = (x + r) / k - r for lengths, where r are the fixed lengths that x replaces (`model.scale.divide_free_lengths`),
    so dx' = dx / k - (x' + r) / k dk; a parameter that stage 1 held or that was on a bound moves with k too.
    """
    scale = _scale_sensitivity(arm.position(measurement.q), measurement, before, sigma)
    divides = jnp.asarray(divisible(space))
    by_k = jnp.where(divides, (divided + replaced) / scale.k.value, 0.0)  # lengths only: their natural step is 1 mm
    change = jnp.where(divides, 1 / scale.k.value, 1.0)
    return _with_scale(before, space, measurement, scale, by_k, change)


def propagate_adjustment(
    solved: Propagated,
    arm: Arm,
    space: Parameters,
    measurement: Measurement,
    sigma: Float[Array, ""],
    adjusted: str,
    fixed: Bool[Array, ""],
) -> Propagated:
    """After a length was adjusted until k = 1, the others being identified with it at each of its values.

    A step of the adjusted length h moves the tips by their column of h, which the other parameters follow as they
    follow any error of the tips: S J_h. With t = S J_h + e_h, k(x(h), e) = 1 gives dx = S de - t (dk/dh)^-1 (dk/de) de.
    ``fixed``: h is on a bound, so that nothing follows k.
    """
    scale = _scale_sensitivity(arm.position(measurement.q), measurement, solved, sigma)
    column = arm.jacobian(measurement.q, (adjusted,))[..., 0].T
    by_length = jnp.einsum("paN,aN->p", solved.sensitivity.tips, column)
    by_length = by_length.at[space.index(adjusted)].set(1.0)
    k_by_length = jnp.sum(scale.by_tips * column)
    by_k = jnp.where(fixed, 0.0, by_length / jnp.where(k_by_length == 0, 1.0, k_by_length))
    return _with_scale(solved, space, measurement, scale, by_k, jnp.ones_like(by_k))


def propagated_scale(
    tips: Float[Array, "N 3"], measurement: Measurement, propagated: Propagated, sigma: Float[Array, ""]
) -> Scale:
    """k of stage 1, with an uncertainty that includes that of the identified parameters."""
    scale = _scale_sensitivity(tips, measurement, propagated, sigma)
    by_tips = jnp.einsum("aN,abN,bN->", scale.by_tips, propagated.errors, scale.by_tips)
    variance = by_tips + jnp.sum((scale.by_lengths * measurement.u) ** 2) + scale.surplus
    return eqx.tree_at(lambda s: s.u, scale.k, jnp.sqrt(variance))


class _ScaleSensitivity(NamedTuple):
    """k and its derivatives by the errors of tips and of certified lengths, 1/mm."""

    k: Scale
    by_tips: Float[Array, "3 N"]
    by_lengths: Float[Array, " l"]
    surplus: Float[Array, ""]  # what the lengths' disagreement adds to its variance


def _scale_sensitivity(
    tips: Float[Array, "N 3"], measurement: Measurement, propagated: Propagated, sigma: Float[Array, ""]
) -> _ScaleSensitivity:
    k, by_lengths = scale_and_weights(tips, measurement, sigma)
    linear = propagated.linear
    measured = linear.lengths_by_tips + jnp.einsum("lp,paN->laN", linear.lengths, propagated.sensitivity.tips)
    by_tips = jnp.einsum("l,laN->aN", by_lengths, measured)
    centroids = measurement.centroids(tips)
    predicted = by_lengths @ length_covariance(centroids, measurement, sigma, k.value) @ by_lengths
    surplus = jnp.maximum(k.u**2 - predicted, 0.0)
    return _ScaleSensitivity(k, by_tips, -by_lengths * k.measured / k.nominal, surplus)


def _with_scale(
    before: Propagated,
    space: Parameters,
    measurement: Measurement,
    scale: _ScaleSensitivity,
    by_k: Float[Array, " p"],
    change: Float[Array, " p"],
) -> Propagated:
    """Sensitivities multiplied by ``change``, less what follows k: dx = change S de - by_k dk, in natural steps."""
    sensitivity = Sensitivity(
        change[:, None, None] * before.sensitivity.tips - by_k[:, None, None] * scale.by_tips[None],
        -by_k[:, None] * scale.by_lengths[None],
    )
    matrix = covariance_of(sensitivity, before.linear, measurement, before.errors)
    matrix = _in_units(matrix + scale.surplus * by_k[:, None] * by_k[None, :], space)
    parameter_covariance = before.parameter_covariance._replace(matrix=matrix)
    return before._replace(sensitivity=sensitivity, parameter_covariance=parameter_covariance)


def _typical(linear: Linearisation, measurement: Measurement, sigma: Float[Array, ""]) -> Float[Array, ""]:
    """Scatter of the noise model "common": of a coordinate, mm; with weights, in units of what these predict."""
    if measurement.weights is None:
        return sigma
    degrees_of_freedom = 3 * sum(size - 1 for size in measurement.sizes) - linear.columns.shape[0]
    return jnp.sqrt(jnp.sum(measurement.weights.whiten(linear.residual) ** 2) / max(degrees_of_freedom, 1))


def _in_units(matrix: Float[Array, "p p"], space: Parameters) -> Float[Array, "p p"]:
    return space.scale[:, None] * matrix * space.scale[None, :]
