"""One identification, checked."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ..core.arrays import Numbers, as_array, is_concrete
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, to_numpy
from ..data.capture import Capture
from ..data.noise import Noise
from ..kinematics.arm import Arm, check_columns
from ..kinematics.chain import forward_pass
from ..kinematics.parameters import Bounds, Parameters, based_on
from ..kinematics.priors import Prior
from ..model.loss_names import LossName
from ..model.observed import Observed
from ..model.robust import Loss, check_loss
from ..uncertainty.covariance import NoiseModel
from .checks import check_enough, check_noise_model, check_start
from .scale_anchor import ScaleAnchor, scale_anchor

NO_ANCHOR = ScaleAnchor(hold=None, free=False, set_by=(), partners=None)


class Task(NamedTuple):
    """An identification, checked; the space of its bounds is based on the arm that is calibrated."""

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

    @property
    def space(self) -> Parameters:
        """The parameters that are free, but for the scale anchor, on the arm at the start."""
        names = self.bounds.space.names
        return Parameters(self.bounds.space.arm(self.start), tuple(names[i] for i in self.free))

    @property
    def free(self) -> np.ndarray:
        """Indices of these among the parameters of the bounds."""
        return np.flatnonzero([name != self.anchor.hold for name in self.bounds.space.names])

    @property
    def needs_no_weights(self) -> bool:
        """Whether all rows weigh the same at every arm, and are linear in the unknown geometry."""
        layout, known = self.observed.layout, self.noise is None and self.loss is None and self.prior is None
        return known and not layout.shared and layout.linear == len(layout.classes)


def task_of(
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
) -> Task:
    """A checked task. Everything that the capture holds takes part, reference lengths too."""
    space = based_on(bounds.space, arm)
    bounds = Bounds(space, bounds.lower, bounds.upper)
    vector = space.vector() if start is None else as_array(start, "the start")
    if max_steps < 1:
        raise InputError(f"max_steps is {max_steps}; give at least 1.")
    check_loss(robust)
    check_columns(space.base, capture.columns)
    check_start(bounds, vector, "the start" if start is not None else "the arm")
    fixed = bool(capture.lengths) or any(observation.fixes_scale for observation in capture.observations)
    if fixed and hold == "longest":
        hold = None
    anchor = scale_anchor(space, space.base, hold, noise, capture) if not fixed or hold else NO_ANCHOR
    noise_model = check_noise_model(noise_model, noise, arm.joints)
    observed = Observed.of(capture, space.base)
    if is_concrete(*jax.tree.leaves((arm, capture, vector))):
        known, at = to_numpy((space, vector))
        if prior is None and not capture.observations and not capture.lengths:
            # Repeatability does not determine the scale: where lengths are free, it determines one parameter less.
            check_enough(capture.sizes, len(space.names) - int(space.lengths.any()))
        check_observed(observed, known, at, unknown_parameters(space, anchor, prior, noise))
    if prior is not None and is_concrete(*jax.tree.leaves((prior, bounds))):
        check_means(prior, bounds)
    return Task(
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
        # Through the class: a bound method of Equinox is a module made anew.
        type(observation).check_determined(observation, np.asarray(forward.tip[:, rows]))
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
