"""The uncertainty of parameters that are on a bound only because the data hardly determine them.

A covariance at active bounds is conditional: the parameter on its bound counts as known, and all others follow from
that. This is right where the data would carry the parameter well past its bound, so that the bound is knowledge. It
is wrong where the parameter drifted there along a near-degenerate direction (`kinematics.near_degeneracy`): then the
bound is the accidental end of that direction, and the parameters that imitate each other inherit a false exactness
from it.

For such a parameter i, with the best imitation v of one step of it by the parameters inside their bounds, the data
leave everything between the bounds equally likely. With a half-width h, the mean square of a rectangular distribution
about an estimate at its edge is (2 h)^2 / 3 (JCGM 100, F.2.4.5: an offset that is not corrected counts in full), and
(2 h)^2 / 3 v v^T is added to the covariance. The information on v includes the reference lengths, so that the scale
of an arm that stage 1 shrank to its bounds is not meant: the lengths determine it.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from ..core.numpy_or_jax import AnyArray, namespace
from ..kinematics.arm import Arm
from ..kinematics.near_degeneracy import LEAST_MOVEMENT, SHARE_OF_BOUNDS
from ..kinematics.parameters import Bounds, Parameters
from ..model.measurement import LEAST_SIGMA, Measurement
from ..model.residuals import JointWeights
from .covariance import ParameterCovariance, information_of, inverse_information, linearised


def with_active_bounds(
    known: ParameterCovariance,
    arm: Arm,
    space: Parameters,
    measurement: Measurement,
    active: Int[AnyArray, " p"],
    bounds: Bounds,
    sigma: Float[AnyArray, ""],
    anchor: str | None = None,
) -> ParameterCovariance:
    """The covariance with the widths of those active bounds that end a near-degenerate direction.

    Args:
        known: The covariance conditional on the active bounds.
        arm: The arm that was found.
        space: The free parameters.
        measurement: What it was found from.
        active: Which parameters are on a bound (not 0).
        bounds: The bounds.
        sigma: Standard deviation of a tip coordinate, mm.
        anchor: A length that stays fixed too: the anchor of the scale.
    """
    xp = namespace(known, arm, space, measurement, active, bounds, sigma, anchor)
    if anchor is None and not measurement.ends:
        return known  # nothing determines the scale: it cannot be distinguished from a near-degenerate direction
    if xp is np and not np.any(active):
        return known
    fixed = xp.asarray(np.array([name == anchor for name in space.names]))
    sigma = xp.maximum(sigma, LEAST_SIGMA)
    plain = dataclasses.replace(measurement, weights=None)
    linear = linearised(arm, space, plain, fixed)
    whitening = JointWeights.of(arm.position(plain.q), plain, sigma).whitening if measurement.ends else None
    information = information_of(linear, sigma, whitening)
    on_bound = active != 0
    inner = xp.where(on_bound[:, None] | on_bound[None, :], 0.0, information)
    inverse, _, _ = inverse_information(inner, on_bound | fixed)
    # Column i: one step of a parameter on its bound, and what the parameters inside their bounds do to imitate it.
    follow = xp.where(on_bound[:, None], 0.0, -inverse @ information)
    directions = xp.where(on_bound[None, :], xp.eye(len(space.names)) + follow, 0.0)
    information_along = xp.einsum("pi,pq,qi->i", directions, information, directions)
    widths = xp.where(on_bound, (bounds.upper - bounds.lower) / space.scale, 0.0)
    # A bound with none opposite counts as one of the default box of `Bounds.around`, in natural steps.
    default = xp.where(xp.asarray(space.lengths), 10.0, 17.5)
    half_widths = xp.where(xp.isfinite(widths), widths / 2, default)
    moved = xp.einsum("pi,paN->iaN", directions, linear.columns)
    movement = xp.mean(xp.sum(moved**2, axis=1), axis=-1)
    if measurement.ends:
        movement = movement + xp.mean((linear.lengths @ directions) ** 2, axis=0)
    size = xp.where(on_bound, xp.sum(directions**2, axis=0), 1.0)
    weak = information_along * (SHARE_OF_BOUNDS * half_widths) ** 2 < 1
    weak = on_bound & (weak | (movement < LEAST_MOVEMENT**2 * size))
    variance = xp.where(weak, (2 * half_widths) ** 2 / 3, 0.0)
    added = space.scale[:, None] * ((directions * variance[None, :]) @ directions.T) * space.scale[None, :]
    return known._replace(matrix=known.matrix + added)
