"""Identification from observations of all kinds: one least squares of the parameters and every unknown geometry."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from ..core.arrays import Numbers, as_array, is_concrete
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, compiled, namespace, set_at, to_numpy
from ..data.capture import Capture
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.chain import forward_pass
from ..kinematics.parameters import Bounds, Parameters, based_on
from ..model.measurement import check_joints
from ..model.metrics import Repeatability, no_repeatability, repeatability
from ..model.observed import Linear, Observed, Whitening, linear_rows, observed_model, observed_rows, whitening_of
from ..model.robust import Loss, LossName, check_loss
from ..uncertainty import observed_covariance as propagation
from ..uncertainty.covariance import NoiseModel, ParameterCovariance, inverse_information
from .bounded_fit import RULES, fit
from .checks import check_noise_model, check_start
from .results import Calibration, Identification, ObservedMetrics
from .scale_anchor import ScaleAnchor, scale_anchor

NO_ANCHOR = ScaleAnchor(hold=None, adjusted=None, set_by=(), partners=None)
# Of the solves whose result only gives the weights of the next, or its start: a few standard uncertainties' millionths.
_ROUGH = RULES._replace(rtol=1e-5)
_LEAST = 1e-4  # smallest standard uncertainty of what is certified, of a tip coordinate's standard deviation


class ObservedTask(NamedTuple):
    """An identification from observations, checked."""

    observed: Observed
    bounds: Bounds
    start: Float[AnyArray, " p"]
    noise: Noise | None
    anchor: ScaleAnchor
    noise_model: NoiseModel
    max_steps: int
    loss: Loss | None
    pose: tuple[int, ...]  # number of the configuration of each row; equal ones were read at once
    differentiable: bool = True  # whether derivatives pass through the solve


class State(NamedTuple):
    """Everything at one point of the solve."""

    linear: list[Linear]
    errors: list[propagation.ArmErrors]
    sigma: Float[AnyArray, ""]  # standard deviation of a tip coordinate, mm


def observed_task(
    arm: Arm,
    capture: Capture,
    bounds: Bounds,
    start: Numbers | None,
    noise: Noise | None,
    hold: str | None,
    noise_model: NoiseModel | None,
    max_steps: int,
    robust: LossName | None,
) -> ObservedTask:
    """A checked task. Everything that the capture holds takes part, reference lengths too."""
    space = based_on(bounds.space, arm)
    bounds = Bounds(space, bounds.lower, bounds.upper)
    vector = space.vector() if start is None else as_array(start, "the start")
    if max_steps < 1:
        raise InputError(f"max_steps is {max_steps}; give at least 1.")
    check_loss(robust)
    check_joints(capture, space)
    check_start(bounds, vector, "the start" if start is not None else "the arm")
    fixed = bool(capture.lengths) or any(observation.fixes_scale for observation in capture.observations)
    if fixed and hold == "longest":
        hold = None
    anchor = scale_anchor(space, space.base, hold, noise, capture) if not fixed or hold else NO_ANCHOR
    noise_model = check_noise_model(noise_model, noise, arm.joints)
    observed = Observed.of(capture, space.base)
    if is_concrete(*jax.tree.leaves((arm, capture, vector))):
        known, at = to_numpy((space, vector))
        check_observed(observed, known, at, len(space.names) - (anchor.hold is not None))
    return ObservedTask(
        observed=observed,
        bounds=bounds,
        start=vector,
        noise=noise,
        anchor=anchor,
        noise_model=noise_model,
        max_steps=max_steps,
        loss=None if robust is None else Loss(robust),
        pose=configurations(observed.q),
    )


def configurations(q: Any) -> tuple[int, ...]:
    """A number for each different configuration; different ones where the readings are traced."""
    if not is_concrete(q):
        return tuple(range(q.shape[0]))
    return tuple(int(i) for i in np.unique(np.asarray(q), axis=0, return_inverse=True)[1].ravel())


def check_observed(observed: Observed, space: Parameters, vector: Float[AnyArray, " p"], count: int) -> None:
    """Raise `InputError` where the observations cannot determine their own unknowns, or these parameters."""
    geometry = space.geometry(vector)
    forward = forward_pass(geometry, observed.motion)
    for observation, rows in zip(observed.observations, observed.slices, strict=True):
        observation.check_determined(np.asarray(forward.tip[:, rows]))
    _check_targets(observed, forward)
    equations = observed.equations
    unknowns = count + len(observed.steps)
    if equations < unknowns:
        raise InputError(
            f"the observations give {equations} equations, but {unknowns} numbers are unknown ({count} parameters and "
            f"{unknowns - count} of the unknown geometry); record more poses, or fix more parameters."
        )


def _check_targets(observed: Observed, forward: Any) -> None:
    """Refuse a target whose place cannot be told from that of the station, because the last frame never turns."""
    targets = {observation.target for observation in observed.observations if observation.target}
    for target in targets:
        rows = np.concatenate(
            [
                np.arange(part.start, part.stop)
                for observation, part in zip(observed.observations, observed.slices, strict=True)
                if observation.target == target
            ]
        )
        x = np.asarray(forward.frame[0])[:, rows]
        z = np.asarray(forward.frame[2])[:, rows]
        if max(np.ptp(x, axis=1).max(), np.ptp(z, axis=1).max()) < 0.05:
            raise InputError(
                f"target '{target}' was seen from one orientation of the last frame, in which its place cannot be told "
                "from that of the instrument; take poses with the wrist turned."
            )


def _state(task: ObservedTask, space: Parameters, z: Float[AnyArray, " z"], sigma: Any) -> State:
    linear = linear_rows(space, task.observed, z)
    p = len(space.names)
    forward = task.observed.forward(space, z[:p], z[p:])
    errors = propagation.arm_errors(forward, linear, task.observed)
    if sigma is None:
        degrees_of_freedom = max(task.observed.equations - z.shape[0], 1)
        scatter = propagation.scatter_of if task.loss is None else propagation.robust_scatter_of
        sigma = scatter(linear, errors, degrees_of_freedom)
    return State(linear, errors, sigma)


def _whitening(task: ObservedTask, state: State) -> Whitening:
    if task.noise is None:
        of_arm = [propagation.covariance_of_sigma(errors, state.sigma) for errors in state.errors]
    else:
        of_arm = [propagation.covariance_of_noise(errors, task.noise) for errors in state.errors]
    least = namespace(state.sigma).maximum(_LEAST * state.sigma, 1e-12)
    return whitening_of(state.linear, task.observed, of_arm, least)


@compiled(jit=eqx.filter_jit)
def identify_observed(task: ObservedTask) -> Identification:
    """The parameters and the unknown geometry that agree best with everything observed.

    Solved at least twice: with the weights of the start, and with those of that solution. Where the noise is not given,
    tips are taken to scatter as much as the residuals then do (`observed_covariance.scatter_of`).
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
    before = _state(task, space, first, _scatter(task, space, first))
    z, evaluations = first, xp.zeros((), dtype=int)
    state, found = before, None
    # Once more with the weights of a nearly right arm. Far from the solution a robust loss would see nothing but bad
    # poses, so it begins where least squares ends, and one with several minima where Huber's, which has one, ends.
    losses = [None, None] if task.loss is None else [None, Loss("huber"), task.loss, task.loss]
    for number, loss in enumerate(losses, 1):
        whitening = _whitening(task, state)
        args = (space, task.observed, whitening, loss)
        functions = observed_rows, observed_model
        rules = RULES if number == len(losses) else _ROUGH
        found = fit(*functions, z, args, sides, steps, task.max_steps, rules=rules, differentiable=task.differentiable)
        z, evaluations = found.parameters, evaluations + found.steps
        # Where the noise is given, only the last scatter matters, and its iteration costs as much as a few steps.
        known = task.noise is not None and number < len(losses)
        state = _state(task, space, z, _scatter(task, space, z) if known else None)
    assert found is not None
    whitening = _whitening(task, state)
    reduced = Bounds(space, *(side[:p] for side in sides))
    active = reduced.active(z[:p])
    covariance, of_geometry = _covariance(task, space, z, state, whitening, active, steps)
    parameters = set_at(task.start, free, z[:p])
    arm = task.bounds.space.arm(parameters)
    metrics = _metrics(task, before, state, whitening, z[p:], of_geometry)
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
        degrees_of_freedom=float("inf")
        if task.noise_model == "given"
        else max(float(task.observed.equations - p - count), 1.0),
        observed=metrics[2],
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


def _scatter(task: ObservedTask, space: Parameters, z: Float[AnyArray, " z"]) -> Any:
    """Root mean square of the start's residuals in mm, for the first weights."""
    xp = namespace(z, task)
    values = [part.rows.values[:3] for part in linear_rows(space, task.observed, z)]
    flat = xp.concatenate([xp.reshape(value, (-1,)) for value in values])
    return xp.sqrt(xp.mean(flat**2)) + 1e-9


def _covariance(
    task: ObservedTask,
    space: Parameters,
    z: Float[AnyArray, " z"],
    state: State,
    whitening: Whitening,
    active: Any,
    steps: Float[AnyArray, " z"],
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
        )
        noise = propagation.noise_from(found)
    else:
        noise = propagation.noise_from(propagation.Moments(xp.zeros(()), state.sigma**2))
    if task.noise_model == "robust":
        each = propagation.alone(state.linear, rows, whitening, inverse)
        total = relations
        for part, one in zip(rows, each, strict=True):
            total = total + _flat(xp.einsum("zam,mab->zbm", part, one)) @ _flat(part).T
        matrix = inverse @ total @ inverse
    else:
        matrix = propagation.propagated(
            state.linear, state.errors, rows, whitening, inverse, relations, noise, np.array(task.pose)
        )
    matrix = matrix * steps[:, None] * steps[None, :]
    # What the data leave open of the geometry (the turn of a ball bar about itself) has no uncertainty.
    known = determined[p:]
    of_geometry = xp.where(known[:, None] & known[None, :], matrix[p:, p:], np.nan)
    return ParameterCovariance(matrix[:p, :p], determined[:p], lost[:p, :p], noise), of_geometry


def _weighted_rows(loss: Loss, state: State, whitening: Whitening, rows: list[Any]) -> list[Any]:
    """Rows as a robust loss counts them: the influence of a pose on the estimate."""
    found = []
    for part, root, row in zip(state.linear, whitening.roots, rows, strict=True):
        xp = namespace(row)
        white = xp.einsum("mab,bm->am", root, part.rows.values)
        found.append(row * loss.cost_and_weight(white)[1][None, None])
    return found


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
    )


def _metrics(
    task: ObservedTask,
    before: State,
    after: State,
    whitening: Whitening,
    geometry: Float[AnyArray, " g"],
    covariance: Float[AnyArray, "g g"],
) -> tuple[Repeatability, Repeatability, ObservedMetrics]:
    """Repeatability of the sockets, and how far each observation is from its geometry."""
    xp, observed = namespace(geometry, after.sigma), task.observed
    rms, chi, total, weights = [], [], 0.0, []
    for part, root in zip(after.linear, whitening.roots, strict=True):
        white = xp.einsum("mab,bm->am", root, part.rows.values)
        total = total + xp.sum(white**2)
        chi.append(xp.sqrt(xp.mean(white**2)))
        weights.append(xp.ones(white.shape[1]) if task.loss is None else task.loss.cost_and_weight(white)[1])
    for state in (before, after):
        rms.append(xp.stack([xp.sqrt(xp.mean(xp.sum(part.rows.values[:3] ** 2, axis=0))) for part in state.linear]))
    degrees_of_freedom = max(observed.equations - len(observed.steps) - len(task.bounds.space.names), 1)
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
