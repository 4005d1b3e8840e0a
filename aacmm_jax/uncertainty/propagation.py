"""The uncertainty of each kind of identification: stage 1, the division by k after it, and the joint solve."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..core.linear_algebra import inverse_cholesky
from ..data.noise import Noise
from ..kinematics.arm import Arm, is_length, parameter_names
from ..kinematics.parameters import Parameters
from ..model.measurement import LEAST_SIGMA, Measurement, length_covariance
from ..model.residuals import JointWeights
from ..model.scale import Scale, scale_and_weights
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
    """How the errors of the data reach the parameters, and what that makes of their uncertainty."""

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
    """Of one least squares: of the poses alone (stage 1), or with ``joint_weights`` of poses and lengths (the joint solve); ``fixed``
    parameters were held, or are on a bound."""
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
    return Propagated(
        linear, sensitivity, errors, ParameterCovariance(matrix, determined, lost, behind, jnp.zeros(len(space.names) + 1))
    )


def joint_weights(arm: Arm, measurement: Measurement, sigma: Float[Array, ""]) -> JointWeights:
    """How a joint solve weighs poses and lengths, given the scatter of a tip coordinate by a nearly right arm."""
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
) -> Propagated:
    """After every length of stage 1's ``arm`` was divided by k, which itself follows the poses and the lengths.

    x = y / k for lengths, so dx = dy / k - (x / k) dk; parameters that stage 1 held or that sat on a bound move with k.
    """
    k, by_k, surplus = _scale_gains(arm.position(measurement.q), measurement, before, sigma)
    divides = jnp.asarray([name != "d_1" and bool(length) for name, length in zip(space.names, space.lengths, strict=True)])
    shift = jnp.where(divides, divided / k.value, 0.0)  # lengths only: their natural step is 1 mm
    change = jnp.where(divides, 1 / k.value, 1.0)
    sensitivity = Sensitivity(
        change[:, None, None] * before.sensitivity.tips - shift[:, None, None] * by_k.tips[None],
        -shift[:, None] * by_k.lengths[None],
    )
    matrix = covariance_of(sensitivity, before.linear, measurement, before.errors) + surplus * shift[:, None] * shift[None, :]
    parameter_covariance = before.parameter_covariance._replace(matrix=_in_units(matrix, space))
    if any(is_length(name) and name not in ("d_1", *space.names) for name in parameter_names(arm)):
        # Held lengths are divided too: they err by -dk / k, all alike.
        both = Sensitivity(
            jnp.concatenate([sensitivity.tips, -by_k.tips[None] / k.value]),
            jnp.concatenate([sensitivity.lengths, -by_k.lengths[None] / k.value]),
        )
        row = covariance_of(both, before.linear, measurement, before.errors)[-1]
        row = row + surplus * jnp.append(shift, 1 / k.value) / k.value
        parameter_covariance = parameter_covariance._replace(common_scale_error=row * jnp.append(space.scale, 1.0))
    return before._replace(sensitivity=sensitivity, parameter_covariance=parameter_covariance)


def propagated_scale(
    tips: Float[Array, "N 3"], measurement: Measurement, propagated: Propagated, sigma: Float[Array, ""]
) -> Scale:
    """k of stage 1, with an uncertainty that holds that of the identified parameters too."""
    k, by_k, surplus = _scale_gains(tips, measurement, propagated, sigma)
    flat = jnp.einsum("aN,abN,bN->", by_k.tips, propagated.errors, by_k.tips)
    variance = flat + jnp.sum((by_k.lengths * measurement.u) ** 2) + surplus
    return eqx.tree_at(lambda s: s.u, k, jnp.sqrt(variance))


class _ScaleGains(NamedTuple):
    tips: Float[Array, "3 N"]
    lengths: Float[Array, " l"]


def _scale_gains(
    tips: Float[Array, "N 3"], measurement: Measurement, propagated: Propagated, sigma: Float[Array, ""]
) -> tuple[Scale, _ScaleGains, Float[Array, ""]]:
    """k, its derivatives by the errors of tips and certified lengths, and what the lengths' disagreement adds to its variance."""
    k, by_lengths = scale_and_weights(tips, measurement, sigma)
    linear = propagated.linear
    measured = linear.lengths_by_tips + jnp.einsum("lp,paN->laN", linear.lengths, propagated.sensitivity.tips)
    by_tips = jnp.einsum("l,laN->aN", by_lengths, measured)
    centroids = measurement.centroids(tips)
    predicted = by_lengths @ length_covariance(centroids, measurement, sigma, k.value) @ by_lengths
    surplus = jnp.maximum(k.u**2 - predicted, 0.0)
    return k, _ScaleGains(by_tips, -by_lengths * k.measured / k.nominal), surplus


def _typical(linear: Linearisation, measurement: Measurement, sigma: Float[Array, ""]) -> Float[Array, ""]:
    """Scatter that the common form takes: of a coordinate, mm; with weights, in units of what these say."""
    if measurement.weights is None:
        return sigma
    degrees_of_freedom = 3 * sum(size - 1 for size in measurement.sizes) - linear.columns.shape[0]
    return jnp.sqrt(jnp.sum(measurement.weights.whiten(linear.residual) ** 2) / max(degrees_of_freedom, 1))


def _in_units(matrix: Float[Array, "p p"], space: Parameters) -> Float[Array, "p p"]:
    return space.scale[:, None] * matrix * space.scale[None, :]
