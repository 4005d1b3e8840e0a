"""The uncertainty of k, and of a calibration after stage 2, whose parameters follow k.

k follows the certified lengths and the tips at their ends directly (`model.scale.scale_and_weights`), and the tips of
all sockets once more through the parameters that stage 1 identified from them: `propagated_scale` has both.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..core.numpy_or_jax import AnyArray, namespace, set_at
from ..kinematics.arm import Arm
from ..kinematics.parameters import Parameters
from ..model.measurement import Measurement, length_covariance
from ..model.scale import Partners, Scale, divisible, replaced_lengths, scale_and_weights
from .covariance import DISAGREEMENT, STATED, Sensitivity, by_lengths, covariance_of
from .degrees_of_freedom import Components
from .propagation import Propagated, in_units


def propagate_division(
    before: Propagated,
    arm: Arm,
    space: Parameters,
    measurement: Measurement,
    sigma: Float[AnyArray, ""],
    divided: Float[AnyArray, " p"],
    partners: Partners | None,
) -> Propagated:
    """After the lengths of stage 1's ``arm`` were divided by k, which itself follows the poses and the lengths.

    x' = (x + r) / k - r for lengths, where r are the fixed lengths that x replaces (`model.scale.divide_lengths`), so
    dx' = dx / k - (x' + r) / k dk; a parameter that stage 1 held or that was on a bound moves with k too.
    """
    xp = namespace(before, arm, space, measurement, sigma, divided)
    scale = _scale_sensitivity(arm.position(measurement.q), measurement, before, sigma)
    divides = xp.asarray(divisible(space))
    # Of lengths only, whose natural step is 1 mm.
    by_k = xp.where(divides, (divided + replaced_lengths(space, partners)) / scale.k.value, 0.0)
    change = xp.where(divides, 1 / scale.k.value, 1.0)
    return _with_scale(before, space, measurement, scale, by_k, change)


def propagate_adjustment(
    solved: Propagated,
    arm: Arm,
    space: Parameters,
    measurement: Measurement,
    sigma: Float[AnyArray, ""],
    adjusted: str,
    fixed: Bool[AnyArray, ""],
) -> Propagated:
    """After a length was adjusted until k = 1, the others being identified with it at each of its values.

    A step of the adjusted length h moves the tips by their column of h, which the other parameters follow as they
    follow any error of the tips: S J_h. With t = S J_h + e_h, k(x(h), e) = 1 gives dx = S de - t (dk/dh)^-1 (dk/de) de.
    ``fixed``: h is on a bound, so that nothing follows k.
    """
    xp = namespace(solved, arm, space, measurement, sigma, adjusted, fixed)
    scale = _scale_sensitivity(arm.position(measurement.q), measurement, solved, sigma)
    column = arm.jacobian(measurement.q, (adjusted,))[..., 0].T
    by_length = xp.einsum("paN,aN->p", solved.sensitivity.tips, column)
    by_length = set_at(by_length, space.index(adjusted), 1.0)
    k_by_length = xp.sum(scale.by_tips * column)
    by_k = xp.where(fixed, 0.0, by_length / xp.where(k_by_length == 0, 1.0, k_by_length))
    return _with_scale(solved, space, measurement, scale, by_k, xp.ones_like(by_k))


def propagated_scale(
    tips: Float[AnyArray, "N 3"], measurement: Measurement, propagated: Propagated, sigma: Float[AnyArray, ""]
) -> Scale:
    """k of stage 1, with an uncertainty that includes that of the identified parameters."""
    xp = namespace(tips, measurement, propagated, sigma)
    scale = _scale_sensitivity(tips, measurement, propagated, sigma)
    by_tips = xp.einsum("aN,abN,bN->", scale.by_tips, propagated.errors, scale.by_tips)
    variance = by_tips + xp.sum((scale.by_lengths * measurement.u) ** 2) + scale.surplus
    return eqx.tree_at(lambda s: (s.u, s.surplus), scale.k, (xp.sqrt(variance), scale.surplus))


class _ScaleSensitivity(NamedTuple):
    """k and its derivatives by the errors of tips and of certified lengths, 1/mm."""

    k: Scale
    by_tips: Float[AnyArray, "3 N"]
    by_lengths: Float[AnyArray, " l"]
    surplus: Float[AnyArray, ""]  # what the lengths' disagreement adds to its variance


def _scale_sensitivity(
    tips: Float[AnyArray, "N 3"], measurement: Measurement, propagated: Propagated, sigma: Float[AnyArray, ""]
) -> _ScaleSensitivity:
    xp = namespace(tips, measurement, propagated, sigma)
    k, by_lengths = scale_and_weights(tips, measurement, sigma)
    linear = propagated.linear
    measured = linear.lengths_by_tips + xp.einsum("lp,paN->laN", linear.lengths, propagated.sensitivity.tips)
    by_tips = xp.einsum("l,laN->aN", by_lengths, measured)
    centroids = measurement.centroids(tips)
    predicted = by_lengths @ length_covariance(centroids, measurement, sigma, k.value) @ by_lengths
    surplus = xp.maximum(k.u**2 - predicted, 0.0)
    return _ScaleSensitivity(k, by_tips, -by_lengths * k.measured / k.nominal, surplus)


def _with_scale(
    before: Propagated,
    space: Parameters,
    measurement: Measurement,
    scale: _ScaleSensitivity,
    by_k: Float[AnyArray, " p"],
    change: Float[AnyArray, " p"],
) -> Propagated:
    """Sensitivities multiplied by ``change``, less what follows k: dx = change S de - by_k dk, in natural steps."""
    sensitivity = Sensitivity(
        change[:, None, None] * before.sensitivity.tips - by_k[:, None, None] * scale.by_tips[None],
        -by_k[:, None] * scale.by_lengths[None],
    )
    surplus = scale.surplus * by_k[:, None] * by_k[None, :]
    matrix = covariance_of(sensitivity, before.linear, measurement, before.errors) + surplus
    stated, lengths = by_lengths(sensitivity, measurement), len(measurement.ends)
    parts = {STATED: (stated, np.inf), DISAGREEMENT: (surplus, max(lengths - 1, 1))}
    parts = Components.of({name: (in_units(part, space), nu) for name, (part, nu) in parts.items()})
    parameter_covariance = before.parameter_covariance._replace(matrix=in_units(matrix, space), components=parts)
    return before._replace(sensitivity=sensitivity, parameter_covariance=parameter_covariance)
