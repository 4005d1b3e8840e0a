"""The stages of a calibration: the identification, the division by k, and the solve of everything at once."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..core.numpy_or_jax import AnyArray, namespace, set_at
from ..data.capture import Capture
from ..data.observations.socket import position_of
from ..kinematics.parameters import Bounds, Parameters
from ..model.observed import Observed
from ..uncertainty.active_bounds import of_active_bounds
from ..uncertainty.linear_propagation import covariance_with, rows_of_functions
from ..uncertainty.linearisation import Linearisation
from .conclusion import Solution, repeatability_of
from .results import Calibration, ObservedMetrics
from .scale_fix import Division, ScaleFound, divided, divided_uncertainty, measured_scale
from .sensitivities import Sensitivities, sensitivities_of_rows, tips_of_rows
from .solve import solve
from .solve_state import state_at
from .task import Task


class Stages(NamedTuple):
    """A calibration, and how its parameters follow the data."""

    calibration: Calibration
    sensitivities: Callable[[], Sensitivities]
    stands_against: Bool[AnyArray, ""] | None = None  # whether something stands against the division by k


class Identified(NamedTuple):
    """Stage 1."""

    task: Task
    solution: Solution
    found: ScaleFound | None  # k, where the capture has reference lengths
    of_bounds: Float[AnyArray, "p p"]  # part of the covariance by active bounds


def identified(task: Task, capture: Capture) -> Identified:
    """Stage 1 of a capture, whose lengths take no part in ``task``; with k where there are any."""
    solution = solve(task)
    found = measured_scale(solution, capture) if capture.lengths else None
    identification = solution.identification
    of_bounds = _of_bounds(task, solution, capture)
    matrix = identification.parameter_covariance.matrix + of_bounds
    identification = eqx.tree_at(lambda one: one.parameter_covariance.matrix, identification, matrix)
    if found is not None:
        none = lambda leaf: leaf is None  # noqa: E731
        identification = eqx.tree_at(lambda one: one.scale, identification, found.scale, is_leaf=none)
    return Identified(task, solution._replace(identification=identification), found, of_bounds)


def _of_bounds(task: Task, solution: Solution, capture: Capture) -> Float[AnyArray, "p p"]:
    """What active bounds add to the covariance of stage 1, in which reference lengths say what the scale is."""
    free, size = task.free, len(task.bounds.space.names)
    scaled = task.anchor.hold is not None or capture.lengths or any(one.fixes_scale for one in capture.observations)
    xp = namespace(solution.linear.z)
    if not scaled and task.prior is None:
        # Nothing determines the scale: it cannot be distinguished from a near-degenerate direction.
        return xp.zeros((size, size))
    linear = solution.linear
    active = solution.identification.active[free]
    if capture.lengths and not (xp is np and not np.any(active)):
        linear = _with_lengths(task, solution, capture)
    added = of_active_bounds(linear, active, _reduced(task), solution.state.sigma)
    return set_at(xp.zeros((size, size)), np.ix_(free, free), added)


def _reduced(task: Task) -> Bounds:
    return Bounds(task.space, task.bounds.lower[task.free], task.bounds.upper[task.free])


def _with_lengths(task: Task, solution: Solution, capture: Capture) -> Linearisation:
    """The linearisation of stage 1 with reference lengths besides."""
    observed, old = Observed.of(capture, task.bounds.space.base), solution.linear
    parts = old.observed.split(old.z[len(task.free) :])
    xp = namespace(old.z)
    z = xp.concatenate([old.z[: len(task.free)], *(parts[name] for name in observed.blocks)])
    noise, sigma = task.noise, solution.state.sigma
    return Linearisation.at(observed, old.space, z, noise=noise, sigma=sigma, least=1e-9, loss=task.loss)


def in_two_stages(stage1: Identified, capture: Capture) -> Stages:
    """Stage 1 divided by k; where something stands against that, it is not the result."""
    task, solution, found, of_bounds = stage1
    assert found is not None
    identification, bounds, anchor, k = solution.identification, task.bounds, task.anchor, found.scale.value
    xp = namespace(identification)
    division = divided(anchor, bounds, identification.active, identification.parameters, k)
    uncertainty = divided_uncertainty(solution, found, anchor, division.parameters)
    covariance = identification.parameter_covariance._replace(
        matrix=uncertainty.covariance + of_bounds, components=uncertainty.components
    )
    arm, active = bounds.space.arm(division.parameters), bounds.active(division.parameters)
    linear = _divided_linearisation(task, solution, division)
    state = state_at(task, linear.space, linear.z)
    after = repeatability_of(state, task.observed, state.sigma)
    metrics = _divided_metrics(solution, found, linear, division)
    start = task.observed.split(task.observed.start(task.space, task.start[task.free]))
    calibration = Calibration(
        arm=arm,
        parameters=division.parameters,
        scale=found.scale,
        de=after.de,
        deltam=after.deltam,
        active=active,
        steps=identification.steps,
        result=identification.result,
        parameter_covariance=covariance,
        before=identification.before,
        after=after,
        length_before=measured_lengths(start, capture),
        length_after=measured_lengths(metrics.geometry, capture),
        stage1=identification,
        method="two-stage",
        observed=metrics,
        divided=xp.asarray(True),
    )

    def sensitivities() -> Sensitivities:
        return sensitivities_of_rows(linear, uncertainty.rows, _of_lengths(solution, capture))

    return Stages(calibration, sensitivities, division.stands_against)


def _divided_linearisation(task: Task, solution: Solution, division: Division) -> Linearisation:
    """At the divided arm, with the geometry that fits it; weights are those of the last solve."""
    xp, linear, state = namespace(division.parameters), solution.linear, solution.state
    space = Parameters(task.bounds.space.arm(division.parameters), linear.space.names)
    vector = division.parameters[task.free]
    z = xp.concatenate([vector, task.observed.start(space, vector)])
    first = Linearisation.at(task.observed, space, z, noise=task.noise, sigma=state.sigma, least=1e-9)
    point = first.with_fitted_geometry()
    return Linearisation.at(task.observed, space, point, noise=task.noise, sigma=state.sigma, least=1e-9)


def _divided_metrics(
    solution: Solution, found: ScaleFound, linear: Linearisation, division: Division
) -> ObservedMetrics:
    """Of the observations by the divided arm: p' = p / k for a position above the base, which follows k too."""
    metrics, observed, k = solution.identification.observed, linear.observed, found.scale.value
    xp, p = namespace(linear.z), len(linear.space.names)
    parts = observed.split(linear.z[p:])
    # What is divided is counted from the foot of the second axis, where d_1 ends.
    can_scale = solution.identification.anchor.can_scale
    foot = xp.stack([xp.zeros(()), xp.zeros(()), linear.space.base.d[0]]) if can_scale else None
    variance = solution.covariance_of(found.rows)[0, 0] + found.added
    _, with_k = covariance_with(solution.influence, found.rows, solution.covariances)
    covariances, geometry = {}, {}
    for name in observed.names:
        geometry[name], own = parts[name], metrics.geometry_covariance[name]
        of, component, first = observed.layout.component_of(int(observed.positions[name][0]))
        if foot is not None and of >= 0:
            by_k = (parts[name] - foot) / k
            mixed = with_k[of][component, first : first + 3][:, None] * by_k[None, :] / k
            own = own / k**2 - mixed - mixed.T + variance * by_k[:, None] * by_k[None, :]
        covariances[name] = own
    groups = len(observed.layout.groups)
    squares = observed.by_observation([xp.sum(rows.values[:3] ** 2, axis=0) for rows in linear.point.rows])
    white = observed.by_observation([xp.sum(block.white**2, axis=0) for block in linear.blocks[:groups]])
    return eqx.tree_at(
        lambda one: (one.geometry, one.geometry_covariance, one.rms_after, one.reduced_chi),
        metrics,
        (
            geometry,
            covariances,
            xp.stack([xp.sqrt(xp.mean(square)) for square in squares]),
            xp.stack([xp.sqrt(xp.mean(square) / 3) for square in white]),
        ),
    )


def _of_lengths(solution: Solution, capture: Capture) -> Float[np.ndarray, "l 3 M"]:
    """Derivatives of the measured lengths by the tips, where the arm is given and positions are means."""
    linear, influence = solution.linear, solution.influence._replace(inverse=np.zeros_like(solution.influence.inverse))
    observed, positions, p = linear.observed, linear.observed.positions, len(linear.space.names)
    count = len(capture.lengths)
    components = [np.zeros((count, *own.shape[:2])) for own in influence.own]
    for number, length in enumerate(capture.lengths):
        ends = [positions[position_of(name)] for name in (length.start, length.end)]
        between = np.asarray(linear.z[p + ends[1]] - linear.z[p + ends[0]])
        for rows, sign in zip(ends, (-1.0, 1.0), strict=True):
            of, component, first = observed.layout.component_of(int(rows[0]))
            components[of][number, component, first : first + 3] = sign * between / np.linalg.norm(between)
    rows = rows_of_functions(influence, np.zeros((count, linear.height)), components)
    return tips_of_rows(linear, rows)


def measured_lengths(parts: dict[str, Any], capture: Capture) -> Float[AnyArray, " l"]:
    """Distances between the positions at the ends of the reference lengths, mm."""
    pairs = [(parts[position_of(one.start)], parts[position_of(one.end)]) for one in capture.lengths]
    xp = namespace(parts)
    return xp.linalg.norm(xp.stack([end - start for start, end in pairs]), axis=1) if pairs else xp.zeros(0)


def jointly(task: Task, capture: Capture, stage1: Identified | None, method: str) -> Stages:
    """Everything that the capture holds in one least squares; ``stage1`` is where lengths alone fix the scale."""
    near = None
    if stage1 is not None and stage1.found is not None:
        identification = stage1.solution.identification
        near = divided(
            stage1.task.anchor, task.bounds, identification.active, identification.parameters, stage1.found.scale.value
        ).parameters
    solution = solve(task, near)
    found = solution.identification
    matrix = found.parameter_covariance.matrix + _of_bounds(task, solution, capture)
    found = eqx.tree_at(lambda one: one.parameter_covariance.matrix, found, matrix)
    first = found if stage1 is None else stage1.solution.identification
    start = task.observed.split(task.observed.start(task.space, task.start[task.free]))
    calibration = Calibration(
        arm=found.arm,
        parameters=found.parameters,
        scale=first.scale,
        de=found.de,
        deltam=found.deltam,
        active=found.active,
        steps=found.steps if stage1 is None else first.steps + found.steps,
        result=found.result,
        parameter_covariance=found.parameter_covariance,
        before=found.before,
        after=found.after,
        length_before=measured_lengths(start, capture),
        length_after=measured_lengths(found.observed.geometry, capture),
        stage1=first,
        method=method,
        observed=found.observed,
        divided=namespace(found.parameters).asarray(False),
    )

    def sensitivities() -> Sensitivities:
        linear, influence, p = solution.linear, solution.influence, len(found.parameters)
        free = len(linear.space.names)
        head = np.concatenate([np.eye(free), np.zeros((free, linear.height - free))], axis=1)
        head *= np.where(influence.fixed[:free], 0.0, linear.steps[:free])[:, None]
        components = [np.zeros((free, *own.shape[:2])) for own in influence.own]
        of_free = rows_of_functions(influence, head, components)
        rows = [set_at(np.zeros((p, *one.shape[1:])), task.free, one) for one in of_free]
        none = np.zeros((0, 3, task.observed.q.shape[0]))
        return sensitivities_of_rows(linear, rows, none)

    return Stages(calibration, sensitivities)
