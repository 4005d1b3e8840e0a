"""The engine's solve: one least squares of the parameters and of every unknown geometry.

Solved at least twice where weights depend on the arm: with those of the start, and with those of that solution. Where
the noise is not given, tips are taken to scatter as much as the residuals then do (`tip_errors.scatter_of`). With a
prior the last solve is repeated until the weights agree with what it leads to (`prior_fit`).
"""

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, namespace, stop_gradient
from ..kinematics.priors import ParameterPrior
from ..model.elimination import Args, observed_model, observed_rows, with_linear_geometry
from ..model.robust import Loss
from ..model.rows import PointRows, Whitening
from ..solver.levenberg_marquardt import Rules
from .bounded_fit import NEAR, RULES, Fit, fit
from .conclusion import OfPrior, Solution, concluded
from .prior_fit import PriorProblem, fit_with_prior
from .solve_state import Begun, State, scatter_at_start, state_at, whitening_at
from .task import Task

_ROUGH = 1e-7  # tolerance of solves whose result only gives the weights of the next, or its start


def solve(task: Task, near: Float[AnyArray, " p"] | None = None) -> Solution:
    """The parameters and the unknown geometry that agree best with everything observed; from ``near``, where parameters
    close to the solution are known, else from the start."""
    xp, begun = namespace(task), begin(task, near)
    z, state, evaluations = begun.z, begun.state, xp.zeros((), dtype=int)
    losses, of_prior = losses_of(task), None
    for number, loss in enumerate(losses, 1):
        last = number == len(losses)
        prior = prior_of(task) if last else None
        if prior is not None:
            z, state, found, of_prior = fitted_with_prior(task, prior, begun, state, z)
        else:
            whitening = weights(task, begun, state, loss)
            args, count = args_of(task, whitening, loss, z)
            found = _fit(args, begun, z[:count], task, rules_of(number, len(losses)))
            z, point = with_linear_geometry(found.parameters, args)
            state = state_after(task, begun, z, point, last)
        evaluations = evaluations + found.steps
    return concluded(task, begun, z, state, found._replace(steps=evaluations), of_prior)


def begin(task: Task, near: Float[AnyArray, " p"] | None = None) -> Begun:
    """Where a solve begins: at the start, or near the solution."""
    xp, free, space = namespace(task), task.free, task.space
    (*sides, steps) = box_of(task)
    z = xp.concatenate([task.start[free], task.observed.start(space, task.start[free])])
    before = state = state_at(task, space, z, scatter_at_start(task, space, z))
    if near is not None:
        inside = xp.clip(near, task.bounds.lower, task.bounds.upper)[free]
        z = xp.concatenate([inside, task.observed.start(space, inside)])
        state = state_at(task, space, z)
    return Begun(space, (sides[0], sides[1]), steps, before, z, state)


def box_of(task: Task) -> tuple[Float[AnyArray, " z"], Float[AnyArray, " z"], Float[AnyArray, " z"]]:
    """Lower and upper bounds of all unknowns, of which the geometry has none, and their natural steps."""
    xp, steps = namespace(task), task.observed.steps
    endless = np.full(len(steps), np.inf)
    lower, upper = (side[task.free] for side in (task.bounds.lower, task.bounds.upper))
    scale = xp.concatenate([task.space.scale, xp.asarray(steps)])
    return xp.concatenate([lower, -endless]), xp.concatenate([upper, endless]), scale


def losses_of(task: Task) -> list[Loss | None]:
    """The losses of the solves, one after the other.

    Twice, the second time with the weights of a nearly right arm. Far from the solution a robust loss would see nothing
    but bad poses, so it begins where least squares ends, and one with several minima where Huber's, which has one,
    ends.
    """
    if task.loss is not None:
        return [None, Loss("huber"), task.loss, task.loss]
    return [None] if task.needs_no_weights else [None, None]


def rules_of(number: int, count: int) -> Rules:
    """When one of ``count`` solves ends, the first of which has the number 1."""
    rules = RULES if number == 1 else NEAR
    return rules if number == count else rules._replace(rtol=_ROUGH)


def weights(task: Task, begun: Begun, state: State, loss: Loss | None) -> Whitening:
    """Of the next least squares."""
    if task.needs_no_weights:
        return Whitening((None,) * len(task.observed.layout.groups), np.zeros(0), {})
    prior = prior_of(task)
    if prior is None:
        return whitening_at(task, state)
    problem = PriorProblem(task, begun.space, prior, begun.sides, begun.steps, loss, state)
    return whitening_at(task, state, problem.rows(problem.first_scales()))


def prior_of(task: Task) -> ParameterPrior | None:
    """The prior of the parameters that are free; None where nothing is known of any."""
    if task.prior is None:
        return None
    return task.prior.of(task.space.names, task.bounds.space.vector()[task.free])


def args_of(task: Task, whitening: Whitening, loss: Loss | None, z: Float[AnyArray, " z"]) -> tuple[Args, int]:
    """What one least squares is of, and how many unknowns it has: of z, those of components that rows are linear in
    come last and are none, but for a robust loss."""
    layout = task.observed.layout
    linear = sum(count * size for count, size in layout.classes[len(layout.classes) - layout.linear :])
    args = Args(task.space, task.observed, whitening, loss)
    if loss is not None or not linear:
        return args, z.shape[0]
    return args._replace(linear=stop_gradient(z[z.shape[0] - linear :])), z.shape[0] - linear


def _fit(args: Args, begun: Begun, z: Float[AnyArray, " n"], task: Task, rules: Rules) -> Fit:
    count = z.shape[0]
    sides, functions = (begun.sides[0][:count], begun.sides[1][:count]), (observed_rows, observed_model)
    options = {"rules": rules, "differentiable": task.differentiable}
    return fit(*functions, z, args, sides, begun.steps[:count], task.max_steps, **options)


def state_after(task: Task, begun: Begun, z: Float[AnyArray, " z"], point: PointRows, last: bool) -> State:
    """At the solution of a least squares; where the noise is given, only the last scatter matters, and its iteration
    costs as much as a few steps."""
    known = task.noise is not None and not last
    return state_at(task, begun.space, z, scatter_at_start(task, begun.space, z) if known else None, point=point)


def fitted_with_prior(
    task: Task, prior: ParameterPrior, begun: Begun, state: State, z: Float[AnyArray, " z"]
) -> tuple[Float[AnyArray, " z"], State, Fit, OfPrior]:
    """The last least squares with a prior, whose weights agree with what it leads to."""
    problem = PriorProblem(task, begun.space, prior, begun.sides, begun.steps, task.loss, state)
    scales, found = fit_with_prior(problem, z)
    z, rows = found.parameters, problem.rows(scales)
    metrics, effective, by_scales = problem.metrics(scales, z)
    state = state_at(task, begun.space, z, effective=effective)
    return z, state, found, OfPrior(rows, metrics, effective, by_scales)
