"""The stages of a calibration: the identification, its division by k, and the solve of everything at once.

`identified` is stage 1. It leaves the scale to its anchor, a length kept at its start, and k = measured / nominal is
its error. If no bound acts on a length, repeatability does not change with the scale, so the arm divided by k is the
result (`in_two_stages`); fixed lengths that free ones replace exactly (d_n by a probe along the same axis) can stay.
Where a bound or another fixed length stands against the division, everything that a capture holds is solved in one
least squares instead (`jointly`). Where fixed lengths set the scale by themselves, nothing is changed and k only
compares them with the reference lengths.

The division is a linear map of what stage 1 found, so its covariance is mapped along, with that of k, which follows the
certified lengths, and the same poses as the parameters do.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.numpy_or_jax import AnyArray, namespace, set_at, to_numpy
from ..data.capture import Capture
from ..kinematics.parameters import Bounds, Parameters
from ..model.observed import Observed, ends_of
from ..model.scale import MeasuredEnds, Scale, divide_lengths, divisible, replaced_lengths, scale_and_weights
from ..uncertainty.covariance import DISAGREEMENT, STATED
from ..uncertainty.degrees_of_freedom import Components
from ..uncertainty.linear_propagation import by_covariances, rows_of_functions
from ..uncertainty.linearisation import Linearisation, of_active_bounds
from .results import Calibration, Identification, ObservedMetrics
from .scale_anchor import ScaleAnchor, fixed_lengths, fixes_scale
from .solve import Solution, repeatability_of, solve
from .task import Task, state_at

_LEAST_U = 1e-9  # mm: an exact certified value would be a row of infinite weight
_ROUNDING = 1e-9  # mm: how far from a bound the division may leave a length by rounding


class Sensitivities(NamedTuple):
    """Derivatives of the parameters (mm and rad, in the order of ``space.names``) by errors of M poses, those of
    sockets first, and those of lengths between sockets' means."""

    tips: Float[np.ndarray, "p 3 M"]  # by displacements of the tip, mm
    joints: Float[np.ndarray, "p n M"]  # by errors of the joints, rad (mm of prismatic ones)
    lengths: Float[np.ndarray, "l 3 M"]  # of measured lengths by the tips, where positions of sockets are means

    @classmethod
    def of(
        cls, linear: Linearisation, rows: Sequence[AnyArray], of_lengths: Sequence[AnyArray] | None = None
    ) -> "Sensitivities":
        """Of parameters, and of lengths, that follow the whitened rows of every group so."""
        by_tips = [part.by_tip for part in linear.point.rows]

        def through(rows: Sequence[AnyArray], by: Sequence[AnyArray]) -> Float[np.ndarray, "q c M"]:
            # What follows the whitened rows, by what the residuals follow: dy = Y R dr, dr = B dc.
            groups = zip(rows, linear.whitening.roots, by, strict=False)
            products = [np.einsum("qam,mab,bcm->qcm", y, np.asarray(root), part) for y, root, part in groups]
            return np.concatenate(linear.observed.by_observation(products), axis=2)

        tips, joints = through(rows, by_tips), through(rows, [error.by_readings for error in linear.errors])
        return cls(tips, joints, tips[:0] if of_lengths is None else through(of_lengths, by_tips))


class MeasuredScale(NamedTuple):
    """k of stage 1, and how it follows the data."""

    scale: Scale
    rows: list[Float[AnyArray, "1 _ _"]]  # its derivatives by the whitened rows of every block
    stated: Float[AnyArray, ""]  # variance by the certified lengths; `Scale.surplus` is what their disagreement adds

    @property
    def added(self) -> Float[AnyArray, ""]:
        """What is added to the variance that follows from the poses."""
        return self.stated + self.scale.surplus


class Identified(NamedTuple):
    """Stage 1."""

    task: Task
    solution: Solution
    measured: MeasuredScale | None  # k, where the capture has reference lengths
    of_bounds: Float[AnyArray, "p p"]  # part of the covariance by active bounds


class Stages(NamedTuple):
    """A calibration, and how its parameters follow the data."""

    calibration: Calibration
    sensitivities: Callable[[], Sensitivities]
    stands_against: Bool[AnyArray, ""] | None = None  # whether something stands against the division by k


def identified(task: Task, capture: Capture) -> Identified:
    """Stage 1 of a capture, whose lengths take no part in ``task``; with k where there are any."""
    solution, of_bounds = _solved(task, capture)
    measured = measured_scale(solution, capture) if capture.lengths else None
    scale = None if measured is None else measured.scale
    identification = dataclasses.replace(solution.identification, scale=scale)
    return Identified(task, solution._replace(identification=identification), measured, of_bounds)


def _solved(
    task: Task, capture: Capture, near: Float[AnyArray, " p"] | None = None
) -> tuple[Solution, Float[AnyArray, "p p"]]:
    """A solve, with what active bounds add to the covariance, in which reference lengths say what the scale is."""
    solution = solve(task, near)
    linear, free, size = solution.linear, task.free, len(task.bounds.space.names)
    xp, active = namespace(linear.z), solution.identification.active[free]
    of_bounds = xp.zeros((size, size))
    if task.anchor.hold is None and not fixes_scale(capture) and task.prior is None:
        # Nothing determines the scale: it cannot be distinguished from a near-degenerate direction.
        return solution, of_bounds
    if capture.lengths and not (xp is np and not np.any(active)):
        # The linearisation of stage 1 with reference lengths besides.
        observed, p = Observed.of(capture, task.bounds.space.base), len(free)
        parts = linear.observed.split(linear.z[p:])
        z = xp.concatenate([linear.z[:p], *(parts[name] for name in observed.blocks)])
        weighing: dict[str, Any] = {"noise": task.noise, "sigma": solution.state.sigma, "loss": task.loss}
        linear = Linearisation.at(observed, linear.space, z, least=_LEAST_U, **weighing)
    box = Bounds(task.space, task.bounds.lower[free], task.bounds.upper[free])
    added = of_active_bounds(linear, active, box, solution.state.sigma)
    of_bounds = set_at(of_bounds, np.ix_(free, free), added)
    matrix = solution.identification.parameter_covariance.matrix + of_bounds
    where = lambda result: result.parameter_covariance.matrix  # noqa: E731
    return solution._replace(identification=eqx.tree_at(where, solution.identification, matrix)), of_bounds


def measured_scale(solution: Solution, capture: Capture) -> MeasuredScale:
    """k by the reference lengths of a capture, between positions that an identification has found.

    Its standard uncertainty includes that of the identified parameters, and takes those on a bound as exact.
    """
    linear, influence, p = solution.linear, solution.influence, len(solution.linear.space.names)
    geometry = linear.z[p:]
    xp, ends = namespace(linear.z), ends_between(linear.observed, geometry, influence.d_inverses, capture)
    scale, relative = scale_and_weights(ends)
    _, pull = linear.observed.distances(geometry, ends_of(capture))
    rows = rows_of_functions(influence, *linear.observed.by_unknowns((relative @ pull)[None], p))
    # k = sum of weights m_i / n_i, with m_i measured and n_i certified: dk/dn_i = - (weight / n_i) m_i / n_i.
    of_lengths = xp.sum((-relative * scale.measured / scale.nominal * ends.u) ** 2)
    u = xp.sqrt(solution.covariance_of(rows)[0, 0] + of_lengths + scale.surplus)
    return MeasuredScale(eqx.tree_at(lambda s: s.u, scale, u), rows, of_lengths)


def positions_at_ends(capture: Capture) -> list[str]:
    """Names of the positions at the ends of reference lengths."""
    return list(dict.fromkeys(name for pair in ends_of(capture) for name in pair))


def ends_between(
    observed: Observed, geometry: Float[AnyArray, " g"], by_class: Sequence[Float[AnyArray, "_ _ _"]], capture: Capture
) -> MeasuredEnds:
    """The ends of a capture's lengths; ``by_class`` are the covariances of components by a given arm."""
    xp, used, covariances = namespace(geometry), positions_at_ends(capture), []
    for name in used:
        number, component, first = observed.layout.component_of(int(observed.positions[name][0]))
        covariances.append(by_class[number][component, first : first + 3, first : first + 3])
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
        names += [f"q_{joint} (prismatic joint)" for joint in space.base.prismatic]
    return tuple(names)


def in_two_stages(stage1: Identified, capture: Capture) -> Stages:
    """Stage 1 divided by k; where something stands against that, it is not the result."""
    task, solution, measured, of_bounds = stage1
    assert measured is not None
    identification, bounds, k = solution.identification, task.bounds, measured.scale.value
    anchor, space = task.anchor, bounds.space
    parameters, against = divided(anchor, bounds, identification.active, identification.parameters, k)
    # x' = (x + r) / k - r for lengths, where r are the fixed lengths that x replaces (`model.scale.divide_lengths`), so
    # dx' = dx / k - (x' + r) / k dk; a parameter that stage 1 held or that was on a bound moves with k too.
    xp = namespace(parameters, k)
    divides = xp.asarray(divisible(space) & anchor.can_scale)
    by_k = xp.where(divides, (parameters + replaced_lengths(space, anchor.partners)) / k, 0.0)
    change = xp.where(divides, 1 / k, 1.0)[:, None, None]
    pairs = zip(solution.rows_of_parameters(), measured.rows, strict=True)
    rows = [change * of_parameters - by_k[:, None, None] * of_k for of_parameters, of_k in pairs]
    of_k = by_k[:, None] * by_k[None, :]
    disagreement = (measured.scale.surplus * of_k, max(len(measured.scale.nominal) - 1, 1))
    covariance = identification.parameter_covariance._replace(
        matrix=solution.covariance_of(rows) + measured.added * of_k + of_bounds,
        components=Components.of({STATED: (measured.stated * of_k, np.inf), DISAGREEMENT: disagreement}),
    )
    # At the divided arm, with the geometry that fits it; weights are those of the last solve. Rows are linear in the
    # positions, so that one step takes these to where they fit the divided arm.
    vector, at = parameters[task.free], Parameters(space.arm(parameters), solution.linear.space.names)
    z = xp.concatenate([vector, task.observed.start(at, vector)])
    weighing: dict[str, Any] = {"noise": task.noise, "sigma": solution.state.sigma, "least": _LEAST_U}
    z = Linearisation.at(task.observed, at, z, **weighing).with_fitted_geometry()
    state = state_at(task, at, z)
    after = repeatability_of(state, task.observed, state.sigma)
    result = dataclasses.replace(
        identification,
        arm=space.arm(parameters),
        parameters=parameters,
        de=after.de,
        deltam=after.deltam,
        active=bounds.active(parameters),
        parameter_covariance=covariance,
        after=after,
        observed=_divided_metrics(solution, measured, Linearisation.at(task.observed, at, z, **weighing)),
    )

    def sensitivities() -> Sensitivities:
        # Of measured lengths by the tips, where the arm is given and positions are means: with the inverse of the
        # head's information 0, the parameters follow nothing, and only the positions do.
        influence = solution.influence._replace(inverse=np.zeros_like(solution.influence.inverse))
        first, observed, p = solution.linear, solution.linear.observed, len(solution.linear.space.names)
        _, pull = observed.distances(np.asarray(first.z)[p:], ends_of(capture))
        of_lengths = rows_of_functions(influence, *observed.by_unknowns(pull, p))
        # The whitened rows are those of stage 1, whose arm is k times as large: so are displacements of its tip.
        of_stage1 = Sensitivities.of(first, rows, of_lengths)
        return of_stage1._replace(tips=np.asarray(k) * of_stage1.tips)

    return Stages(_calibration(task, capture, identification, result, "two-stage", True), sensitivities, against)


def _divided_metrics(solution: Solution, measured: MeasuredScale, linear: Linearisation) -> ObservedMetrics:
    """Of the observations by the divided arm.

    A position p above the base follows k too: p' = p / k, so cov p' = cov p / k^2 - c p'^T / k - p' c^T / k +
    var k p' p'^T / k^2, with c the covariance of p / k with k.
    """
    metrics, observed, k = solution.identification.observed, linear.observed, measured.scale.value
    xp, parts = namespace(linear.z), observed.split(linear.z[len(linear.space.names) :])
    # What is divided is counted from the foot of the second axis, where d_1 ends.
    can_scale = solution.identification.anchor.can_scale
    foot = xp.stack([xp.zeros(()), xp.zeros(()), linear.space.base.d[0]]) if can_scale else None
    variance = solution.covariance_of(measured.rows)[0, 0] + measured.added
    answer = solution.influence.response(by_covariances(measured.rows, solution.covariances))
    with_k = [part[..., 0] for part in answer[1]]  # covariance of private geometry with k, natural steps
    covariances = {}
    for name in observed.names:
        matrix = metrics.geometry_covariance[name]
        number, component, first = observed.layout.component_of(int(observed.positions[name][0]))
        if foot is not None and number >= 0:
            by_k = (parts[name] - foot) / k
            mixed = with_k[number][component, first : first + 3][:, None] * by_k[None, :] / k
            matrix = matrix / k**2 - mixed - mixed.T + variance * by_k[:, None] * by_k[None, :]
        covariances[name] = matrix
    squares = observed.by_observation(observed.squared_distances(linear.point.rows))
    white = [(xp.sum(rows**2, axis=0), rows.shape[0]) for rows in linear.white()]
    return dataclasses.replace(
        metrics,
        geometry={name: parts[name] for name in observed.names},
        geometry_covariance=covariances,
        rms_after=xp.stack([xp.sqrt(xp.mean(square)) for square in squares]),
        reduced_chi=xp.stack([xp.sqrt(xp.mean(square) / count) for square, count in white]),
    )


def jointly(task: Task, capture: Capture, stage1: Identified | None, method: str) -> Stages:
    """Everything that the capture holds in one least squares; ``stage1`` is where lengths alone fix the scale."""
    # The divided arm is near the solution, and saves most of the steps.
    near, first = None, stage1 and stage1.solution.identification
    if stage1 is not None and first is not None and stage1.measured is not None:
        k = stage1.measured.scale.value
        near = divided(stage1.task.anchor, task.bounds, first.active, first.parameters, k)[0]
    solution, _ = _solved(task, capture, near)
    result = solution.identification
    if first is not None:
        result = dataclasses.replace(result, steps=first.steps + result.steps)
    calibration = _calibration(task, capture, first or solution.identification, result, method, False)
    return Stages(calibration, lambda: Sensitivities.of(solution.linear, solution.rows_of_parameters()))


def _calibration(
    task: Task, capture: Capture, stage1: Identification, result: Identification, method: str, divided: bool
) -> Calibration:
    """With the fields of the last stage's result, and the lengths as its arm measures them."""
    xp, observed = namespace(result.parameters), task.observed
    geometry = xp.concatenate([result.observed.geometry[name] for name in observed.blocks])
    names = ("arm", "parameters", "de", "deltam", "active", "steps", "result", "parameter_covariance")
    return Calibration(
        **{name: getattr(result, name) for name in (*names, "before", "after", "observed")},
        scale=stage1.scale,
        length_after=observed.distances(geometry, ends_of(capture))[0],
        stage1=stage1,
        method=method,
        divided=xp.asarray(divided),
    )
