"""Stage 2: the one number that repeatability cannot see, from reference lengths (Cheng et al. 2018, section 2.3)."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import Numbers, as_array, is_concrete
from ..core.errors import InputError
from ..data.capture import Capture
from ..kinematics.arm import Arm
from .measurement import Measurement, length_covariance
from .metrics import repeatability


class Scale(eqx.Module):
    """k = measured / nominal with its standard uncertainty, and the lengths it was found from (mm)."""

    value: Float[Array, ""]
    u: Float[Array, ""]
    measured: Float[Array, " l"]
    nominal: Float[Array, " l"]


class ScaleFix(eqx.Module):
    """Result of stage 2: the arm divided by k, and k."""

    arm: Arm
    scale: Scale


def divide_lengths(arm: Arm, k: Float[Array, ""]) -> Arm:
    """The arm with its lengths divided by k: every a, every d but ``d_1``, and the probe.

    ``d_1`` only shifts the whole base frame along the first axis. No length and no repeatability depends on it, k says
    nothing about it, and it stays as given (as in Table 2 of the paper).
    """
    k = k[..., None]
    d = jnp.concatenate([arm.d[..., :1], arm.d[..., 1:] / k], axis=-1)
    return arm.replace(a=arm.a / k, d=d, probe=arm.probe / k)


def fix_scale(arm: Arm, capture: Capture, *, sigma: float | None = None) -> ScaleFix:
    """Stage 2: k from every reference length of a capture, and the arm divided by it.

    k is the mean of measured / nominal weighted by uncertainty: the length's own u, and the scatter of the poses over
    the number of them at each end. Its standard uncertainty is the larger of what those predict and what the lengths'
    disagreement shows (the Birge ratio). It takes the arm's angles as exact; `calibrate` adds their uncertainty.

    ``sigma`` is the standard deviation of a tip coordinate, mm (stage 1's ``after.sigma``); by default it comes from the
    capture's own scatter. With one pose in every socket there is none, and u of k is then NaN: unknown.
    Raises `InputError` without a reference length.
    """
    if not capture.lengths:
        raise InputError(
            "the capture holds no reference length, so the scale cannot be fixed; add one between two of its sockets."
        )
    return _fixed(arm, Measurement.of(capture), sigma)


@eqx.filter_jit
def _fixed(arm: Arm, measurement: Measurement, sigma: float | Array | None) -> ScaleFix:
    tips = arm.position(measurement.q)
    scatter = repeatability(tips, measurement.sizes).sigma if sigma is None else jnp.asarray(sigma, dtype=jnp.float64)
    scale = scale_of(tips, measurement, scatter)
    return ScaleFix(divide_lengths(arm, scale.value), scale)


def scale_of(tips: Float[Array, "N 3"], measurement: Measurement, sigma: Float[Array, ""]) -> Scale:
    """k from tips, given the standard deviation of a tip coordinate (NaN where unknown)."""
    return scale_and_weights(tips, measurement, sigma)[0]


def scale_and_weights(
    tips: Float[Array, "N 3"], measurement: Measurement, sigma: Float[Array, ""]
) -> tuple[Scale, Float[Array, " l"]]:
    """k from tips, and its derivative by each measured length, 1/mm."""
    measured = measurement.distances(tips)
    ratio = measured / measurement.nominal
    known = jnp.where(jnp.isnan(sigma), 0.0, sigma)
    centroids = measurement.centroids(tips)
    plain = jnp.diagonal(length_covariance(centroids, measurement, known, ratio))
    weight = measurement.nominal**2 / plain
    weight_of = weight / jnp.sum(weight)
    value = jnp.sum(weight_of * ratio)
    relative = weight_of / measurement.nominal
    predicted = relative @ length_covariance(centroids, measurement, sigma, value) @ relative
    observed = jnp.sum(weight_of * (ratio - value) ** 2) / max(ratio.shape[0] - 1, 1)
    return Scale(value, jnp.sqrt(jnp.maximum(predicted, observed)), measured, measurement.nominal), relative


def scale_from_lengths(measured: Numbers, nominal: Numbers, u: float = 0.0) -> Scale:
    """k from lengths measured by the arm and their nominal value (one, or one each), mm.

    ``u`` is the standard uncertainty of the nominal value (of all alike). The uncertainty of k combines it with the
    standard deviation of the mean of the measurements (JCGM 100, type A). Raises `InputError` for lengths that are not
    positive and finite.
    """
    measured, nominal = jnp.atleast_1d(as_array(measured, "measured")), as_array(nominal, "nominal")
    if nominal.shape not in ((), measured.shape):
        raise InputError(
            f"nominal has shape {nominal.shape}, but measured {measured.shape}; give one nominal length, or one each."
        )
    nominal = jnp.broadcast_to(nominal, measured.shape)
    for what, values in (("measured", measured), ("nominal", nominal)):
        if values.ndim != 1 or values.shape[0] == 0:
            raise InputError(f"{what} must be a list of at least one length, in mm.")
        if is_concrete(values) and not np.all(np.isfinite(np.asarray(values)) & (np.asarray(values) > 0)):
            raise InputError(f"{what} holds {np.asarray(values).min():g} mm; a length must be positive and finite.")
    ratio = measured / nominal
    count = ratio.shape[0]
    value = jnp.mean(ratio)
    repeated = jnp.sum((ratio - value) ** 2) / (max(count - 1, 1) * count)
    return Scale(value, jnp.sqrt(repeated + (value * u / jnp.mean(nominal)) ** 2), measured, nominal)
