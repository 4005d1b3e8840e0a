"""How good an arm is on a capture: repeatability of its sockets and errors of its reference lengths."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.errors import InputError
from ..data.capture import Capture
from ..kinematics.arm import Arm
from ..model.measurement import Measurement, length_covariance
from ..model.metrics import Repeatability, repeatability


class Evaluation(eqx.Module):
    """Figures of one arm on one capture; mm."""

    repeatability: Repeatability
    measured: Float[Array, " l"]  # reference lengths as the arm measures them
    error: Float[Array, " l"]  # measured - calibrated value
    u: Float[Array, " l"]  # of error: the length's own u, and the scatter of the poses at its ends; NaN where unknown
    distances: Float[Array, " N"]  # of every pose's tip from its socket's centroid


def evaluate(arm: Arm, capture: Capture) -> Evaluation:
    """Repeatability and length errors of an arm on a capture; nothing is fitted but the sockets' positions."""
    if capture.joints != arm.joints:
        raise InputError(
            f"the capture has {capture.joints} columns, but the arm has {arm.joints} joints; give one column a joint."
        )
    return evaluate_measurement(arm, Measurement.of(capture))


@eqx.filter_jit
def evaluate_measurement(arm: Arm, measurement: Measurement) -> Evaluation:
    """`evaluate` for a capture already in the form that residuals take; nothing is checked."""
    tips = arm.position(measurement.q)
    figures = repeatability(tips, measurement.sizes)
    measured = u = jnp.zeros(0)
    if measurement.ends:
        measured = measurement.distances(tips)
        u = jnp.sqrt(jnp.diagonal(length_covariance(figures.centroids, measurement, figures.sigma)))
    distances = jnp.linalg.norm(measurement.centred(tips), axis=-1)
    return Evaluation(figures, measured, measured - measurement.nominal, u, distances)
