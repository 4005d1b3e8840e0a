"""The stages of a calibration: the identification, its division by k, and the solve of everything at once.

`identified` is stage 1; `in_two_stages` divides it by k (`scale_fix`), and `jointly` solves everything that a capture
holds in one least squares. Both return a `Calibration`, and on demand how its parameters follow errors of its poses.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..core.numpy_or_jax import AnyArray, namespace, set_at
from ..data.capture import Capture
from ..kinematics.parameters import Bounds, Parameters
from ..model.observed import Observed, ends_of
from ..uncertainty.active_bounds import of_active_bounds
from ..uncertainty.linear_propagation import by_covariances, rows_of_functions
from ..uncertainty.linearisation import Linearisation
from .results import Calibration, Identification, ObservedMetrics
from .scale_anchor import fixes_scale
from .scale_fix import MeasuredScale, divided, divided_uncertainty, measured_scale
from .solve import Solution, repeatability_of, solve
from .task import Task
from .weighted_least_squares import state_at

_LEAST_U = 1e-9  # mm: an exact certified value would be a row of infinite weight


class Sensitivities(NamedTuple):
    """Derivatives of the parameters (mm and rad, in the order of ``space.names``) by errors of M poses, those of
    sockets first, and those of lengths between sockets' means."""

    tips: Float[np.ndarray, "p 3 M"]  # by displacements of the tip, mm
    joints: Float[np.ndarray, "p n M"]  # by errors of the joints, rad (mm of prismatic ones)
    lengths: Float[np.ndarray, "l 3 M"]  # of measured lengths by the tips, where positions of sockets are means

    @classmethod
    def of(
        cls, linear: Linearisation, rows: Sequence[Float[AnyArray, "p _ _"]], lengths: Float[np.ndarray, "l 3 M"]
    ) -> "Sensitivities":
        """Of parameters that follow the whitened rows of every group so."""
        by_readings = [error.by_readings for error in linear.errors]
        return cls(_by_tips(linear, rows), _through(linear, rows, by_readings), lengths)


def _by_tips(linear: Linearisation, rows: Sequence[Float[AnyArray, "q _ _"]]) -> Float[np.ndarray, "q 3 M"]:
    return _through(linear, rows, [part.by_tip for part in linear.point.rows])


def _through(
    linear: Linearisation, rows: Sequence[Float[AnyArray, "q _ _"]], by: Sequence[Float[AnyArray, "_ _ _"]]
) -> Float[np.ndarray, "q c M"]:
    """What follows the whitened rows so, by what the residuals follow ``by``: dy = Y R dr, dr = B dc."""
    groups = zip(rows, linear.whitening.roots, by, strict=False)
    products = [np.einsum("qam,mab,bcm->qcm", one, np.asarray(root), part) for one, root, part in groups]
    return np.concatenate(linear.observed.by_observation(products), axis=2)


class Stages(NamedTuple):
    """A calibration, and how its parameters follow the data."""

    calibration: Calibration
    sensitivities: Callable[[], Sensitivities]
    stands_against: Bool[AnyArray, ""] | None = None  # whether something stands against the division by k


class Identified(NamedTuple):
    """Stage 1."""

    task: Task
    solution: Solution
    measured: MeasuredScale | None  # k, where the capture has reference lengths
    of_bounds: Float[AnyArray, "p p"]  # part of the covariance by active bounds

    @property
    def identification(self) -> Identification:
        """Stage 1 as users see it."""
        return self.solution.identification


def identified(task: Task, capture: Capture) -> Identified:
    """Stage 1 of a capture, whose lengths take no part in ``task``; with k where there are any."""
    solution = solve(task)
    measured = measured_scale(solution, capture) if capture.lengths else None
    of_bounds = _of_bounds(task, solution, capture)
    identification = _with_bounds(solution.identification, of_bounds)
    scale = None if measured is None else measured.scale
    identification = dataclasses.replace(identification, scale=scale)
    return Identified(task, solution._replace(identification=identification), measured, of_bounds)


def _with_bounds(identification: Identification, of_bounds: Float[AnyArray, "p p"]) -> Identification:
    matrix = identification.parameter_covariance.matrix + of_bounds
    return eqx.tree_at(lambda result: result.parameter_covariance.matrix, identification, matrix)


def _of_bounds(task: Task, solution: Solution, capture: Capture) -> Float[AnyArray, "p p"]:
    """What active bounds add to the covariance of stage 1, in which reference lengths say what the scale is."""
    free, size = task.free, len(task.bounds.space.names)
    xp, linear = namespace(solution.linear.z), solution.linear
    if task.anchor.hold is None and not fixes_scale(capture) and task.prior is None:
        # Nothing determines the scale: it cannot be distinguished from a near-degenerate direction.
        return xp.zeros((size, size))
    active = solution.identification.active[free]
    if capture.lengths and not (xp is np and not np.any(active)):
        # The linearisation of stage 1 with reference lengths besides.
        observed, p = Observed.of(capture, task.bounds.space.base), len(free)
        parts = linear.observed.split(linear.z[p:])
        z = xp.concatenate([linear.z[:p], *(parts[name] for name in observed.blocks)])
        weighing: dict[str, Any] = {"noise": task.noise, "sigma": solution.state.sigma, "loss": task.loss}
        linear = Linearisation.at(observed, linear.space, z, least=_LEAST_U, **weighing)
    box = Bounds(task.space, task.bounds.lower[free], task.bounds.upper[free])
    added = of_active_bounds(linear, active, box, solution.state.sigma)
    return set_at(xp.zeros((size, size)), np.ix_(free, free), added)


def in_two_stages(stage1: Identified, capture: Capture) -> Stages:
    """Stage 1 divided by k; where something stands against that, it is not the result."""
    task, solution, measured, of_bounds = stage1
    assert measured is not None
    identification, bounds = solution.identification, task.bounds
    k = measured.scale.value
    parameters, against = divided(task.anchor, bounds, identification.active, identification.parameters, k)
    covariance, components, rows = divided_uncertainty(solution, measured, parameters)
    linear = _at_divided(task, solution, parameters)
    state = state_at(task, linear.space, linear.z)
    after = repeatability_of(state, task.observed, state.sigma)
    result = dataclasses.replace(
        identification,
        arm=bounds.space.arm(parameters),
        parameters=parameters,
        de=after.de,
        deltam=after.deltam,
        active=bounds.active(parameters),
        parameter_covariance=identification.parameter_covariance._replace(
            matrix=covariance + of_bounds, components=components
        ),
        after=after,
        observed=_divided_metrics(solution, measured, linear),
    )
    calibration = _calibration(task, capture, identification, result, "two-stage", True)

    def sensitivities() -> Sensitivities:
        # Of measured lengths by the tips, where the arm is given and positions are means: with the inverse of the
        # head's information 0, the parameters follow nothing, and only the positions do.
        influence = solution.influence._replace(inverse=np.zeros_like(solution.influence.inverse))
        found, observed, p = solution.linear, solution.linear.observed, len(solution.linear.space.names)
        _, pull = observed.distances(np.asarray(found.z)[p:], ends_of(capture))
        of_lengths = _by_tips(found, rows_of_functions(influence, *observed.by_unknowns(pull, p)))
        return Sensitivities.of(linear, rows, of_lengths)

    return Stages(calibration, sensitivities, against)


def _calibration(
    task: Task, capture: Capture, stage1: Identification, result: Identification, method: str, divided: bool
) -> Calibration:
    """With the fields of the last stage's result, and the measured lengths before and after."""
    observed, ends = task.observed, ends_of(capture)
    start = observed.start(task.space, task.start[task.free])
    geometry = namespace(start).concatenate([result.observed.geometry[name] for name in observed.blocks])
    names = ("arm", "parameters", "de", "deltam", "active", "steps", "result", "parameter_covariance")
    return Calibration(
        **{name: getattr(result, name) for name in (*names, "before", "after", "observed")},
        scale=stage1.scale,
        length_before=observed.distances(start, ends)[0],
        length_after=observed.distances(geometry, ends)[0],
        stage1=stage1,
        method=method,
        divided=namespace(result.parameters).asarray(divided),
    )


def _at_divided(task: Task, solution: Solution, parameters: Float[AnyArray, " p"]) -> Linearisation:
    """At the divided arm, with the geometry that fits it; weights are those of the last solve."""
    names, vector = solution.linear.space.names, parameters[task.free]
    space = Parameters(task.bounds.space.arm(parameters), names)
    z = namespace(parameters).concatenate([vector, task.observed.start(space, vector)])
    weighing: dict[str, Any] = {"noise": task.noise, "sigma": solution.state.sigma, "least": _LEAST_U}
    # Rows are linear in the positions, so that one step takes these to where they fit the divided arm.
    z = Linearisation.at(task.observed, space, z, **weighing).with_fitted_geometry()
    return Linearisation.at(task.observed, space, z, **weighing)


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
    squares = observed.by_observation([xp.sum(rows.values[:3] ** 2, axis=0) for rows in linear.point.rows])
    white = [xp.sum(rows**2, axis=0) for rows in linear.white()]
    return dataclasses.replace(
        metrics,
        geometry={name: parts[name] for name in observed.names},
        geometry_covariance=covariances,
        rms_after=xp.stack([xp.sqrt(xp.mean(square)) for square in squares]),
        reduced_chi=xp.stack([xp.sqrt(xp.mean(square) / 3) for square in white]),
    )


def jointly(task: Task, capture: Capture, stage1: Identified | None, method: str) -> Stages:
    """Everything that the capture holds in one least squares; ``stage1`` is where lengths alone fix the scale."""
    # The divided arm is near the solution, and saves most of the steps.
    near = None
    if stage1 is not None and stage1.measured is not None:
        first, k = stage1.identification, stage1.measured.scale.value
        near = divided(stage1.task.anchor, task.bounds, first.active, first.parameters, k)[0]
    solution = solve(task, near)
    result = _with_bounds(solution.identification, _of_bounds(task, solution, capture))
    first = result
    if stage1 is not None:
        first = stage1.identification
        result = dataclasses.replace(result, steps=first.steps + result.steps)
    calibration = _calibration(task, capture, first, result, method, False)

    def sensitivities() -> Sensitivities:
        none = np.zeros((0, 3, task.observed.q.shape[0]))
        return Sensitivities.of(solution.linear, solution.rows_of_parameters(), none)

    return Stages(calibration, sensitivities)
