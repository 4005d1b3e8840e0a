"""One identification, checked: what is free, what was observed, and whether it can be determined.

`Solving` holds the options of a solve; `task_of` makes a `Task` of an arm, a capture and a box. Everything that can be
known to be wrong is refused here, before anything is solved.
"""

import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from ..core._compat import inside_trace
from ..core.arguments import Count
from ..core.arrays import Numbers, as_array, is_concrete
from ..core.errors import IdentifiabilityWarning, InputError
from ..core.numpy_or_jax import AnyArray, to_numpy
from ..data.capture import Capture
from ..data.noise import Noise
from ..kinematics.arm import Arm, check_columns, is_single
from ..kinematics.chain import forward_pass
from ..kinematics.parameters import Bounds, Parameters, based_on
from ..kinematics.priors import Prior
from ..model.loss_names import LossName
from ..model.observed import Observed
from ..model.robust import Loss
from ..uncertainty.covariance import NoiseModel
from ..uncertainty.identifiability import observability
from .scale_anchor import Method, ScaleAnchor, default_method, fixes_scale, scale_anchor, scale_from_slides

_LEAST_TURN = 0.05  # of a component of the last frame's axes, with which a target's place can be told


class Solving(NamedTuple):
    """How a problem is solved, as the arguments of `pipeline.single.identify` say."""

    hold: str | None = "longest"
    start: Numbers | None = None
    noise: Noise | None = None
    noise_model: NoiseModel | None = None
    robust: LossName | None = None
    prior: Prior | None = None
    max_steps: Count = 300


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
    # Parts of the geometry that are given, where only the rest of it is fitted, to the tips of a given arm.
    kept: Mapping[str, AnyArray] | None = None

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
    def fitted(self) -> np.ndarray:
        """Which of the unknowns (free parameters, then the geometry) are fitted: all, unless the arm is given."""
        kept, blocks = self.kept, self.observed.blocks
        if kept is None:
            return np.ones(len(self.free) + len(self.observed.steps), dtype=bool)
        of_parts = (np.full(len(units), name not in kept) for name, units in blocks.items())
        return np.concatenate([np.zeros(len(self.free), dtype=bool), *of_parts])

    @property
    def needs_no_weights(self) -> bool:
        """Whether all rows weigh the same at every arm, and are linear in the unknown geometry."""
        weighted = self.noise is not None or self.loss is not None or self.prior is not None or bool(self.kept)
        return not weighted and self.observed.layout.means_alone


def task_of(arm: Arm, capture: Capture, bounds: Bounds, solving: Solving) -> Task:
    """A checked task. Everything that the capture holds takes part, reference lengths too."""
    noise, prior = solving.noise, solving.prior
    space = based_on(bounds.space, arm)
    bounds = Bounds(space, bounds.lower, bounds.upper)
    vector = space.vector() if solving.start is None else as_array(solving.start, "the start")
    check_columns(space.base, capture.columns)
    _check_start(bounds, vector, "the start" if solving.start is not None else "the arm")
    anchor = anchor_of(space, capture, capture, solving.hold, noise)
    noise_model = checked_noise_model(solving.noise_model, noise, arm.joints)
    observed = Observed.of(capture, space.base)
    if is_concrete(*jax.tree.leaves((arm, capture, vector))):
        check_data(capture, observed, *to_numpy((space, vector)), anchor, solving)
    stated = prior and prior.of(space.names, space.vector())
    if stated is not None and is_concrete(*jax.tree.leaves((prior, bounds))):
        mean, low, high = (np.asarray(side)[stated.index] for side in (stated.mean, bounds.lower, bounds.upper))
        for i in np.flatnonzero(~((low <= mean) & (mean <= high))):
            raise InputError(
                f"the prior's mean of {space.names[stated.index[i]]} is {mean[i]:g}, outside its bounds {low[i]:g} to "
                f"{high[i]:g} (mm or rad); correct the mean or widen the bounds."
            )
    return Task(
        observed=observed,
        bounds=bounds,
        start=vector,
        noise=noise,
        anchor=anchor,
        noise_model=noise_model,
        max_steps=solving.max_steps,
        loss=None if solving.robust is None else Loss(solving.robust),
        pose=configurations(observed.q),
        prior=prior,
    )


def anchor_of(
    space: Parameters, solved: Capture, capture: Capture, hold: str | None, noise: Noise | None
) -> ScaleAnchor:
    """The scale anchor of a solve: none where the data that are ``solved`` fix the scale, unless a length is named.
    Slides are judged at the poses of the ``capture``."""
    if fixes_scale(solved) and hold in (None, "longest"):
        return ScaleAnchor()
    return scale_anchor(space, space.base, hold, noise, capture)


def without_lengths(capture: Capture) -> Capture:
    """The capture without its reference lengths, as stage 1 solves it."""
    return eqx.tree_at(lambda c: c.lengths, capture, (), is_leaf=lambda leaf: isinstance(leaf, tuple))


def method_of(
    arm: Arm, capture: Capture, space: Parameters, solving: Solving, method: Method | None, at_once: bool = False
) -> tuple[Method, bool]:
    """The method of a calibration, and whether everything is solved at once from the beginning: where more than sockets
    and lengths take part, or ``at_once``. Raises `InputError` for another method, and where nothing fixes the scale."""
    by_slides = scale_from_slides(arm, capture, space, solving.noise)
    general = at_once or bool(capture.observations) or solving.robust is not None or solving.prior is not None
    general = general or by_slides
    method = default_method(arm, general) if method is None else method
    if method == "two-stage" and general:
        raise InputError(
            "method='two-stage' is for sockets with reference lengths, without a robust loss, a prior and covariances "
            "of batches; use method='joint'."
        )
    if not by_slides and not fixes_scale(capture):
        raise InputError(
            "the capture holds no reference length, so the scale cannot be fixed; add one between two sockets, or take "
            "the scale from the nominal arm (--scale nominal; from Python, identify for stage 1 alone)."
        )
    return method, general


def check_single(arm: Arm, capture: Capture, bounds: Bounds, many: str) -> None:
    """Raise `InputError` where an arm, a capture or bounds are a batch; ``many`` is the function that takes batches."""
    wide = max(bounds.lower.ndim, bounds.upper.ndim) > 1
    is_batch = {"arm": not is_single(arm), "capture": capture.q.ndim > 2, "bounds": wide}
    if batches := [what for what, batch in is_batch.items() if batch]:
        raise InputError(
            f"the {' and the '.join(batches)} given are a batch, but one problem is solved here; use {many}."
        )


def _check_start(bounds: Bounds, vector: AnyArray, what: str) -> None:
    """Raise `InputError` where a start is not one value a parameter, inside the box."""
    if vector.shape != (len(bounds.space.names),):
        raise InputError(
            f"{what} has shape {vector.shape}, but {len(bounds.space.names)} parameters are free; give one value each."
        )
    if not is_concrete(vector, bounds.lower, bounds.upper):
        return
    values, lower, upper = (np.asarray(x) for x in (vector, bounds.lower, bounds.upper))
    for i in np.flatnonzero(~((values >= lower) & (values <= upper))):
        raise InputError(
            f"{what} is outside the bounds: {bounds.space.names[i]} is {values[i]:g}, not within {lower[i]:g} to "
            f"{upper[i]:g}; move the start or widen the bounds."
        )


def checked_noise_model(noise_model: NoiseModel | None, noise: Noise | None, joints: int) -> NoiseModel:
    """The model of the tips' errors: by default the noise that is given, else one estimated from the residuals."""
    if noise is not None:
        noise.check(joints)
    if noise_model is None:
        return "estimated" if noise is None else "given"
    if noise_model == "given" and noise is None:
        raise InputError("noise_model='given' needs the noise; give noise=aj.Noise(encoder_arcsec=..., seating=...).")
    if noise_model == "estimated" and noise is not None:
        raise InputError("the noise is given, so it is not estimated; leave out noise, or choose another noise_model.")
    return noise_model


def configurations(q: Any) -> tuple[int, ...]:
    """A number for each different configuration; different ones where the readings are traced."""
    if not is_concrete(q):
        return tuple(range(q.shape[0]))
    return tuple(int(i) for i in np.unique(np.asarray(q), axis=0, return_inverse=True)[1].ravel())


def check_data(
    capture: Capture,
    observed: Observed,
    space: Parameters,
    vector: Float[AnyArray, " p"],
    anchor: ScaleAnchor,
    solving: Solving,
) -> None:
    """Raise `InputError` where a capture cannot determine what is unknown."""
    prior, noise = solving.prior, solving.noise
    if prior is None and not capture.observations and not capture.lengths:
        # Repeatability does not determine the scale: where lengths are free, it determines one parameter less.
        check_enough(capture.sizes, len(space.names) - int(space.lengths.any()))
    free = tuple(name for name in space.names if name != anchor.hold)
    unknowns = len(free)
    if prior is not None:
        prior.check(space.base)
        # The prior determines its parameters, unless the noise has to be estimated: fewer equations than unknowns would
        # leave nothing to do that from.
        stated = None if noise is None else prior.of(free, np.zeros(len(free)))
        unknowns -= 0 if stated is None else len(stated.index)
    check_observed(observed, space, vector, unknowns)


def check_enough(sizes: tuple[int, ...], unknowns: int) -> None:
    """Raise `InputError` where poses are too few: m poses in a socket give 3 (m - 1) equations."""
    # 3 m coordinates, of which 3 find the position of the socket.
    equations = 3 * sum(size - 1 for size in sizes)
    if equations < unknowns:
        sockets, poses = len(sizes), sum(sizes)
        needed = -(-unknowns // 3) + sockets
        raise InputError(
            f"{poses} poses in {sockets} socket{'s' if sockets > 1 else ''} give {equations} equations, but {unknowns} "
            f"unknowns need at least {needed} poses; record more poses or hold more parameters."
        )


def check_observed(observed: Observed, space: Parameters, vector: Float[AnyArray, " p"], count: int) -> None:
    """Raise `InputError` where the observations cannot determine their own unknowns, or ``count`` parameters."""
    forward = forward_pass(space.geometry(vector), observed.motion)
    for observation, rows in zip(observed.observations, observed.slices, strict=True):
        # Through the class: a bound method of Equinox is a module made anew.
        type(observation).check_determined(observation, np.asarray(forward.tip[:, rows]))
    # A target at t in the last frame (x, y, z) is seen at F (p + R t): where R is one matrix, t and the translation of
    # the station's frame F cannot be told apart.
    poses: dict[str, list[np.ndarray]] = {}
    for observation, part in zip(observed.observations, observed.slices, strict=True):
        if observation.target:
            poses.setdefault(observation.target, []).append(np.arange(part.start, part.stop))
    for target, parts in poses.items():
        axes = [np.asarray(forward.frame[i])[:, np.concatenate(parts)] for i in (0, 2)]
        if max(np.ptp(axis, axis=1).max() for axis in axes) < _LEAST_TURN:
            raise InputError(
                f"target '{target}' was seen from one orientation of the last frame, in which its place cannot be told "
                "from that of the instrument; take poses with the wrist turned."
            )
    geometry = len(observed.steps)
    if observed.equations < count + geometry:
        raise InputError(
            f"the observations give {observed.equations} equations, but {count + geometry} numbers are unknown "
            f"({count} parameters and {geometry} of the unknown geometry); record more poses, fix more parameters, or "
            "give a prior of them together with the noise."
        )


def check_identifiable(capture: Capture, bounds: Bounds, prior: Prior | None, strict: bool) -> None:
    """Warn of, or with ``strict`` refuse, free parameters that these data cannot determine; not of traced values."""
    if inside_trace() or not is_concrete(*jax.tree.leaves((capture, bounds))):
        return
    space = bounds.space
    stated = None if prior is None else prior.of(space.names, space.vector())
    names = () if stated is None else tuple(space.names[i] for i in stated.index)
    seen = observability(space.base, capture, space, known=names)
    lost = seen._replace(by_prior=()).sentences()
    if lost and strict:
        raise InputError(" ".join(lost))
    for sentence in seen.sentences():
        warnings.warn(sentence, IdentifiabilityWarning, stacklevel=4)
