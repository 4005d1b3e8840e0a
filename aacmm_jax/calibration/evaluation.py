"""Repeatability of an arm's sockets, errors of its reference lengths and residuals of its observations on a capture."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.arguments import check_finite, checked_arguments
from ..core.arrays import Numbers
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, compiled, namespace, to_jax, to_numpy
from ..data.capture import Capture
from ..data.noise import Noise
from ..data.observations.socket import position_of
from ..kinematics.arm import Arm, check_columns
from ..model.measurement import Measurement, length_covariance
from ..model.metrics import Repeatability, no_repeatability, repeatability
from ..model.observed import Observed
from .observed_evaluation import ObservedEvaluation, checked_geometry, evaluate_observations


class Evaluation(eqx.Module):
    """Metrics of one arm on one capture, mm; of a batch of arms with its axes first.

    Example:
        >>> found = aj.evaluate(result.arm, two_bars)
        >>> print(found.error.round(3), "mm")
        [-0.003 -0.001] mm
        >>> print(found.distances.shape)
        (60,)
    """

    repeatability: Repeatability
    measured: Float[AnyArray, "*batch l"]  # reference lengths as the arm measures them
    error: Float[AnyArray, "*batch l"]  # measured - calibrated value
    # u of error: the length's own u, and the scatter of the poses at its ends; NaN where unknown
    u: Float[AnyArray, "*batch l"]
    distances: Float[AnyArray, "*batch N"]  # of every pose's tip from its socket's centroid
    observed: ObservedEvaluation | None = None  # where the capture has observations besides sockets


@checked_arguments
def evaluate(
    arm: Arm, capture: Capture, *, geometry: Mapping[str, Numbers] | None = None, noise: Noise | None = None
) -> Evaluation:
    """Repeatability, length errors and residuals of an arm on a capture; nothing is fitted but the unknown geometry.

    Args:
        arm: an arm, or a batch of arms (every parameter ``(..., n)``).
        capture: joint readings by socket, rad, reference lengths, and other observations.
        geometry: parts of the geometry that are known already and are not fitted, mm and rad, such as the frame of a
            station and the place of a target by a calibration: ``result.observed.geometry``. Parts that this capture
            does not have are ignored.
        noise: standard deviations of readings and seat, which residuals are compared with; by default the scatter of
            these residuals. Like ``geometry``, of captures with observations besides sockets.

    Returns:
        Metrics in mm; every array has the batch axes of the arm first.

    Raises:
        InputError: capture and arm differ in their number of joints, the capture is a batch, or the geometry is none of
            this capture.

    Example:
        >>> new = aj.simulate(true, {"C": (300, -400, 400)}, poses=20, noise=noise, seed=9)
        >>> for name, one in {"nominal": arm, "calibrated": result.arm}.items():
        ...     print(f"{name}: DE {aj.evaluate(one, new).repeatability.de:.3f} mm")
        nominal: DE 1.910 mm
        calibrated: DE 0.012 mm
    """
    check_columns(arm, capture.columns)
    if capture.q.ndim > 2:
        raise InputError("the capture is a batch; evaluate its captures one by one, or map over them with jax.vmap.")
    subject: tuple[Any, ...]
    work: Callable
    if capture.observations:
        check_finite(noise=noise)
        observed = Observed.of(capture, arm)
        kept = checked_geometry(observed, geometry)
        subject, work = (observed, len(capture.names), *to_numpy((kept, noise))), _evaluate_observed
    elif geometry is not None or noise is not None:
        raise InputError(
            "geometry and noise are for captures with observations besides sockets; leave them out, since a socket's "
            "position is the mean of its poses."
        )
    else:
        subject, work = (Measurement.of(capture, arm),), evaluate_measurement
    shape = np.broadcast_shapes(*(leaf.shape[:-1] for leaf in jax.tree.leaves(arm)))
    if not shape:
        return to_jax(work(*to_numpy((arm, *subject))))
    for _ in shape:
        work = eqx.filter_vmap(work, in_axes=(0, *(None for _ in subject)))
    arm = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*shape, leaf.shape[-1])), arm)
    return work(arm, *subject)


def _evaluate_observed(
    arm: Arm, observed: Observed, sockets: int, kept: Mapping[str, AnyArray], noise: Noise | None
) -> Evaluation:
    """`evaluate` for a capture of which the first observations are its sockets."""
    evaluation, measured, u = evaluate_observations(arm, observed, kept, noise)
    xp = namespace(evaluation)
    metrics, distances = no_repeatability(evaluation.sigma), xp.zeros(0)
    if sockets:
        values = evaluation.residuals[:sockets]
        positions = [evaluation.geometry[position_of(name)] for name in evaluation.names[:sockets]]
        tips = [residuals + position[:, None] for residuals, position in zip(values, positions, strict=True)]
        metrics = repeatability(xp.concatenate(tips, axis=1).T, tuple(tip.shape[1] for tip in tips))
        distances = xp.sqrt(xp.sum(xp.concatenate(values, axis=1) ** 2, axis=0))
    return Evaluation(metrics, measured, measured - observed.nominal, u, distances, evaluation)


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
