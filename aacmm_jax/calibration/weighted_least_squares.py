"""One weighted least squares: its unknowns and their box, the weights by the state of an arm, and its steps.

The unknowns z are the free parameters, then the unknown geometry. Rows are whitened by the covariance of what was
measured plus that of the tips' errors, which depends on the arm (`state_at`, `whitening_at`). So a problem is solved at
least twice: with the weights of the start, and with those of that solution. Where the noise is not given, tips are
taken to scatter as much as the residuals of the last solve do (`tip_errors.scatter_of`).
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.numpy_or_jax import AnyArray, namespace, stop_gradient
from ..data.observations.observation import Rows
from ..kinematics.chain import ForwardPass
from ..kinematics.parameters import Parameters
from ..model.elimination import Args, observed_model, observed_rows
from ..model.robust import Loss
from ..model.rows import PointRows, PriorRows, Whitening, rows_at, whitening_of
from ..solver.levenberg_marquardt import Rules, minimise
from ..solver.reason import GRADIENT, Reason, reasons
from ..uncertainty.tip_errors import (
    ArmErrors,
    arm_errors,
    covariance_of_noise,
    covariance_of_sigma,
    robust_scatter_of,
    root_of_sum,
    scatter_of,
)
from .task import Task

# The boxes of this problem are small against its curvature, so the first steps can be nearly Gauss-Newton's.
RULES = Rules(rtol=1e-13, initial_damping=1e-8)
# Of solves that begin where one with nearly the same weights ended: damping would shorten steps that are right.
NEAR = RULES._replace(initial_damping=1e-11)
_ROUGH = 1e-7  # tolerance of solves whose result only gives the weights of the next, or its start
_LEAST = 1e-4  # smallest standard uncertainty of what is certified, of a tip coordinate's standard deviation


class State(NamedTuple):
    """Everything at one point of a solve."""

    point: PointRows
    errors: list[ArmErrors]
    sigma: Float[AnyArray, ""]  # standard deviation of a tip coordinate, mm


class Begun(NamedTuple):
    """Where a solve begins."""

    space: Parameters
    sides: tuple[Float[AnyArray, " z"], Float[AnyArray, " z"]]  # bounds of all unknowns
    steps: Float[AnyArray, " z"]  # natural steps
    before: State  # at the start
    z: Float[AnyArray, " z"]  # where it begins: there, or near the solution
    state: State  # there


class Fit(NamedTuple):
    """Result of one least squares."""

    parameters: Float[AnyArray, " n"]
    steps: Int[AnyArray, ""]  # evaluations
    result: Reason
    optimality: Float[AnyArray, ""]


def begin(task: Task, near: Float[AnyArray, " p"] | None = None) -> Begun:
    """At the start, or at parameters near the solution."""
    xp, observed, space = namespace(task), task.observed, task.space

    def unknowns(vector: Float[AnyArray, " p"]) -> Float[AnyArray, " z"]:
        geometry = observed.start(space, vector)
        if task.kept:
            parts = observed.split(geometry) | dict(task.kept)
            geometry = xp.concatenate([parts[name] for name in observed.blocks])
        return xp.concatenate([vector, geometry])

    lower, upper, steps = box_of(task)
    z = unknowns(task.start[task.free])
    point = rows_at(space, observed, z)
    before = state = state_at(task, space, z, _root_mean_square(point.rows), point=point)
    if near is not None:
        z = unknowns(xp.clip(near, task.bounds.lower, task.bounds.upper)[task.free])
        state = state_at(task, space, z)
    return Begun(space, (lower, upper), steps, before, z, state)


def box_of(task: Task) -> tuple[Float[AnyArray, " z"], Float[AnyArray, " z"], Float[AnyArray, " z"]]:
    """Lower and upper bounds of all unknowns, of which the geometry has none unless it is kept; natural steps."""
    xp, observed, kept = namespace(task), task.observed, task.kept
    lower, upper = (side[task.free] for side in (task.bounds.lower, task.bounds.upper))
    endless = [np.full(len(observed.steps), np.inf)]
    below, above = [-endless[0]], endless
    if kept:
        of_parts = [(kept.get(name), np.full(len(units), np.inf)) for name, units in observed.blocks.items()]
        below, above = ([s * free if own is None else own for own, free in of_parts] for s in (-1.0, 1.0))
    steps = xp.concatenate([task.space.scale, xp.asarray(observed.steps)])
    return xp.concatenate([lower, *below]), xp.concatenate([upper, *above]), steps


def losses_of(task: Task) -> list[Loss | None]:
    """The losses of the solves, one after the other.

    Far from the solution a robust loss would see nothing but bad poses, so it begins where least squares ends, and one
    with several minima where Huber's, which has one, ends.
    """
    if task.loss is not None:
        return [None, Loss("huber"), task.loss, task.loss]
    return [None] if task.needs_no_weights else [None, None]


def rules_of(number: int, count: int) -> Rules:
    """When one of ``count`` solves ends, the first of which has the number 1."""
    rules = RULES if number == 1 else NEAR
    return rules if number == count else rules._replace(rtol=_ROUGH)


def state_at(
    task: Task,
    space: Parameters,
    z: Float[AnyArray, " z"],
    sigma: Any = None,
    effective: Float[AnyArray, ""] | int | None = None,
    point: PointRows | None = None,
) -> State:
    """The state at a point, whose rows may be known (``point``); ``sigma`` is estimated unless it is given, and
    ``effective`` is how many unknowns the data determine, by default all that are fitted."""
    point = rows_at(space, task.observed, z) if point is None else point
    # Where a batch needs no weights, nobody asks for errors.
    errors = arm_errors(point, task.observed) if isinstance(point.forward, ForwardPass) else []
    if sigma is None:
        xp = namespace(z, effective)
        spent = task.fitted.sum() if effective is None else effective
        degrees_of_freedom = xp.maximum(xp.asarray(task.observed.equations - spent, dtype=float), 1.0)
        if task.needs_no_weights:
            squares: Any = sum(xp.sum(part.values**2) for part in point.rows)
            sigma = root_of_sum(squares / degrees_of_freedom)
        else:
            scatter = scatter_of if task.loss is None else robust_scatter_of
            sigma = scatter(point.rows, errors, degrees_of_freedom)
    return State(point, errors, sigma)


def state_after(task: Task, begun: Begun, z: Float[AnyArray, " z"], point: PointRows, last: bool) -> State:
    """At the solution of a least squares; where the noise is given, only the last scatter matters, and its iteration
    costs as much as a few steps."""
    sigma = _root_mean_square(point.rows) if task.noise is not None and not last else None
    return state_at(task, begun.space, z, sigma, point=point)


def _root_mean_square(rows: list[Rows]) -> Any:
    """Of the residuals in mm, for the first weights."""
    xp = namespace([part.values for part in rows])
    flat = xp.concatenate([xp.reshape(part.values[:3], (-1,)) for part in rows])
    return xp.sqrt(xp.mean(flat**2)) + 1e-9


def whitening_at(task: Task, state: State, prior: PriorRows | None = None) -> Whitening:
    """The weights of everything by the state of a nearly right arm."""
    if task.noise is None:
        of_arm = [covariance_of_sigma(errors, state.sigma) for errors in state.errors]
    else:
        of_arm = [covariance_of_noise(errors, task.noise) for errors in state.errors]
    least = namespace(state.sigma).maximum(_LEAST * state.sigma, 1e-12)
    return whitening_of(state.point.rows, task.observed, of_arm, least)._replace(prior=prior)


def args_of(task: Task, whitening: Whitening, loss: Loss | None, z: Float[AnyArray, " z"]) -> tuple[Args, int]:
    """What one least squares is of, and how many unknowns it has: of z, those of components that rows are linear in
    come last and are none, but for a robust loss, or where some of them are kept."""
    layout = task.observed.layout
    linear = sum(count * size for count, size in layout.classes[len(layout.classes) - layout.linear :])
    args = Args(task.space, task.observed, whitening, loss)
    first = z.shape[0] - linear
    if loss is not None or not linear or not task.fitted[first:].all():
        return args, z.shape[0]
    return args._replace(linear=stop_gradient(z[first:])), first


def fit(
    task: Task,
    args: Args,
    z: Float[AnyArray, " n"],
    begun: Begun,
    rules: Rules,
    *,
    steps: Float[AnyArray, " n"] | None = None,
    differentiable: bool | None = None,
) -> Fit:
    """A least squares within bounds: by Optimistix for arrays of JAX, unless no derivative is needed; else by its bare
    steps. ``steps`` scale the unknowns, by default in their natural units."""
    xp, count = namespace(z, args, begun.sides), z.shape[0]
    if not task.fitted[:count].any():
        return Fit(z, xp.zeros((), dtype=int), reasons(xp.asarray(GRADIENT)), xp.zeros(()))
    (lower, upper), scale = (side[:count] for side in begun.sides), (begun.steps if steps is None else steps)[:count]
    box: dict[str, Any] = {"lower": lower, "upper": upper, "scale": scale, "max_steps": task.max_steps}
    if xp is np or not (task.differentiable if differentiable is None else differentiable):
        last = minimise(observed_model, z, args, rules=rules, **box)
        return Fit(last.y, last.steps, reasons(last.reason), last.optimality)
    # Optimistix takes 0.2 s to import, and NumPy needs none of it.
    from ..solver.bounded import BoundedLevenbergMarquardt, least_squares

    solver = BoundedLevenbergMarquardt(**rules._asdict())
    solution = least_squares(observed_rows, z, args, normal=observed_model, solver=solver, throw=False, **box)
    stats = solution.stats
    return Fit(solution.value, stats["num_steps"], stats["reason"], stats["optimality"])
