"""How good an arm is on a capture: repeatability of its sockets and errors of its reference lengths."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .arm import Arm
from .capture import Capture
from .errors import InputError
from .metrics import Repeatability, repeatability
from .residuals import Measurement


class Evaluation(eqx.Module):
    """Figures of one arm on one capture; mm."""

    repeatability: Repeatability
    measured: Float[Array, " l"]  # reference lengths as the arm measures them
    error: Float[Array, " l"]  # measured - calibrated value


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
    measured = measurement.distances(tips) if measurement.ends else jnp.zeros(0)
    return Evaluation(repeatability(tips, measurement.sizes), measured, measured - measurement.nominal)
