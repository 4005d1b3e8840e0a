"""The uncertainty of parameters that are on a bound only because the data hardly determine them.

A covariance at active bounds is conditional: the parameter on its bound counts as known, and all others follow from
that. This is right where the data would carry the parameter well past its bound, so that the bound is knowledge. It
is wrong where the parameter drifted there along a near-degenerate direction (`kinematics.independence`): then the
bound is the accidental end of that direction, and the parameters that imitate each other inherit a false exactness
from it.

For such a parameter i, with the best imitation v of one step of it by the parameters inside their bounds, the data
leave everything between the bounds equally likely. With a half-width h, the mean square of a rectangular distribution
about an estimate at its edge is (2 h)^2 / 3 (JCGM 100, F.2.4.5: an offset that is not corrected counts in full), and
(2 h)^2 / 3 v v^T is added to the covariance. The information on v includes the reference lengths, so that the scale
of an arm that stage 1 shrank to its bounds is not meant: the lengths determine it.
"""

import numpy as np
from jaxtyping import Float, Int

from ..core.numpy_or_jax import AnyArray, namespace
from ..kinematics.independence import LEAST_MOVEMENT, SHARE_OF_BOUNDS
from ..kinematics.parameters import Bounds
from .covariance import inverse_information
from .linearisation import Linearisation


def of_active_bounds(
    linear: Linearisation, active: Int[AnyArray, " p"], bounds: Bounds, sigma: Float[AnyArray, ""]
) -> Float[AnyArray, "p p"]:
    """What is added to a covariance for the widths of those active bounds that end a near-degenerate direction.

    ``linear`` is all that ties the parameters down, at the result; ``active`` is not 0 of parameters on a bound;
    ``sigma`` is the standard deviation of a tip coordinate, mm.
    """
    xp, p = namespace(linear.z, active), len(linear.space.names)
    if xp is np and not np.any(active):
        return np.zeros((p, p))
    influence = linear.influence()
    information, shared = influence.information, linear.observed.layout.shared
    on_bound = xp.concatenate([active != 0, xp.zeros(shared, dtype=bool)])
    inner = xp.where(on_bound[:, None] | on_bound[None, :], 0.0, information)
    inverse, _, _ = inverse_information(inner, on_bound)
    # Column i: one step of a parameter on its bound, and what the parameters inside their bounds do to imitate it.
    follow = xp.where(on_bound[:, None], 0.0, -inverse @ information)
    directions = xp.where(on_bound[None, :], xp.asarray(np.eye(p + shared)) + follow, 0.0)
    information_along = xp.einsum("pi,pq,qi->i", directions, information, directions)
    scale = linear.space.scale
    widths = xp.where(active != 0, (bounds.upper - bounds.lower) / scale, 0.0)
    # A bound with none opposite counts as one of the default box of `Bounds.around`, in natural steps.
    default = xp.where(xp.asarray(linear.space.lengths), 10.0, 17.5)
    half_widths = xp.concatenate([xp.where(xp.isfinite(widths), widths / 2, default), xp.zeros(shared)])
    # Rows are in standard deviations of about sigma, so that this is how far a tip moves on average.
    movement = information_along * sigma**2 / linear.observed.q.shape[0]
    size = xp.where(on_bound, xp.sum(directions**2, axis=0), 1.0)
    weak = information_along * (SHARE_OF_BOUNDS * half_widths) ** 2 < 1
    weak = on_bound & (weak | (movement < LEAST_MOVEMENT**2 * size))
    variance = xp.where(weak, (2 * half_widths) ** 2 / 3, 0.0)
    added = (directions[:p] * variance[None, :]) @ directions[:p].T
    return scale[:, None] * added * scale[None, :]
