"""An identification from observations, checked, and everything at one point of its solve."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ..core.arrays import Numbers, as_array, is_concrete
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, namespace, to_numpy
from ..data.capture import Capture
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.chain import forward_pass
from ..kinematics.parameters import Bounds, Parameters, based_on
from ..kinematics.priors import Prior
from ..model.loss_names import LossName
from ..model.measurement import check_joints
from ..model.observed import Linear, Observed, PriorRows, Whitening, linear_rows, residual_rows, whitening_of
from ..model.robust import Loss, check_loss
from ..uncertainty import observed_covariance as propagation
from ..uncertainty.covariance import NoiseModel
from .checks import check_noise_model, check_start
from .scale_anchor import ScaleAnchor, scale_anchor

NO_ANCHOR = ScaleAnchor(hold=None, adjusted=None, set_by=(), partners=None)
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
    prior: Prior | None = None


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
    prior: Prior | None,
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
        check_observed(observed, known, at, unknown_parameters(space, anchor, prior, noise))
    if prior is not None and is_concrete(*jax.tree.leaves((prior, bounds))):
        check_means(prior, bounds)
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
        prior=prior,
    )


def check_means(prior: Prior, bounds: Bounds) -> None:
    """Raise `InputError` where the mean of a prior is outside the bounds: one of both is wrong."""
    names = bounds.space.names
    known = prior.of(names, np.asarray(bounds.space.vector()))
    if known is None:
        return
    mean, low, high = (np.asarray(values)[known.index] for values in (known.mean, bounds.lower, bounds.upper))
    outside = np.flatnonzero(~((low <= mean) & (mean <= high)))
    for i in outside[:1]:
        raise InputError(
            f"the prior's mean of {names[known.index[i]]} is {mean[i]:g}, outside its bounds {low[i]:g} to "
            f"{high[i]:g} (mm or rad); correct the mean or widen the bounds."
        )


def unknown_parameters(space: Parameters, anchor: ScaleAnchor, prior: Prior | None, noise: Noise | None) -> int:
    """How many parameters the observations must determine: not those that have a prior, unless the noise has to be
    estimated, to which fewer equations than unknowns would leave nothing."""
    if prior is not None:
        prior.check(space.base)
    free = tuple(name for name in space.names if name != anchor.hold)
    known = None if prior is None or noise is None else prior.of(free, np.zeros(len(free)))
    return len(free) - (0 if known is None else len(known.index))


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
            f"{unknowns - count} of the unknown geometry); record more poses, fix more parameters, or give a "
            "prior of them together with the noise."
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


def state_at(
    task: ObservedTask,
    space: Parameters,
    z: Float[AnyArray, " z"],
    sigma: Any = None,
    effective: Float[AnyArray, ""] | int | None = None,
) -> State:
    """The state at a point; ``sigma`` is estimated unless it is given, and ``effective`` is how many unknowns the data
    determine, by default all."""
    return _state_of(task, space, z, linear_rows(space, task.observed, z), sigma, effective)


def sigma_at(
    task: ObservedTask, space: Parameters, z: Float[AnyArray, " z"], effective: Float[AnyArray, ""]
) -> Float[AnyArray, ""]:
    """The standard deviation of a tip coordinate that `state_at` estimates, without derivatives by the unknowns."""
    rows = residual_rows(space, task.observed, z)
    none = np.arange(0)
    linear = [Linear(part, namespace(z).zeros((0, *part.values.shape)), none) for part in rows]
    return _state_of(task, space, z, linear, None, effective).sigma


def _state_of(
    task: ObservedTask, space: Parameters, z: Float[AnyArray, " z"], linear: list[Linear], sigma: Any, effective: Any
) -> State:
    p = len(space.names)
    forward = task.observed.forward(space, z[:p], z[p:])
    errors = propagation.arm_errors(forward, linear, task.observed)
    if sigma is None:
        xp = namespace(z, effective)
        spent = z.shape[0] if effective is None else effective
        degrees_of_freedom = xp.maximum(xp.asarray(task.observed.equations - spent, dtype=float), 1.0)
        scatter = propagation.scatter_of if task.loss is None else propagation.robust_scatter_of
        sigma = scatter(linear, errors, degrees_of_freedom)
    return State(linear, errors, sigma)


def whitening_at(task: ObservedTask, state: State, prior: PriorRows | None = None) -> Whitening:
    """The weights of everything by the state of a nearly right arm."""
    if task.noise is None:
        of_arm = [propagation.covariance_of_sigma(errors, state.sigma) for errors in state.errors]
    else:
        of_arm = [propagation.covariance_of_noise(errors, task.noise) for errors in state.errors]
    least = namespace(state.sigma).maximum(_LEAST * state.sigma, 1e-12)
    return whitening_of(state.linear, task.observed, of_arm, least)._replace(prior=prior)


def scatter_at_start(task: ObservedTask, space: Parameters, z: Float[AnyArray, " z"]) -> Any:
    """Root mean square of the start's residuals in mm, for the first weights."""
    xp = namespace(z, task)
    values = [part.rows.values[:3] for part in linear_rows(space, task.observed, z)]
    flat = xp.concatenate([xp.reshape(value, (-1,)) for value in values])
    return xp.sqrt(xp.mean(flat**2)) + 1e-9
