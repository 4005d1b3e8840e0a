"""Repeatability of an arm's sockets and errors of its reference lengths on a capture."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.arguments import checked_arguments
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, compiled, namespace, to_jax, to_numpy
from ..data.capture import Capture
from ..kinematics.arm import Arm
from ..model.measurement import Measurement, length_covariance
from ..model.metrics import Repeatability, repeatability


class Evaluation(eqx.Module):
    """Metrics of one arm on one capture, mm; of a batch of arms with its axes first."""

    repeatability: Repeatability
    measured: Float[AnyArray, "*batch l"]  # reference lengths as the arm measures them
    error: Float[AnyArray, "*batch l"]  # measured - calibrated value
    # u of error: the length's own u, and the scatter of the poses at its ends; NaN where unknown
    u: Float[AnyArray, "*batch l"]
    distances: Float[AnyArray, "*batch N"]  # of every pose's tip from its socket's centroid


@checked_arguments
def evaluate(arm: Arm, capture: Capture) -> Evaluation:
    """Repeatability and length errors of an arm on a capture; nothing is fitted but the sockets' positions.

    Args:
        arm: an arm, or a batch of arms (every parameter ``(..., n)``).
        capture: joint readings by socket, rad, and reference lengths.

    Returns:
        Metrics in mm; every array has the batch axes of the arm first.

    Raises:
        InputError: capture and arm differ in their number of joints, or the capture is a batch.
    """
    if capture.joints != arm.joints:
        raise InputError(
            f"the capture has {capture.joints} columns, but the arm has {arm.joints} joints; give one column a joint."
        )
    if capture.q.ndim > 2:
        raise InputError("the capture is a batch; evaluate its captures one by one, or map over them with jax.vmap.")
    measurement = Measurement.of(capture)
    shape = np.broadcast_shapes(*(leaf.shape[:-1] for leaf in jax.tree.leaves(arm)))
    if not shape:
        return to_jax(evaluate_measurement(*to_numpy((arm, measurement))))
    work = evaluate_measurement
    for _ in shape:
        work = eqx.filter_vmap(work, in_axes=(0, None))
    arm = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*shape, leaf.shape[-1])), arm)
    return work(arm, measurement)


@compiled(jit=eqx.filter_jit)
def evaluate_measurement(arm: Arm, measurement: Measurement) -> Evaluation:
    """`evaluate` for a capture that is a `Measurement` already; nothing is checked."""
    xp = namespace(arm, measurement)
    tips = arm.position(measurement.q)
    metrics = repeatability(tips, measurement.sizes)
    measured = u = xp.zeros(0)
    if measurement.ends:
        measured = measurement.distances(tips)
        u = xp.sqrt(xp.diagonal(length_covariance(metrics.centroids, measurement, metrics.sigma)))
    distances = xp.linalg.norm(measurement.centred(tips), axis=-1)
    return Evaluation(metrics, measured, measured - measurement.nominal, u, distances)
