"""What follows from the solution of a least squares: covariance, noise, and how everything agrees."""

from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..core.numpy_or_jax import AnyArray, added_to, namespace, set_at
from ..data.noise import Noise
from ..kinematics.parameters import Bounds
from ..model.metrics import Repeatability, no_repeatability, repeatability
from ..model.observed import Observed
from ..model.rows import PriorRows
from ..uncertainty.covariance import STATED, ParameterCovariance
from ..uncertainty.degrees_of_freedom import Components
from ..uncertainty.linear_propagation import (
    Influence,
    UnknownsCovariance,
    alone,
    covariance_of_rows,
    of_shared_readings,
    of_stated,
    propagated,
    row_covariances,
)
from ..uncertainty.linearisation import Linearisation
from ..uncertainty.variance_components import Moments, moments, noise_from
from .bounded_fit import Fit
from .prior_fit import ByScales
from .results import Identification, ObservedMetrics, PriorMetrics
from .solve_state import Begun, State, whitening_at
from .task import Task


class OfPrior(NamedTuple):
    """What the last least squares with a prior found besides the unknowns."""

    rows: PriorRows
    metrics: PriorMetrics
    effective: Float[AnyArray, ""]  # how many unknowns the data determine
    by_scales: ByScales | None


class Solution(NamedTuple):
    """An identification, and what its uncertainty follows from."""

    identification: Identification
    linear: Linearisation
    influence: Influence
    covariances: list[Float[AnyArray, "_ _ _"]]  # of the whitened rows of every group
    reading: list[np.ndarray]  # number of the reading of each pose of each group; equal ones were read at once
    state: State

    def covariance_of(self, rows: list[Float[AnyArray, "q _ _"]]) -> Float[AnyArray, "q q"]:
        """Of functions that follow the rows of every block so."""
        identification = self.identification
        total = covariance_of_rows(rows, self.covariances)
        if identification.noise_model == "robust":
            return total
        shared = of_shared_readings(rows, self.state.errors, self.linear.whitening, identification.noise, self.reading)
        return total if shared is None else total + shared


def concluded(
    task: Task, begun: Begun, z: Float[AnyArray, " z"], state: State, found: Fit, of_prior: OfPrior | None
) -> Solution:
    """The identification whose unknowns are ``z``; ``found`` is the last least squares, with the evaluations of all."""
    xp, names, free, space = namespace(task, z), task.bounds.space.names, task.free, begun.space
    p, count, steps = len(free), z.shape[0] - len(free), begun.steps
    whitening = whitening_at(task, state, None if of_prior is None else of_prior.rows)
    active = Bounds(space, *(side[:p] for side in begun.sides)).active(z[:p])
    linear = Linearisation.of(task.observed, space, z, state.point, state.errors, whitening, task.loss)
    influence = linear.influence(xp.concatenate([active != 0, xp.zeros(count, dtype=bool)]))
    noise = _noise_of(task, linear, influence, state)
    covariances, shared, reading = _of_rows(task, linear, influence, noise)
    by_scales = None if of_prior is None else of_prior.by_scales
    added = None if by_scales is None else by_scales.added(influence.inverse)
    unknowns = propagated(influence, covariances, shared, added)
    both = steps[:p, None] * steps[None, :p]
    matrix = unknowns.head[:p, :p] * both
    stated = of_stated(influence, state.point.rows, whitening)[:p, :p]
    parts = Components.of({STATED: (stated * both, np.inf)})
    covariance = ParameterCovariance(matrix, influence.determined[:p], influence.lost[:p, :p], noise, parts)
    parameters = set_at(task.start, free, z[:p])
    spent = p + count if of_prior is None else of_prior.effective
    metrics = observed_metrics(task, begun.before, state, linear, of_geometry(linear, influence, unknowns), spent)
    identification = Identification(
        arm=task.bounds.space.arm(parameters),
        parameters=parameters,
        de=metrics[1].de,
        deltam=metrics[1].deltam,
        active=set_at(xp.zeros(len(names), dtype=active.dtype), free, active),
        steps=found.steps,
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
        prior_metrics=None if of_prior is None else of_prior.metrics,
    )
    return Solution(identification, linear, influence, covariances, reading, state)


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
            squares = xp.where(influence.fixed[own], 0.0, whitening.prior.weight * linear.steps[own]) ** 2
            prior = added_to(xp.zeros((linear.height, linear.height)), (own, own), squares)
        robust = task.loss is not None
        return noise_from(moments(influence, state.point.rows, state.errors, whitening, state.sigma, robust, prior))
    return noise_from(Moments(xp.zeros(()), state.sigma**2))


def _of_rows(
    task: Task, linear: Linearisation, influence: Influence, noise: Noise
) -> tuple[list[Float[AnyArray, "_ _ _"]], Float[AnyArray, "h h"] | None, list[np.ndarray]]:
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
    observed, p = linear.observed, len(linear.space.names)
    layout, found, steps = observed.layout, {}, observed.steps
    shared = np.arange(layout.shared)
    square = np.ix_(p + shared, p + shared)
    everything = [_known(covariance.head[square], influence.determined[p + shared], steps[shared])[None]]
    first = layout.shared
    for (count, size), matrices, opened in zip(layout.classes, covariance.components, influence.open, strict=True):
        of_class = steps[first : first + count * size].reshape(count, size)
        everything.append(_known(matrices, ~opened, of_class))
        first += count * size
    for name, rows in observed.positions.items():
        of, component, first = layout.component_of(int(rows[0]))
        own = slice(first, first + len(rows))
        found[name] = everything[1 + of][component, own, own]
    return found


def _known(
    matrix: Float[AnyArray, "*k g g"], known: Bool[AnyArray, "*k g"], steps: Float[np.ndarray, "*k g"]
) -> Float[AnyArray, "*k g g"]:
    """A covariance in natural steps as one in mm and rad, NaN for what is not known."""
    scaled = matrix * (steps[..., None] * steps[..., None, :])
    return namespace(matrix).where(known[..., None] & known[..., None, :], scaled, np.nan)


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
    rows = np.array([observation.rows for observation in observed.observations], dtype=float)
    chi = xp.sqrt(observed.mean_by_observation(squares) / rows)
    total = sum(xp.sum(square) for square in squares)
    for state in (before, after):
        distances = [xp.sum(rows.values[:3] ** 2, axis=0) for rows in state.point.rows]
        rms.append(xp.sqrt(observed.mean_by_observation(distances)))
    degrees_of_freedom = xp.maximum(xp.asarray(observed.equations - spent, dtype=float), 1.0)
    parts = observed.split(linear.z[len(linear.space.names) :])
    metrics = ObservedMetrics(
        names=tuple(observation.name for observation in observed.observations),
        kinds=tuple(observation.kind for observation in observed.observations),
        rms_before=rms[0],
        rms_after=rms[1],
        reduced_chi=chi,
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
