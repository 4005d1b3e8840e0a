"""Stage 2 of a calibration: the arm of stage 1 divided by k, with fixed parameters as they are and within bounds.

Stage 1 leaves the scale to its anchor, a length kept at its start, and k = measured / nominal is its error. If no bound
acts on a length, repeatability does not change with the scale, so the arm divided by k is the result; fixed lengths
that free ones replace exactly (d_n by a probe along the same axis) can stay. Where a bound or another fixed length
stands against the division, everything is solved at once instead (`calibrate`). Where fixed lengths set the scale by
themselves, nothing is changed and k only compares them with the reference lengths.

The division is a linear map of what stage 1 found, so its covariance is mapped along, with that of k, which follows the
certified lengths, and the same poses as the parameters do.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.numpy_or_jax import AnyArray, namespace, to_numpy
from ..data.capture import Capture
from ..kinematics.parameters import Bounds
from ..model.observed import Observed, ends_of
from ..model.scale import MeasuredEnds, Scale, divide_lengths, divisible, replaced_lengths, scale_and_weights
from ..uncertainty.covariance import DISAGREEMENT, STATED
from ..uncertainty.degrees_of_freedom import Components
from ..uncertainty.linear_propagation import rows_of_functions
from .results import Calibration
from .scale_anchor import ScaleAnchor, fixed_lengths
from .solve import Solution

_ROUNDING = 1e-9  # mm: how far from a bound the division may leave a length by rounding


class MeasuredScale(NamedTuple):
    """k of stage 1, and how it follows the data."""

    scale: Scale
    rows: list[Float[AnyArray, "1 _ _"]]  # its derivatives by the whitened rows of every block
    by_lengths: Float[AnyArray, " l"]  # by the certified lengths, 1/mm
    variance_of_lengths: Float[AnyArray, ""]  # by these; `Scale.surplus` is what their disagreement adds

    @property
    def added(self) -> Float[AnyArray, ""]:
        """What is added to the variance that follows from the poses."""
        return self.variance_of_lengths + self.scale.surplus


def measured_scale(solution: Solution, capture: Capture) -> MeasuredScale:
    """k by the reference lengths of a capture, between positions that an identification has found.

    Its standard uncertainty includes that of the identified parameters, and takes those on a bound as exact.
    """
    linear, influence, p = solution.linear, solution.influence, len(solution.linear.space.names)
    geometry = linear.z[p:]
    xp, ends = namespace(linear.z), ends_between(linear.observed, geometry, influence.own, capture)
    scale, relative = scale_and_weights(ends)
    _, pull = linear.observed.distances(geometry, ends_of(capture))
    rows = rows_of_functions(influence, *linear.observed.by_unknowns((relative @ pull)[None], p))
    # k = sum of weights m_i / n_i, with m_i measured and n_i certified: dk/dn_i = - (weight / n_i) m_i / n_i.
    by_lengths = -relative * scale.measured / scale.nominal
    of_lengths = xp.sum((by_lengths * ends.u) ** 2)
    u = xp.sqrt(solution.covariance_of(rows)[0, 0] + of_lengths + scale.surplus)
    return MeasuredScale(eqx.tree_at(lambda s: s.u, scale, u), rows, by_lengths, of_lengths)


def positions_at_ends(capture: Capture) -> list[str]:
    """Names of the positions at the ends of reference lengths."""
    return list(dict.fromkeys(name for pair in ends_of(capture) for name in pair))


def ends_between(
    observed: Observed, geometry: Float[AnyArray, " g"], own: Sequence[Float[AnyArray, "_ _ _"]], capture: Capture
) -> MeasuredEnds:
    """The ends of a capture's lengths; ``own`` are the covariances of components by a given arm, class by class."""
    xp, used, covariances = namespace(geometry), positions_at_ends(capture), []
    for name in used:
        number, component, first = observed.layout.component_of(int(observed.positions[name][0]))
        covariances.append(own[number][component, first : first + 3, first : first + 3])
    return MeasuredEnds(
        positions=xp.stack([geometry[observed.positions[name]] for name in used]),
        covariances=xp.stack(covariances),
        ends=np.array([[used.index(name) for name in pair] for pair in ends_of(capture)]),
        nominal=xp.stack([length.value for length in capture.lengths]),
        u=xp.stack([length.u for length in capture.lengths]),
    )


def divided(
    anchor: ScaleAnchor, bounds: Bounds, active: Int[AnyArray, "... p"], parameters: Any, k: Any
) -> tuple[Float[AnyArray, "*batch p"], Bool[AnyArray, "*batch"]]:
    """The parameters of stage 1 divided by k, of one problem or of a batch, and whether a bound or a fixed length
    stands against that; ``active`` is what was on a bound in stage 1."""
    space = bounds.space
    if not anchor.can_scale:
        return parameters, namespace(parameters).zeros(parameters.shape[:-1], dtype=bool)
    xp, scaled = namespace(parameters, k), divide_lengths(space, parameters, k, anchor.partners)
    lengths = np.broadcast_to(divisible(space), scaled.shape)
    below, above = _on_bounds(anchor, bounds, active, scaled)
    concerned = xp.ones_like(below) if anchor.partners is None else below | above
    against = xp.any(concerned & lengths, axis=-1) & xp.all(xp.isfinite(scaled), axis=-1)
    # Within the bounds, and on a bound that only rounding separates a length from: so short a step would not bring a
    # solve onto the bound, which then counts as inactive, in derivatives too.
    lower, upper = bounds.lower, bounds.upper
    inside = xp.clip(scaled, lower, upper)
    inside = xp.where(inside - lower <= _ROUNDING, lower, xp.where(upper - inside <= _ROUNDING, upper, inside))
    return xp.where(np.broadcast_to(space.lengths, scaled.shape), inside, scaled), against


def _on_bounds(
    anchor: ScaleAnchor, bounds: Bounds, active: Int[AnyArray, "... p"], scaled: Float[AnyArray, "... p"]
) -> tuple[Bool[AnyArray, "... p"], Bool[AnyArray, "... p"]]:
    """Which divided parameters are below their bounds, or were on the lower one in stage 1; and likewise above."""
    below, above = scaled < bounds.lower - _ROUNDING, scaled > bounds.upper + _ROUNDING
    if anchor.hold is None:  # without an anchor it is the active bounds that set the scale of stage 1
        return below, above
    return below | (active < 0), above | (active > 0)


def against_division(calibration: Calibration) -> tuple[str, ...]:
    """What stood against the division by k of a calibration in two stages, in words; nothing where it was divided."""
    if calibration.method != "two-stage" or bool(calibration.divided) or calibration.scale is None:
        return ()
    stage1, bounds = to_numpy((calibration.stage1, calibration.bounds))
    space, anchor = bounds.space, stage1.anchor
    scaled = divide_lengths(space, stage1.parameters, np.asarray(calibration.scale.value), anchor.partners)
    below, above = _on_bounds(anchor, bounds, stage1.active, scaled)
    concerned = np.flatnonzero((below | above) & divisible(space))
    names = [f"{space.names[i]} ({'upper' if above[i] else 'lower'} bound)" for i in concerned]
    if anchor.partners is None:
        names += [f"{name} (fixed length)" for name in fixed_lengths(space.base, space)]
        names += [f"q_{joint} (slide)" for joint in space.base.prismatic]
    return tuple(names)


def divided_uncertainty(
    solution: Solution, measured: MeasuredScale, parameters: Float[AnyArray, " p"]
) -> tuple[Float[AnyArray, "p p"], Components | None, list[Float[AnyArray, "p _ _"]]]:
    """Covariance of parameters that were divided by k, its parts, and how they follow the whitened rows of every block.

    x' = (x + r) / k - r for lengths, where r are the fixed lengths that x replaces (`model.scale.divide_lengths`), so
    dx' = dx / k - (x' + r) / k dk; a parameter that stage 1 held or that was on a bound moves with k too.
    """
    k, anchor, space = measured.scale.value, solution.identification.anchor, solution.identification.bounds.space
    xp = namespace(parameters, k)
    divides = xp.asarray(divisible(space) & anchor.can_scale)
    by_k = xp.where(divides, (parameters + replaced_lengths(space, anchor.partners)) / k, 0.0)
    change = xp.where(divides, 1 / k, 1.0)[:, None, None]
    pairs = zip(solution.rows_of_parameters(), measured.rows, strict=True)
    rows = [change * of_parameters - by_k[:, None, None] * of_k for of_parameters, of_k in pairs]
    of_k = by_k[:, None] * by_k[None, :]
    parts = {
        STATED: (measured.variance_of_lengths * of_k, np.inf),
        DISAGREEMENT: (measured.scale.surplus * of_k, max(len(measured.by_lengths) - 1, 1)),
    }
    return solution.covariance_of(rows) + measured.added * of_k, Components.of(parts), rows
