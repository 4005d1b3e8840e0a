"""The uncertainty of one least squares: of stage 1, or of the joint solve (of stage 2 and k: `scale_uncertainty`)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..core.numpy_or_jax import AnyArray, namespace
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.parameters import Parameters
from ..model.measurement import LEAST_SIGMA, Measurement
from ..model.residuals import JointWeights
from .covariance import (
    STATED,
    Linearisation,
    NoiseModel,
    ParameterCovariance,
    Sensitivity,
    by_lengths,
    covariance_of,
    information_of,
    inverse_information,
    linearised,
    sensitivity_of,
    tip_errors,
)
from .degrees_of_freedom import Components


class Propagated(NamedTuple):
    """How the errors of the data reach the parameters, and the uncertainty of these that follows."""

    linear: Linearisation
    sensitivity: Sensitivity  # natural steps
    errors: Float[AnyArray, "3 3 N"]  # covariance of every tip's error, mm^2
    parameter_covariance: ParameterCovariance


def propagate_solve(
    arm: Arm,
    space: Parameters,
    measurement: Measurement,
    fixed: Bool[AnyArray, " p"],
    sigma: Float[AnyArray, ""],
    noise_model: NoiseModel,
    noise: Noise | None,
    joint_weights: JointWeights | None = None,
) -> Propagated:
    """Of one least squares: of the poses alone (stage 1), or with ``joint_weights`` of poses and lengths (the joint
    solve); ``fixed`` parameters are the scale anchor, or on a bound."""
    xp = namespace(arm, space, measurement, fixed, sigma, noise_model, noise, joint_weights)
    whitening = None if joint_weights is None else joint_weights.whitening
    sigma = xp.maximum(sigma, LEAST_SIGMA)
    counted = sigma if measurement.weights is None else xp.ones_like(sigma)
    linear = linearised(arm, space, measurement, fixed)
    information = information_of(linear, counted, whitening)
    inverse, lost, determined = inverse_information(information, fixed)
    sensitivity = sensitivity_of(linear, measurement, inverse, counted, whitening)
    errors, behind = tip_errors(
        noise_model, arm, measurement, linear, sensitivity, inverse, _typical(linear, measurement, sigma), noise
    )
    matrix = in_units(covariance_of(sensitivity, linear, measurement, errors), space)
    parts = Components.of({STATED: (in_units(by_lengths(sensitivity, measurement), space), np.inf)})
    return Propagated(linear, sensitivity, errors, ParameterCovariance(matrix, determined, lost, behind, parts))


def _typical(linear: Linearisation, measurement: Measurement, sigma: Float[AnyArray, ""]) -> Float[AnyArray, ""]:
    """Scatter of the noise model "common": of a coordinate, mm; with weights, in units of what these predict."""
    xp = namespace(linear, measurement, sigma)
    if measurement.weights is None:
        return sigma
    degrees_of_freedom = 3 * sum(size - 1 for size in measurement.sizes) - linear.columns.shape[0]
    return xp.sqrt(xp.sum(measurement.weights.whiten(linear.residual) ** 2) / max(degrees_of_freedom, 1))


def in_units(matrix: Float[AnyArray, "p p"], space: Parameters) -> Float[AnyArray, "p p"]:
    """A covariance in mm and rad, of one in natural steps."""
    return space.scale[:, None] * matrix * space.scale[None, :]
