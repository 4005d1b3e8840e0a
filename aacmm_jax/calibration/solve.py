"""The engine's solve: the parameters and every unknown geometry that agree best with all that was observed.

`solve` runs the least squares of a task in turn (`task.solves_of`; with a prior the last of them is repeated until the
weights agree with what it leads to, `prior_fit`), and concludes: at the solution the problem is linear, with whitened
rows w = w0 + A^T dx, so errors e of the rows move the unknowns by dx = -G A W e, where A has a row for each unknown
(private geometry is eliminated from it: A~ of `model.elimination`), and G is the inverse of the information A W A^T
(`uncertainty.linear_propagation`). The covariance of the unknowns follows from that of the rows,
which is that of the given noise, or of noise estimated from the residuals.

Example, of the parameters of stage 1 and their standard uncertainties:
    solution = solve(task_of(arm, without_lengths(capture), bounds, Solving()))
    solution.identification.parameters, jnp.sqrt(jnp.diag(solution.identification.covariance))
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, added_to, namespace, set_at
from ..data.noise import Noise
from ..kinematics.parameters import Bounds
from ..model.elimination import with_linear_geometry
from ..model.observed import Observed
from ..model.sockets import Repeatability, no_repeatability, repeatability
from ..uncertainty import linear_propagation as propagation
from ..uncertainty.covariance import STATED, ParameterCovariance
from ..uncertainty.degrees_of_freedom import Components
from ..uncertainty.linearisation import Linearisation
from ..uncertainty.variance_components import Moments, moments, noise_from
from .prior_fit import OfPrior, fitted_with_prior, weights
from .results import Identification, ObservedMetrics
from .task import Begun, Fit, State, Task, args_of, begin, fit, solves_of, state_after, whitening_at

_MOST_STEPS = 100.0  # natural steps (mm, mrad, px): standard uncertainty from which a number is not determined


class Solution(NamedTuple):
    """An identification, and what its uncertainty follows from."""

    identification: Identification
    linear: Linearisation
    influence: propagation.Influence
    covariances: list[Float[AnyArray, "_ _ _"]]  # of the whitened rows of every group
    reading: list[np.ndarray]  # number of the reading of each pose of each group; equal ones were read at once
    state: State

    def covariance_of(self, rows: list[Float[AnyArray, "q _ _"]]) -> Float[AnyArray, "q q"]:
        """Of functions that follow the rows of every block so."""
        noise, linear = self.identification.noise, self.linear
        total = propagation.covariance_of_rows(rows, self.covariances)
        if self.identification.noise_model == "robust":
            return total
        shared = propagation.of_shared_readings(rows, self.state.errors, linear.whitening, noise, self.reading)
        return total if shared is None else total + shared

    def rows_of_parameters(self) -> list[Float[AnyArray, "p _ _"]]:
        """How all parameters, mm and rad, follow the rows of every block; not at all where they are held."""
        linear, influence, space = self.linear, self.influence, self.identification.bounds.space
        xp, names, height = namespace(linear.z), linear.space.names, linear.height
        steps = xp.where(influence.fixed[: len(names)], 0.0, linear.steps[: len(names)])
        head = xp.concatenate([xp.diag(steps), xp.zeros((len(names), height - len(names)))], axis=1)
        components = [xp.zeros((len(names), *inverse.shape[:2])) for inverse in influence.d_inverses]
        index = np.array([space.names.index(name) for name in names], dtype=int)
        of_free = propagation.rows_of_functions(influence, head, components)
        return [set_at(xp.zeros((len(space.names), *rows.shape[1:])), index, rows) for rows in of_free]


def solve(task: Task, near: Float[AnyArray, " p"] | None = None) -> Solution:
    """The identification of a task; from ``near``, where parameters close to the solution are known, else from the
    start."""
    begun = begin(task, near)
    return concluded(task, begun, *minimised(task, begun))


def minimised(task: Task, begun: Begun) -> tuple[Float[AnyArray, " z"], State, Fit, OfPrior | None]:
    """The unknowns after all least squares, the state there, and the last result with the evaluations of all."""
    z, state, evaluations, solves = begun.z, begun.state, namespace(task).zeros((), dtype=int), solves_of(task)
    solution = of_prior = None
    # The covariance of the rows depends on the arm, so each least squares has the weights of the last one's solution.
    for number, (loss, rules) in enumerate(solves, 1):
        prior = task.free_prior if number == len(solves) else None
        if prior is not None:
            z, state, solution, of_prior = fitted_with_prior(task, prior, begun, state, z)
        else:
            # Positions of sockets are eliminated: given the head, they are means of the tips (`model.elimination`).
            args, count = args_of(task, weights(task, begun, state, loss), loss, z)
            solution = fit(task, args, z[:count], begun, rules, task.differentiable)
            z, point = with_linear_geometry(solution.parameters, args)
            state = state_after(task, begun, z, point, number == len(solves))
        evaluations = evaluations + solution.steps
    assert solution is not None
    return z, state, solution._replace(steps=evaluations), of_prior


def concluded(
    task: Task, begun: Begun, z: Float[AnyArray, " z"], state: State, last: Fit, of_prior: OfPrior | None
) -> Solution:
    """The identification whose unknowns are ``z``; ``last`` is the last least squares, with the evaluations of all."""
    xp, names, free, observed = namespace(task, z), task.bounds.space.names, task.free, task.observed
    p, count = len(free), z.shape[0] - len(free)
    active = Bounds(begun.space, *(side[:p] for side in begun.box[:2])).active(z[:p])
    whitening = whitening_at(task, state, of_prior and of_prior.rows)
    linear = Linearisation.of(observed, begun.space, z, state.point, state.errors, whitening, task.loss)
    # A parameter on a bound follows no row; `stages` adds the chance that it is not on its bound.
    influence = linear.influence(xp.concatenate([active != 0, xp.zeros(count, dtype=bool)]))
    noise, groups = _noise_of(task, linear, influence, state), observed.layout.groups
    # Cov z = G (sum over poses of A W Cov(w) W A^T) G (JCGM 100, section 5), plus what poses with one reading share.
    reading, shared = [np.array(task.pose)[group.index] for group in groups], None
    if task.noise_model == "robust":
        covariances = propagation.alone(influence, len(groups))
    else:
        covariances = propagation.row_covariances(linear.point.rows, linear.errors, whitening, noise)
        rows = [influence.weighted_rows(number) for number in range(len(groups))]
        shared = propagation.of_shared_readings(rows, linear.errors, whitening, noise, reading)
    by_scales = None if of_prior is None or of_prior.by_scales is None else of_prior.by_scales(influence.inverse)
    unknowns = propagation.propagated(influence, covariances, shared, by_scales)
    spent = p + count if of_prior is None else of_prior.effective
    metrics = _metrics(task, begun.before, linear, state.sigma, _of_geometry(linear, influence, unknowns), spent)
    parameters, after = set_at(task.start, free, z[:p]), repeatability_of(state, observed, state.sigma)
    # Of all equations, or of poses where each has a variance of its own.
    redundancy = float(observed.equations - p - count)
    if task.noise_model == "robust":
        redundancy *= observed.q.shape[0] / observed.equations
    identification = Identification(  # pyright: ignore[reportCallIssue] - `stage1` is itself
        arm=task.bounds.space.arm(parameters),
        parameters=parameters,
        de=after.de,
        deltam=after.deltam,
        active=set_at(xp.zeros(len(names), dtype=active.dtype), free, active),
        steps=last.steps,
        result=last.result,
        optimality=last.optimality,
        scale=None,
        parameter_covariance=_of_parameters(task, linear, influence, unknowns, noise),
        before=repeatability_of(begun.before, observed),
        after=after,
        reduced_chi=metrics.reduced_chi_of_all if task.noise is not None else None,
        bounds=task.bounds,
        anchor=task.anchor,
        noise_model=task.noise_model,
        fitted_degrees_of_freedom=math.inf if task.noise_model == "given" else max(redundancy, 1.0),
        observed=metrics,
        prior_metrics=of_prior and of_prior.metrics,
    )
    return Solution(identification, linear, influence, covariances, reading, state)


def _noise_of(task: Task, linear: Linearisation, influence: propagation.Influence, state: State) -> Noise:
    """The noise of the tips' errors by the noise model: given, or estimated."""
    xp, whitening, prior = namespace(linear.z), linear.whitening, None
    if task.noise_model == "given":
        assert task.noise is not None
        return task.noise
    if task.noise_model != "estimated":
        return noise_from(Moments(xp.zeros(()), state.sigma**2))
    if whitening.prior is not None:
        # The prior's rows are weight (x - mean), so that its information is weight^2; in natural steps.
        index = np.arange(whitening.prior.mean.shape[0])
        squares = xp.where(influence.fixed[index], 0.0, whitening.prior.weight * linear.steps[index]) ** 2
        prior = added_to(xp.zeros((linear.height, linear.height)), (index, index), squares)
    robust = task.loss is not None
    return noise_from(moments(influence, state.point.rows, state.errors, whitening, state.sigma, robust, prior))


def _of_parameters(
    task: Task,
    linear: Linearisation,
    influence: propagation.Influence,
    unknowns: propagation.UnknownsCovariance,
    noise: Noise,
) -> ParameterCovariance:
    """Of all parameters, of which the scale anchor is exact."""
    xp, free, size = namespace(linear.z), task.free, len(task.bounds.space.names)
    p, grid = len(free), np.ix_(free, free)
    # x_i is a number of natural steps s_i: Cov(x_i s_i, x_j s_j) = s_i s_j Cov(x_i, x_j).
    scale = linear.steps[:p, None] * linear.steps[None, :p]
    stated = propagation.of_stated(influence, linear.point.rows, linear.whitening)[:p, :p] * scale
    parts = Components.of({STATED: (stated, np.inf)})
    return ParameterCovariance(
        set_at(xp.zeros((size, size)), grid, unknowns.head[:p, :p] * scale),
        set_at(xp.ones(size, dtype=bool), free, influence.determined[:p]),
        set_at(xp.zeros((size, size)), grid, influence.null_projector[:p, :p]),
        noise,
        parts and parts.wider(free, size),
    )


def _of_geometry(
    linear: Linearisation, influence: propagation.Influence, covariance: propagation.UnknownsCovariance
) -> dict[str, Float[AnyArray, "_ _"]]:
    """Of each part, mm and rad; NaN for what the data leave open, such as the turn of a ball bar about itself."""
    xp, observed, p = namespace(linear.z), linear.observed, len(linear.space.names)
    # Number by number: what shares in a direction that is poorly determined has its own variance, which may be small.
    of_head = covariance.head[p:, p:]
    seen = (xp.diagonal(influence.null_projector)[p:] < 1e-6) & (xp.diagonal(of_head) < _MOST_STEPS**2)
    by_class = [(of_head[None], seen[None])]
    by_class += [
        (matrix, ~is_open) for matrix, is_open in zip(covariance.components, influence.undetermined, strict=True)
    ]
    scaled = [xp.where(seen[:, :, None] & seen[:, None, :], matrix, np.nan) for matrix, seen in by_class]
    matrices = {}
    for name, rows in observed.positions.items():
        number, component, first = observed.layout.component_of(int(rows[0]))
        part, steps = slice(first, first + len(rows)), observed.steps[rows]
        matrices[name] = scaled[1 + number][component, part, part] * (steps[:, None] * steps[None, :])
    return matrices


def _metrics(
    task: Task,
    before: State,
    linear: Linearisation,
    sigma: Float[AnyArray, ""],
    covariance: dict[str, Float[AnyArray, "_ _"]],
    spent: Any,
) -> ObservedMetrics:
    """How far each observation is from its geometry; ``spent`` is how many unknowns the data determine."""
    xp, observed = namespace(sigma), task.observed
    squares = [xp.sum(block.white**2, axis=0) for block in linear.blocks[: len(observed.layout.groups)]]
    pairs = zip(squares, linear.weights, strict=False)
    weights = [xp.ones(square.shape) if weight is None else weight for square, weight in pairs]
    rows = np.array([observation.pose_equations.mean() for observation in observed.observations])
    # Whitened rows have variance 1, so the mean of their squares is about 1 where the noise is as the weights say.
    total = sum(xp.sum(square) for square in squares)
    degrees_of_freedom = xp.maximum(xp.asarray(observed.equations - spent, dtype=float), 1.0)
    before_and_after = (
        xp.sqrt(observed.mean_by_observation(observed.squared_distances(point.rows)))
        for point in (before.point, linear.point)
    )
    parts = observed.split(linear.z[len(linear.space.names) :])
    return ObservedMetrics(
        tuple(observation.name for observation in observed.observations),
        tuple(observation.kind for observation in observed.observations),
        *before_and_after,
        reduced_chi=xp.sqrt(observed.mean_by_observation(squares) / rows),
        reduced_chi_of_all=xp.sqrt(total / degrees_of_freedom),
        sigma=sigma,
        geometry={name: parts[name] for name in observed.names},
        geometry_covariance={name: covariance[name] for name in observed.names},
        weights=tuple(observed.by_observation(weights)),
    )


def repeatability_of(state: State, observed: Observed, sigma: Float[AnyArray, ""] | None = None) -> Repeatability:
    """Of the tips in sockets, NaN where there is none; ``sigma`` is the scatter of a tip coordinate as it is known."""
    pairs = zip(observed.observations, observed.slices, strict=True)
    slices = [rows for observation, rows in pairs if observation.kind == "socket"]
    if not slices:
        return no_repeatability(state.sigma)
    tips = namespace(state.sigma).concatenate([state.point.forward.tip[:, rows] for rows in slices], axis=1)
    metrics = repeatability(tips.T, tuple(rows.stop - rows.start for rows in slices))
    return metrics if sigma is None else eqx.tree_at(lambda r: r.sigma, metrics, sigma)
