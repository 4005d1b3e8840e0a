"""Identification from observations of all kinds: one least squares of the parameters and every unknown geometry."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, added_to, compiled, namespace, set_at
from ..kinematics.parameters import Bounds, Parameters
from ..model.metrics import Repeatability, no_repeatability, repeatability
from ..model.observed import PriorRows, Whitening, observed_model, observed_rows
from ..model.robust import Loss
from ..uncertainty import observed_covariance as propagation
from ..uncertainty.covariance import STATED, ParameterCovariance, inverse_information
from ..uncertainty.degrees_of_freedom import Components
from .bounded_fit import RULES, fit
from .observed_state import ObservedTask, State, scatter_at_start, state_at, whitening_at
from .prior_fit import ByScales, PriorProblem, fit_with_prior
from .results import Calibration, Identification, ObservedMetrics

# Of the solves whose result only gives the weights of the next, or its start: a few standard uncertainties' millionths.
_ROUGH = RULES._replace(rtol=1e-5)


@compiled(jit=eqx.filter_jit)
def identify_observed(task: ObservedTask) -> Identification:
    """The parameters and the unknown geometry that agree best with everything observed.

    Solved at least twice: with the weights of the start, and with those of that solution. Where the noise is not given,
    tips are taken to scatter as much as the residuals then do (`observed_covariance.scatter_of`). With a prior the last
    solve is repeated until the weights agree with what it leads to (`prior_fit`).
    """
    xp = namespace(task)
    names = task.bounds.space.names
    free = np.flatnonzero([name != task.anchor.hold for name in names])
    space = Parameters(task.bounds.space.arm(task.start), tuple(names[i] for i in free))
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
    z, evaluations = first, xp.zeros((), dtype=int)
    state, found = before, None
    # Once more with the weights of a nearly right arm. Far from the solution a robust loss would see nothing but bad
    # poses, so it begins where least squares ends, and one with several minima where Huber's, which has one, ends.
    losses = [None, None] if task.loss is None else [None, Loss("huber"), task.loss, task.loss]
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
        args = (space, task.observed, whitening_at(task, state, rows), loss)
        functions = observed_rows, observed_model
        rules = RULES if number == len(losses) else _ROUGH
        found = fit(*functions, z, args, sides, steps, task.max_steps, rules=rules, differentiable=task.differentiable)
        z, evaluations = found.parameters, evaluations + found.steps
        # Where the noise is given, only the last scatter matters, and its iteration costs as much as a few steps.
        known = task.noise is not None and number < len(losses)
        state = state_at(task, space, z, scatter_at_start(task, space, z) if known else None)
    assert found is not None
    whitening = whitening_at(task, state, rows)
    reduced = Bounds(space, *(side[:p] for side in sides))
    active = reduced.active(z[:p])
    covariance, of_geometry = _covariance(task, space, z, state, whitening, active, steps, by_scales)
    parameters = set_at(task.start, free, z[:p])
    arm = task.bounds.space.arm(parameters)
    spent = len(names) + count if effective is None else effective
    metrics = _metrics(task, before, state, whitening, z[p:], of_geometry, spent)
    return Identification(
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
        fitted_degrees_of_freedom=float("inf")
        if task.noise_model == "given"
        else float(task.observed.equations - p - count),
        observed=metrics[2],
        prior_metrics=of_prior,
    )


def calibrate_observed(task: ObservedTask) -> Calibration:
    """`identify_observed` of everything that the capture holds, as the result of a calibration."""
    found = identify_observed(task)
    observed, geometry = task.observed, found.observed
    assert geometry is not None
    xp = namespace(found)

    def lengths(parts: dict[str, AnyArray]) -> Float[AnyArray, " l"]:
        vectors = [parts[end] - parts[start] for start, end in observed.ends]
        return xp.linalg.norm(xp.stack(vectors), axis=1) if vectors else xp.zeros(0)

    return Calibration(
        arm=found.arm,
        parameters=found.parameters,
        scale=None,
        de=found.de,
        deltam=found.deltam,
        active=found.active,
        steps=found.steps,
        result=found.result,
        parameter_covariance=found.parameter_covariance,
        before=found.before,
        after=found.after,
        length_before=lengths(observed.split(observed.start(task.bounds.space, task.start))),
        length_after=lengths(geometry.geometry),
        stage1=found,
        method="joint",
    )


def _covariance(
    task: ObservedTask,
    space: Parameters,
    z: Float[AnyArray, " z"],
    state: State,
    whitening: Whitening,
    active: Any,
    steps: Float[AnyArray, " z"],
    by_scales: ByScales | None,
) -> tuple[ParameterCovariance, Float[AnyArray, "g g"]]:
    """Of the parameters, and of the geometry."""
    xp, p = namespace(z, task), len(space.names)
    on_bound = xp.concatenate([active != 0, xp.zeros(z.shape[0] - p, dtype=bool)])
    model = observed_model(z, (space, task.observed, whitening, task.loss))
    scaled = xp.where(on_bound, 0.0, steps)
    information = model.gram * scaled[:, None] * scaled[None, :]
    inverse, lost, determined = inverse_information(information, on_bound)
    rows = propagation.stacked(state.linear, task.observed, whitening, z.shape[0])
    rows = [scaled[:, None, None] * part for part in rows]
    poses = sum((_flat(part) @ _flat(part).T for part in rows), xp.zeros_like(information))
    unweighted = rows
    if task.loss is not None:
        rows = _weighted_rows(task.loss, state, whitening, rows)
        plain = observed_model(z, (space, task.observed, whitening, None)).gram * scaled[:, None] * scaled[None, :]
    else:
        plain = information
    relations = plain - poses
    noise = task.noise
    if task.noise_model == "given":
        assert noise is not None
    elif task.noise_model == "estimated":
        found = propagation.moments(
            *(state.linear, state.errors, unweighted, rows, whitening, inverse, state.sigma),
            robust=task.loss is not None,
            prior=None if whitening.prior is None else _information_of(whitening.prior, scaled),
        )
        noise = propagation.noise_from(found)
    else:
        noise = propagation.noise_from(propagation.Moments(xp.zeros(()), state.sigma**2))
    if task.noise_model == "robust":
        each = propagation.alone(state.linear, rows, whitening, inverse)
        total = stated = relations
        for part, one in zip(rows, each, strict=True):
            total = total + _flat(xp.einsum("zam,mab->zbm", part, one)) @ _flat(part).T
        matrix = inverse @ total @ inverse
    else:
        stated = relations + propagation.of_measurements(state.linear, rows, whitening)
        matrix = propagation.propagated(
            state.linear, state.errors, rows, whitening, inverse, stated, noise, np.array(task.pose)
        )
    matrix = matrix if by_scales is None else matrix + by_scales.added(inverse)
    both = steps[:, None] * steps[None, :]
    matrix, parts = matrix * both, Components.of({STATED: ((inverse @ stated @ inverse * both)[:p, :p], np.inf)})
    # What the data leave open of the geometry (the turn of a ball bar about itself) has no uncertainty.
    known = determined[p:]
    of_geometry = xp.where(known[:, None] & known[None, :], matrix[p:, p:], np.nan)
    return ParameterCovariance(matrix[:p, :p], determined[:p], lost[:p, :p], noise, parts), of_geometry


def _weighted_rows(loss: Loss, state: State, whitening: Whitening, rows: list[Any]) -> list[Any]:
    """Rows as a robust loss counts them: the influence of a pose on the estimate."""
    found = []
    for part, root, row in zip(state.linear, whitening.roots, rows, strict=True):
        xp = namespace(row)
        white = xp.einsum("mab,bm->am", root, part.rows.values)
        found.append(row * loss.cost_and_weight(white)[1][None, None])
    return found


def _information_of(prior: PriorRows, scaled: Float[AnyArray, " z"]) -> Float[AnyArray, "z z"]:
    xp, own = namespace(scaled), np.arange(prior.mean.shape[0])
    return added_to(xp.zeros((scaled.shape[0],) * 2), (own, own), (prior.weight * scaled[own]) ** 2)


def _flat(rows: Float[AnyArray, "z r m"]) -> Float[AnyArray, "z k"]:
    return rows.reshape(rows.shape[0], -1)


def _expanded(covariance: ParameterCovariance, free: np.ndarray, size: int) -> ParameterCovariance:
    """With the scale anchor, which is exact."""
    xp = namespace(covariance)
    grid = np.ix_(free, free)
    return ParameterCovariance(
        set_at(xp.zeros((size, size)), grid, covariance.matrix),
        set_at(xp.ones(size, dtype=bool), free, covariance.determined),
        set_at(xp.zeros((size, size)), grid, covariance.open),
        covariance.noise,
        covariance.components and covariance.components.wider(free, size),
    )


def _metrics(
    task: ObservedTask,
    before: State,
    after: State,
    whitening: Whitening,
    geometry: Float[AnyArray, " g"],
    covariance: Float[AnyArray, "g g"],
    spent: Any,
) -> tuple[Repeatability, Repeatability, ObservedMetrics]:
    """Repeatability of the sockets, and how far each observation is from its geometry; ``spent`` is how many unknowns
    the data determine."""
    xp, observed = namespace(geometry, after.sigma), task.observed
    rms, chi, total, weights = [], [], 0.0, []
    for part, root in zip(after.linear, whitening.roots, strict=True):
        white = xp.einsum("mab,bm->am", root, part.rows.values)
        total = total + xp.sum(white**2)
        chi.append(xp.sqrt(xp.mean(white**2)))
        weights.append(xp.ones(white.shape[1]) if task.loss is None else task.loss.cost_and_weight(white)[1])
    for state in (before, after):
        rms.append(xp.stack([xp.sqrt(xp.mean(xp.sum(part.rows.values[:3] ** 2, axis=0))) for part in state.linear]))
    degrees_of_freedom = xp.maximum(xp.asarray(observed.equations - spent, dtype=float), 1.0)
    metrics = ObservedMetrics(
        names=tuple(observation.name for observation in observed.observations),
        kinds=tuple(observation.kind for observation in observed.observations),
        rms_before=rms[0],
        rms_after=rms[1],
        reduced_chi=xp.stack(chi),
        reduced_chi_of_all=xp.sqrt(total / degrees_of_freedom),
        sigma=after.sigma,
        geometry=observed.split(geometry),
        geometry_covariance={
            name: covariance[rows[0] : rows[-1] + 1, rows[0] : rows[-1] + 1]
            for name, rows in observed.positions.items()
        },
        weights=tuple(weights),
    )
    sockets = [i for i, kind in enumerate(metrics.kinds) if kind == "socket"]
    return _repeatability(before, sockets), _repeatability(after, sockets), metrics


def _repeatability(state: State, sockets: list[int]) -> Repeatability:
    """Of the tips in sockets; NaN where there is none."""
    if not sockets:
        return no_repeatability(state.sigma)
    # Distances from the centroid do not depend on where the socket is, so residuals do as well as tips.
    tips = namespace(state.sigma).concatenate([state.linear[i].rows.values for i in sockets], axis=1)
    found = repeatability(tips.T, tuple(state.linear[i].rows.values.shape[1] for i in sockets))
    return eqx.tree_at(lambda r: r.sigma, found, state.sigma)
