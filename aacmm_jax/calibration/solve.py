"""The engine's solve: one least squares of the parameters and of every unknown geometry, and its uncertainty."""

from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, added_to, compiled, namespace, set_at, stop_gradient
from ..data.noise import Noise
from ..kinematics.parameters import Bounds
from ..model.elimination import Args, observed_model, observed_rows, with_linear_geometry
from ..model.metrics import Repeatability, no_repeatability, repeatability
from ..model.observed import Observed
from ..model.robust import Loss
from ..model.rows import Whitening
from ..solver.levenberg_marquardt import Rules
from ..uncertainty.covariance import ParameterCovariance
from ..uncertainty.linear_propagation import (
    Influence,
    UnknownsCovariance,
    alone,
    covariance_of_rows,
    geometry_covariance,
    of_shared_readings,
    propagated,
    row_covariances,
)
from ..uncertainty.linearisation import Linearisation
from ..uncertainty.variance_components import Moments, moments, noise_from
from .bounded_fit import RULES, Fit, fit
from .prior_fit import PriorProblem, fit_with_prior
from .results import Identification, ObservedMetrics
from .solve_state import State, scatter_at_start, state_at, whitening_at
from .task import Task

# Of the solves whose result only gives the weights of the next, or its start: a few standard uncertainties' millionths.
_ROUGH = RULES._replace(rtol=1e-5)


class Solution(NamedTuple):
    """An identification, and what its uncertainty follows from."""

    identification: Identification
    linear: Linearisation
    influence: Influence
    covariances: list[Float[AnyArray, "r r m"]]  # of the whitened rows of every group
    reading: list[np.ndarray]  # number of the reading of each pose of each group; equal ones were read at once
    state: State

    def covariance_of(self, rows: list[Float[AnyArray, "q r m"]]) -> Float[AnyArray, "q q"]:
        """Of functions that follow the rows of every block so."""
        identification = self.identification
        total = covariance_of_rows(rows, self.covariances)
        if identification.noise_model == "robust":
            return total
        shared = of_shared_readings(rows, self.state.errors, self.linear.whitening, identification.noise, self.reading)
        return total if shared is None else total + shared


@compiled(jit=eqx.filter_jit)
def identify_task(task: Task) -> Identification:
    """The identification of a task alone."""
    return solve(task).identification


def solve(task: Task, near: Float[AnyArray, " p"] | None = None) -> Solution:
    """The parameters and the unknown geometry that agree best with everything observed; from ``near``, where parameters
    close to the solution are known, else from the start.

    Solved at least twice where weights depend on the arm: with those of the start, and with those of that solution.
    Where the noise is not given, tips are taken to scatter as much as the residuals then do (`tip_errors.scatter_of`).
    With a prior the last solve is repeated until the weights agree with what it leads to (`prior_fit`).
    """
    xp = namespace(task)
    names, free, space = task.bounds.space.names, task.free, task.space
    p = len(free)
    geometry = task.observed.start(space, task.start[free])
    count, endless = geometry.shape[0], xp.full(geometry.shape, np.inf)
    sides = (
        xp.concatenate([task.bounds.lower[free], -endless]),
        xp.concatenate([task.bounds.upper[free], endless]),
    )
    steps = xp.concatenate([space.scale, xp.asarray(task.observed.steps)])
    first = xp.concatenate([task.start[free], geometry])
    before = state_at(task, space, first, scatter_at_start(task, space, first))
    z, evaluations, state, found = first, xp.zeros((), dtype=int), before, None
    if near is not None:
        near = xp.clip(near, task.bounds.lower, task.bounds.upper)[free]
        z = xp.concatenate([near, task.observed.start(space, near)])
        state = state_at(task, space, z)
    # Once more with the weights of a nearly right arm. Far from the solution a robust loss would see nothing but bad
    # poses, so it begins where least squares ends, and one with several minima where Huber's, which has one, ends.
    losses = [None] * (1 if task.needs_no_weights else 2)
    losses = losses if task.loss is None else [None, Loss("huber"), task.loss, task.loss]
    prior = None if task.prior is None else task.prior.of(space.names, task.bounds.space.vector()[free])
    rows, of_prior, effective, by_scales = None, None, None, None
    for number, loss in enumerate(losses, 1):
        if prior is not None:
            problem = PriorProblem(task, space, prior, sides, steps, loss, state)
            scales = problem.first_scales()
            rows = problem.rows(scales)
            if number == len(losses):
                scales, found = fit_with_prior(problem, z)
                z, evaluations, rows = found.parameters, evaluations + found.steps, problem.rows(scales)
                of_prior, effective, by_scales = problem.metrics(scales, z)
                state = state_at(task, space, z, effective=effective)
                break
        whitening = unweighted(task) if task.needs_no_weights else whitening_at(task, state, rows)
        rules = RULES if number == len(losses) else _ROUGH
        z, found = _fitted(Args(space, task.observed, whitening, loss), z, sides, steps, task, rules)
        evaluations = evaluations + found.steps
        # Where the noise is given, only the last scatter matters, and its iteration costs as much as a few steps.
        known = task.noise is not None and number < len(losses)
        state = state_at(task, space, z, scatter_at_start(task, space, z) if known else None)
    assert found is not None
    whitening = whitening_at(task, state, rows)
    active = Bounds(space, *(side[:p] for side in sides)).active(z[:p])
    linear = Linearisation.of(task.observed, space, z, state.point, state.errors, whitening, task.loss)
    influence = linear.influence(xp.concatenate([active != 0, xp.zeros(count, dtype=bool)]))
    noise = _noise_of(task, linear, influence, state)
    covariances, shared, reading = _of_rows(task, linear, influence, noise)
    added = None if by_scales is None else by_scales.added(influence.inverse)
    unknowns = propagated(influence, covariances, shared, whitening.prior, added)
    matrix = unknowns.head[:p, :p] * steps[:p, None] * steps[:p]
    covariance = ParameterCovariance(matrix, influence.determined[:p], influence.lost[:p, :p], noise)
    parameters = set_at(task.start, free, z[:p])
    arm = task.bounds.space.arm(parameters)
    spent = p + count if effective is None else effective
    metrics = observed_metrics(task, before, state, linear, of_geometry(linear, influence, unknowns), spent)
    identification = Identification(
        arm=arm,
        parameters=parameters,
        de=metrics[1].de,
        deltam=metrics[1].deltam,
        active=set_at(xp.zeros(len(names), dtype=active.dtype), free, active),
        steps=evaluations,
        result=found.result,
        optimality=found.optimality,
        scale=None,
        parameter_covariance=_expanded(covariance, free, len(names)),
        before=metrics[0],
        after=metrics[1],
        reduced_chi=metrics[2].reduced_chi_of_all if task.noise is not None else None,
        bounds=task.bounds,
        anchor=task.anchor,
        noise_model=task.noise_model,
        fitted_degrees_of_freedom=_degrees_of_freedom(task, p + count),
        observed=metrics[2],
        prior_metrics=of_prior,
    )
    return Solution(identification, linear, influence, covariances, reading, state)


def unweighted(task: Task) -> Whitening:
    """Of a problem whose rows all weigh the same."""
    return Whitening((None,) * len(task.observed.layout.groups), np.zeros(0), {})


def _fitted(
    args: Args,
    z: Float[AnyArray, " z"],
    sides: tuple[Float[AnyArray, " z"], Float[AnyArray, " z"]],
    steps: Float[AnyArray, " z"],
    task: Task,
    rules: Rules,
) -> tuple[Float[AnyArray, " z"], Fit]:
    """One least squares from a point; components that rows are linear in are no unknowns of it, but of a robust one."""
    layout = args.observed.layout
    linear = sum(count * size for count, size in layout.classes[len(layout.classes) - layout.linear :])
    count = z.shape[0] - (linear if args.loss is None else 0)
    if count < z.shape[0]:
        args = args._replace(linear=stop_gradient(z[count:]))
    sides = sides[0][:count], sides[1][:count]
    functions = observed_rows, observed_model
    found = fit(
        *functions, z[:count], args, sides, steps[:count], task.max_steps, rules=rules,
        differentiable=task.differentiable,
    )  # fmt: skip
    if args.linear is None:
        return found.parameters, found
    return with_linear_geometry(found.parameters, args), found


def _degrees_of_freedom(task: Task, unknowns: int) -> float:
    """Of a noise model: of all equations, or of poses where each has a variance of its own."""
    if task.noise_model == "given":
        return float("inf")
    spare = float(task.observed.equations - unknowns)
    if task.noise_model == "robust":
        spare *= task.observed.q.shape[0] / task.observed.equations
    return max(spare, 1.0)


def _noise_of(task: Task, linear: Linearisation, influence: Influence, state: State) -> Noise:
    """The noise of the tips' errors by the noise model: given, or estimated."""
    xp, whitening = namespace(linear.z), linear.whitening
    if task.noise_model == "given":
        assert task.noise is not None
        return task.noise
    if task.noise_model == "estimated":
        prior = None
        if whitening.prior is not None:
            own = np.arange(whitening.prior.mean.shape[0])
            squares = (whitening.prior.weight * linear.steps[own] * ~influence.fixed[own]) ** 2
            prior = added_to(xp.zeros((linear.height, linear.height)), (own, own), squares)
        robust = task.loss is not None
        return noise_from(moments(influence, state.point.rows, state.errors, whitening, state.sigma, robust, prior))
    return noise_from(Moments(xp.zeros(()), state.sigma**2))


def _of_rows(
    task: Task, linear: Linearisation, influence: Influence, noise: Noise
) -> tuple[list[Float[AnyArray, "r r m"]], Float[AnyArray, "h h"] | None, list[np.ndarray]]:
    """Covariances of the whitened rows of every pose, what shared readings add to the information that these make, and
    the number of the reading of each pose."""
    number = np.array(task.pose)
    groups = task.observed.layout.groups
    reading = [number[group.index] for group in groups]
    if task.noise_model == "robust":
        return alone(influence, len(groups)), None, reading
    covariances = row_covariances(linear.point.rows, linear.errors, linear.whitening, noise)
    rows = [influence.weighted_rows(number) for number in range(len(groups))]
    return covariances, of_shared_readings(rows, linear.errors, linear.whitening, noise, reading), reading


def of_geometry(
    linear: Linearisation, influence: Influence, covariance: UnknownsCovariance
) -> dict[str, Float[AnyArray, "_ _"]]:
    """Of each part; NaN for what the data leave open, such as the turn of a ball bar about itself."""
    xp, observed, p = namespace(covariance), linear.observed, len(linear.space.names)
    layout, found = observed.layout, {}
    for name, rows in observed.positions.items():
        of, component, first = layout.component_of(int(rows[0]))
        if of is None:
            known = influence.determined[p + rows]
        else:
            known = ~influence.open[of][component, first : first + len(rows)]
        matrix = geometry_covariance(layout, covariance, p, rows) * np.outer(*(observed.steps[rows],) * 2)
        found[name] = xp.where(known[:, None] & known[None, :], matrix, np.nan)
    return found


def _expanded(covariance: ParameterCovariance, free: np.ndarray, size: int) -> ParameterCovariance:
    """With the scale anchor, which is exact."""
    xp = namespace(covariance)
    grid = np.ix_(free, free)
    return ParameterCovariance(
        set_at(xp.zeros((size, size)), grid, covariance.matrix),
        set_at(xp.ones(size, dtype=bool), free, covariance.determined),
        set_at(xp.zeros((size, size)), grid, covariance.open),
        covariance.noise,
    )


def observed_metrics(
    task: Task,
    before: State,
    after: State,
    linear: Linearisation,
    covariance: dict[str, Float[AnyArray, "_ _"]],
    spent: Any,
) -> tuple[Repeatability, Repeatability, ObservedMetrics]:
    """Repeatability of the sockets, and how far each observation is from its geometry; ``spent`` is how many unknowns
    the data determine."""
    xp, observed = namespace(after.sigma), task.observed
    groups, rms = len(observed.layout.groups), []
    squares = [xp.sum(block.white**2, axis=0) for block in linear.blocks[:groups]]
    weights = [
        xp.ones(square.shape) if weight is None else weight
        for square, weight in zip(squares, linear.weights, strict=False)
    ]
    each = zip(observed.by_observation(squares), observed.observations, strict=True)
    chi = [xp.sqrt(xp.mean(square) / one.rows) for square, one in each]
    total = sum(xp.sum(square) for square in squares)
    for state in (before, after):
        distances = observed.by_observation([xp.sum(rows.values[:3] ** 2, axis=0) for rows in state.point.rows])
        rms.append(xp.stack([xp.sqrt(xp.mean(square)) for square in distances]))
    degrees_of_freedom = xp.maximum(xp.asarray(observed.equations - spent, dtype=float), 1.0)
    parts = observed.split(linear.z[len(linear.space.names) :])
    metrics = ObservedMetrics(
        names=tuple(observation.name for observation in observed.observations),
        kinds=tuple(observation.kind for observation in observed.observations),
        rms_before=rms[0],
        rms_after=rms[1],
        reduced_chi=xp.stack(chi),
        reduced_chi_of_all=xp.sqrt(total / degrees_of_freedom),
        sigma=after.sigma,
        geometry={name: parts[name] for name in observed.names},
        geometry_covariance={name: covariance[name] for name in observed.names},
        weights=tuple(observed.by_observation(weights)),
    )
    return repeatability_of(before, observed), repeatability_of(after, observed, after.sigma), metrics


def repeatability_of(state: State, observed: Observed, sigma: Float[AnyArray, ""] | None = None) -> Repeatability:
    """Of the tips in sockets, NaN where there is none; ``sigma`` is the scatter of a tip coordinate as it is known."""
    each = zip(observed.observations, observed.slices, strict=True)
    slices = [rows for one, rows in each if one.kind == "socket"]
    xp = namespace(state.sigma)
    if not slices:
        return no_repeatability(state.sigma)
    tip = state.point.forward.tip
    tips = xp.concatenate([tip[:, rows] for rows in slices], axis=1)
    found = repeatability(tips.T, tuple(rows.stop - rows.start for rows in slices))
    return found if sigma is None else eqx.tree_at(lambda r: r.sigma, found, sigma)
