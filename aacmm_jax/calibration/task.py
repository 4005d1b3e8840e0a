"""One identification, checked, and its weighted least squares.

`Solving` holds the options of a solve; `task_of` makes a `Task` of an arm, a capture and a box. Everything that can be
known to be wrong is refused here, before anything is solved.

The unknowns z of a least squares are the free parameters, then the unknown geometry. Rows are whitened by the
covariance of what was measured plus that of the tips' errors, which depends on the arm (`state_at`, `whitening_at`). So
a problem is solved at least twice: with the weights of the start, and with those of that solution. Where the noise is
not given, tips are taken to scatter as much as the residuals of the last solve do (`variance_components.scatter_of`).
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from ..core.arguments import Count
from ..core.arrays import Numbers, as_array, is_concrete
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, namespace, stop_gradient, to_numpy
from ..data.capture import Capture
from ..data.noise import Noise
from ..data.observations.observation import Rows
from ..kinematics.arm import Arm, check_columns
from ..kinematics.chain import ForwardPass, forward_pass
from ..kinematics.parameters import Bounds, Parameters, based_on
from ..kinematics.priors import ParameterPrior, Prior
from ..model.elimination import Args, observed_model, observed_rows
from ..model.loss_names import LossName
from ..model.observed import Observed
from ..model.robust import Loss
from ..model.rows import PointRows, PriorRows, Whitening, rows_at, whitening_of
from ..solver.active_set import Box
from ..solver.levenberg_marquardt import Rules, minimise
from ..solver.reason import GRADIENT, Reason, reasons
from ..uncertainty import linear_propagation, variance_components
from ..uncertainty.covariance import NoiseModel
from .scale_anchor import ScaleAnchor, fixes_scale, scale_anchor

_LEAST_TURN = 0.05  # of a component of the last frame's axes, with which a target's place can be told
# The boxes of this problem are small against its curvature, so the first steps can be nearly Gauss-Newton's.
RULES = Rules(rtol=1e-13, initial_damping=1e-8)
# Of solves that begin where one with nearly the same weights ended: damping would shorten steps that are right.
NEAR = RULES._replace(initial_damping=1e-11)
_ROUGH = 1e-7  # tolerance of solves whose result only gives the weights of the next, or its start
_LEAST = 1e-4  # smallest standard uncertainty of what is certified, of a tip coordinate's standard deviation


class Solving(NamedTuple):
    """How a problem is solved: the keyword arguments of `pipeline.single.identify`, described there."""

    hold: str | None = "longest"
    start: Numbers | None = None
    noise: Noise | None = None
    noise_model: NoiseModel | None = None
    robust: LossName | None = None
    prior: Prior | None = None
    replace_noise: bool = True
    max_steps: Count = 300

    @property
    def all_at_once(self) -> bool:
        """Whether a division by k would ignore part of it."""
        return self.robust is not None or self.prior is not None

    @property
    def may_replace_noise(self) -> bool:
        """Whether the noise of noisy encoders may be replaced: a robust loss and other models of noise have none."""
        return self.replace_noise and self.noise_model not in ("common", "robust") and self.robust is None


class Task(NamedTuple):
    """An identification, checked; the space of its bounds is based on the arm that is calibrated."""

    observed: Observed
    bounds: Bounds
    start: Float[AnyArray, " p"]
    noise: Noise | None
    noise_model: NoiseModel
    anchor: ScaleAnchor = ScaleAnchor()
    max_steps: int = 300
    loss: Loss | None = None
    pose: tuple[int, ...] = ()  # number of the configuration of each row; equal ones were read at once
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
        if self.kept is None:
            return np.ones(len(self.free) + len(self.observed.steps), dtype=bool)
        of_parts = (np.full(len(units), name not in self.kept) for name, units in self.observed.blocks.items())
        return np.concatenate([np.zeros(len(self.free), dtype=bool), *of_parts])

    @property
    def free_prior(self) -> ParameterPrior | None:
        """The prior of the parameters that are free; None where nothing is known of any."""
        return None if self.prior is None else self.prior.of(self.space.names, self.bounds.space.vector()[self.free])

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
    what = "the arm" if solving.start is None else "the start"
    if vector.shape != (len(space.names),):
        raise InputError(
            f"{what} has shape {vector.shape}, but {len(space.names)} parameters are free; give one value per free "
            "parameter."
        )
    if is_concrete(vector, bounds.lower, bounds.upper):
        values, lower, upper = (np.asarray(x) for x in (vector, bounds.lower, bounds.upper))
        for i in np.flatnonzero(~((values >= lower) & (values <= upper))):
            raise InputError(
                f"{what} is outside the bounds: {space.names[i]} is {values[i]:g}, not within {lower[i]:g} to "
                f"{upper[i]:g}; move the start or widen the bounds."
            )
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
    loss, pose = None if solving.robust is None else Loss(solving.robust), configurations(observed.q)
    return Task(observed, bounds, vector, noise, noise_model, anchor, solving.max_steps, loss, pose, prior=prior)


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


def checked_noise_model(noise_model: NoiseModel | None, noise: Noise | None, joints: int) -> NoiseModel:
    """The model of the tips' errors: by default the noise that is given, else one estimated from the residuals."""
    if noise is not None:
        noise.check(joints)
    if noise_model is None:
        return "estimated" if noise is None else "given"
    if noise_model == "given" and noise is None:
        raise InputError("noise_model='given' needs the noise; give noise=aj.Noise(encoder_arcsec=..., seating=...).")
    if noise_model == "estimated" and noise is not None:
        raise InputError("noise_model='estimated' cannot be combined with a given noise; omit one of the two.")
    return noise_model


def configurations(q: Any) -> tuple[int, ...]:
    """A number for each different configuration; different ones where the readings are traced."""
    if not is_concrete(q):
        return tuple(range(q.shape[0]))
    return tuple(int(i) for i in np.unique(np.asarray(q), axis=0, return_inverse=True)[1].ravel())


def check_data(
    capture: Capture, observed: Observed, space: Parameters, vector: AnyArray, anchor: ScaleAnchor, solving: Solving
) -> None:
    """Raise `InputError` where a capture cannot determine what is unknown."""
    prior = solving.prior
    if prior is None and not capture.observations and not capture.lengths:
        # Repeatability does not determine the scale: where lengths are free, it determines one parameter less.
        check_enough(capture.sizes, len(space.names) - int(space.lengths.any()))
    free = tuple(name for name in space.names if name != anchor.hold)
    unknowns = len(free)
    if prior is not None:
        prior.check(space.base)
        # The prior determines its parameters, unless the noise has to be estimated: fewer equations than unknowns would
        # leave nothing to do that from.
        stated = None if solving.noise is None else prior.of(free, np.zeros(len(free)))
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
            f"unknowns need at least {needed} poses; record more poses or fix more parameters."
        )


def check_observed(observed: Observed, space: Parameters, vector: Float[AnyArray, " p"], count: int) -> None:
    """Raise `InputError` where the observations cannot determine their own unknowns, or ``count`` parameters."""
    forward = forward_pass(space.geometry(vector), observed.motion)
    poses: dict[str, list[np.ndarray]] = {}
    for observation, rows in zip(observed.observations, observed.slices, strict=True):
        # Through the class: a bound method of Equinox is a module made anew.
        type(observation).check_determined(observation, np.asarray(forward.tip[:, rows]))
        if observation.target:
            poses.setdefault(observation.target, []).append(np.arange(rows.start, rows.stop))
    # A target at t in the last frame (x, y, z) is seen at F (p + R t): where R is one matrix, t and the translation of
    # the station's frame F cannot be told apart.
    for target, parts in poses.items():
        axes = [np.asarray(forward.frame[i])[:, np.concatenate(parts)] for i in (0, 2)]
        if max(np.ptp(axis, axis=1).max() for axis in axes) < _LEAST_TURN:
            raise InputError(
                f"target '{target}' was measured in only one orientation of the last frame, so the position of the "
                "target cannot be distinguished from that of the instrument; record poses in other orientations."
            )
    geometry = len(observed.steps)
    if observed.equations < count + geometry:
        raise InputError(
            f"the observations give {observed.equations} equations, but there are {count + geometry} unknowns "
            f"({count} parameters and {geometry} coordinates of the geometry); record more poses, fix more "
            "parameters, or give both a prior of the parameters and the noise."
        )


class State(NamedTuple):
    """Everything at one point of a solve."""

    point: PointRows
    errors: list[linear_propagation.ArmErrors]
    sigma: Float[AnyArray, ""]  # standard deviation of a tip coordinate, mm


class Begun(NamedTuple):
    """Where a solve begins."""

    space: Parameters
    box: tuple[AnyArray, AnyArray, AnyArray]  # bounds of the unknowns, and natural steps
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

    z = unknowns(task.start[task.free])
    point = rows_at(space, observed, z)
    before = state = state_at(task, space, z, _root_mean_square(task.observed, point.rows), point=point)
    if near is not None:
        z = unknowns(xp.clip(near, task.bounds.lower, task.bounds.upper)[task.free])
        state = state_at(task, space, z)
    return Begun(space, box_of(task), before, z, state)


def box_of(task: Task) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Lower and upper bounds of the unknowns, of which the geometry has none unless it is kept; natural steps."""
    xp, kept, sides = namespace(task), task.kept or {}, []
    for side, endless in ((task.bounds.lower, -np.inf), (task.bounds.upper, np.inf)):
        geometry = [kept.get(name, np.full(len(units), endless)) for name, units in task.observed.blocks.items()]
        sides.append(xp.concatenate([side[task.free], *geometry]))
    return *sides, xp.concatenate([task.space.scale, xp.asarray(task.observed.steps)])


def solves_of(task: Task) -> list[tuple[Loss | None, Rules]]:
    """The losses of the solves one after the other, and when each of them ends.

    Far from the solution a robust loss would see nothing but bad poses, so it begins where least squares ends, and one
    with several minima where Huber's, which has one, ends.
    """
    losses = [None] if task.needs_no_weights else [None, None]
    if task.loss is not None:
        losses = [None, Loss("huber"), task.loss, task.loss]
    rules = [RULES, *(NEAR for _ in losses[1:])]
    rules = [*(rule._replace(rtol=_ROUGH) for rule in rules[:-1]), rules[-1]]
    return list(zip(losses, rules, strict=True))


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
    # Where a batch needs no weights, errors are not computed.
    errors = linear_propagation.arm_errors(point, task.observed) if isinstance(point.forward, ForwardPass) else []
    if sigma is None:
        xp, spent = namespace(z, effective), task.fitted.sum() if effective is None else effective
        spent = spent - task.observed.apart
        degrees_of_freedom = xp.maximum(xp.asarray(task.observed.arm_equations - spent, dtype=float), 1.0)
        if task.needs_no_weights:
            squares: Any = sum(xp.sum(part.values**2) for part in point.rows)
            sigma = variance_components.root_of_sum(squares / degrees_of_freedom)
        else:
            scatter = variance_components.scatter_of if task.loss is None else variance_components.robust_scatter_of
            sigma = scatter(point.rows, errors, degrees_of_freedom)
    return State(point, errors, sigma)


def state_after(task: Task, begun: Begun, z: Float[AnyArray, " z"], point: PointRows, last: bool) -> State:
    """At the solution of a least squares; where the noise is given, only the last scatter matters, and its iteration
    costs as much as a few steps."""
    sigma = _root_mean_square(task.observed, point.rows) if task.noise is not None and not last else None
    return state_at(task, begun.space, z, sigma, point=point)


def _root_mean_square(observed: Observed, rows: list[Rows]) -> Any:
    """Of the residuals in mm, for the first weights."""
    xp, pairs = namespace([part.values for part in rows]), zip(observed.stacks, rows, strict=True)
    in_mm = [stack.in_mm(part.values, part.by_tip) for stack, part in pairs]
    return xp.sqrt(xp.mean(xp.concatenate([xp.reshape(values, (-1,)) for values in in_mm]) ** 2)) + 1e-9


def whitening_at(task: Task, state: State, prior: PriorRows | None = None) -> Whitening:
    """The weights of everything by the state of a nearly right arm."""
    if task.noise is None:
        of_arm = [linear_propagation.covariance_of_sigma(errors, state.sigma) for errors in state.errors]
    else:
        of_arm = [linear_propagation.covariance_of_noise(errors, task.noise) for errors in state.errors]
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


def fit(task: Task, args: Args, z: Float[AnyArray, " n"], begun: Begun, rules: Rules, differentiable: bool) -> Fit:
    """A least squares within bounds: differentiable for arrays of JAX, unless no derivative is needed. The steps of
    what is begun scale the unknowns."""
    xp, count = namespace(z, args, begun.box), z.shape[0]
    if not task.fitted[:count].any():
        return Fit(z, xp.zeros((), dtype=int), reasons(xp.asarray(GRADIENT)), xp.zeros(()))
    box = Box(*(side[:count] for side in begun.box))
    if xp is np or not differentiable:
        last = minimise(observed_model, z, args, box, rules, task.max_steps)
        return Fit(last.y, last.steps, reasons(last.reason), last.optimality)
    # Optimistix takes 0.2 s to import, and NumPy needs none of it.
    from ..solver.bounded import BoundedLevenbergMarquardt, least_squares

    solver = BoundedLevenbergMarquardt(**rules._asdict())
    within: dict[str, Any] = {**box._asdict(), "max_steps": task.max_steps}
    solution = least_squares(observed_rows, z, args, normal=observed_model, solver=solver, throw=False, **within)
    return Fit(solution.value, *(solution.stats[name] for name in ("num_steps", "reason", "optimality")))
