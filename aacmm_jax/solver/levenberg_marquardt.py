"""The steps of the bounded Levenberg-Marquardt: from one evaluated model to the next trial.

Minimises 1/2 |f(y)|^2 subject to lower <= y <= upper. A trial is accepted by what the model predicts for it (a clipped
step can point uphill, and is then refused). f is never evaluated outside the box. `active_set` makes the trials.
Sources: Marquardt 1963; More 1978 (scaling, tests); Nielsen 1999 (damping).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from ..core.numpy_or_jax import AnyArray, namespace, while_loop
from .active_set import Box, Flat, Number, QuadraticModel, Step, choose, norm, propose
from .arrow import Arrow
from .reason import GRADIENT, MAX_STEPS, NONFINITE, ROUNDING, RUNNING, STALLED, STEP

_EPSILON = float(np.finfo(np.float64).eps)


class Rules(NamedTuple):
    """When to stop, and how much the first step is damped."""

    rtol: float = 1e-14  # on the next step, relative to |y| (both scaled)
    atol: float = 0.0  # on the step, scaled
    gtol: float = 1e-10  # on the projected gradient: cosine between the residual and a column of J
    # Relative to the largest curvature; None: as little as keeps the steps within a trust region, whose first radius is
    # the scaled length of the start. A value saves the search where a problem is known to need none.
    initial_damping: float | None = None


class Progress(eqx.Module):
    """State of one solve, or of a batch of them in slots, between two evaluations."""

    y: Flat  # accepted
    model: QuadraticModel  # at y
    optimality: Number  # at y; see `Box.optimality`
    step: Step  # its trial is where the next evaluation happens
    damping: Number
    growth: Number  # what the next refusal multiplies the damping by
    curvature: Flat  # running maximum of diag(J^T J)
    steps: Int[AnyArray, "*slots"]  # evaluations
    accepted: Int[AnyArray, "*slots"]
    reason: Int[AnyArray, "*slots"]  # number of a `Reason`


def begin(y: Flat, box: Box, gram: Any = None) -> Progress:
    """State before the first evaluation, which happens at the start clipped to the box; ``gram`` has the form of the
    Gram matrices to come, by default that of a dense one."""
    y, xp = box.clip(y), namespace(y)
    zero, none = xp.zeros(y.shape[:-1]), xp.zeros(y.shape[:-1], dtype=np.int64)
    gram = xp.zeros((*y.shape, y.shape[-1])) if gram is None else gram
    model, step = QuadraticModel(zero + np.inf, xp.zeros_like(y), gram), Step(y, zero, zero + np.inf)
    reason = xp.full(y.shape[:-1], RUNNING, dtype=np.int32)
    return Progress(y, model, zero + np.inf, step, zero, zero + 2.0, xp.zeros_like(y), none, none, reason)


def advance(progress: Progress, evaluated: QuadraticModel, box: Box, rules: Rules) -> Progress:
    """Accept or refuse the trial from its evaluated model, test for convergence, and propose the next trial."""
    xp, first, before, tried = namespace(progress), progress.steps == 0, progress.model, progress.step
    finite, decrease = evaluated.finite(), before.cost - evaluated.cost
    trial_optimality = box.optimality(tried.trial, evaluated)
    # Close to the solution the decrease drowns in the rounding of the cost; the gradient still points downhill. (Tips
    # at 1 m that differ by 10 um lose five digits, hence the wide margin.)
    margin = 1e6 * _EPSILON * before.cost
    within_rounding = (tried.predicted < margin) & (xp.abs(decrease) < margin)
    closer = trial_optimality < progress.optimality
    improves = (tried.predicted > 0) & xp.where(within_rounding, closer, decrease > 1e-4 * tried.predicted)
    accept = finite & (first | improves)
    y, model, optimality = choose(
        accept, (tried.trial, evaluated, trial_optimality), (progress.y, before, progress.optimality)
    )
    curvature = xp.maximum(progress.curvature, Arrow.of(model.gram).diagonal())
    scale = box.scale
    if scale is None:
        scale = xp.where(curvature > 0, 1.0 / xp.sqrt(xp.where(curvature > 0, curvature, 1.0)), 1.0)
    # Actual to predicted decrease of an accepted step. Nielsen's rule: shrink smoothly with it, grow ever faster with
    # refusals.
    ratio = xp.where(accept, decrease / xp.where(tried.predicted > 0, tried.predicted, 1.0), 0.0)
    ratio = xp.where(xp.isfinite(ratio), ratio, 0.0)
    shrink = xp.clip(1.0 - (2.0 * ratio - 1.0) ** 3, 0.1, 2.0)
    damping = progress.damping * xp.where(accept, shrink, progress.growth)
    growth = xp.where(accept, 2.0, 2.0 * progress.growth)
    largest = xp.max(scale**2 * curvature, axis=-1)
    # With less, rounding in the Gram matrix can make it indefinite.
    least = 1e3 * _EPSILON * largest
    initial = 0.0 if rules.initial_damping is None else rules.initial_damping * largest
    damping, radius = xp.maximum(xp.where(first, initial, damping), least), None
    if rules.initial_damping is None:
        radius = _next_radius(progress, y, model, scale, xp.where(within_rounding, 1.0, ratio), accept)
        radius = xp.where(model.finite(), radius, np.inf)
    step, damping = propose(y, model, box, scale, damping, radius)

    # After an accepted trial the next step is tested: where it is too small to matter it is not taken, which saves the
    # last evaluation. After a refusal, the refused one. Both before clipping: a step that the box cuts to nothing says
    # only that the damping is still too small.
    small_step = xp.where(accept, step.length, tried.length) <= rules.rtol * norm(y / scale) + rules.atol
    below_rounding = xp.abs(tried.predicted) <= 4 * _EPSILON * before.cost
    unclipped = norm((tried.trial - progress.y) / scale) >= 0.5 * tried.length
    tiny = small_step | (below_rounding & unclipped & ~accept & finite)
    # Refusals alone made this step tiny, far from any minimum: the model is wrong (a false derivative, a kink). A step
    # this small may be accepted all the same: the cost does not resolve it, and which of two equal gradients is the
    # smaller one is decided by rounding.
    forced = (progress.damping > 1e-3 * largest) & (optimality > 1e-6)
    reason = xp.where(tiny, xp.where(forced, STALLED, xp.where(small_step, STEP, ROUNDING)), RUNNING)
    # A gradient may also be zero because the residual, or its derivative, depends on no unknown at all.
    ended = xp.where((largest > 0) | (model.cost == 0), GRADIENT, STALLED)
    reason = xp.where(optimality <= rules.gtol, ended, reason)
    reason = xp.where(first & ~finite, NONFINITE, reason).astype(np.int32)
    steps, accepted = progress.steps + 1, progress.accepted + xp.where(accept, 1, 0)
    return Progress(y, model, optimality, step, damping, growth, curvature, steps, accepted, reason)


def _next_radius(progress: Progress, y: Flat, model: QuadraticModel, scale: Flat, ratio: Number, accept: Any) -> Number:
    """The trust radius, scaled, of which the damping is to make the next step."""
    xp = namespace(progress)
    # At first the distance of the start from 0: from a bad start a step of Gauss and Newton can leave the region in
    # which the residual depends on the unknowns at all (NIST's BoxBOD), and a step that is damped a given amount may
    # follow the steepest descent into the wrong valley (MGH10).
    start = norm(y / scale)
    start = xp.where(start > 0, start, xp.sqrt(2 * model.cost))
    factor = xp.where(accept, xp.where(ratio > 0.75, 2.0, xp.where(ratio > 0.25, 1.0, 0.5)), 0.25)
    return xp.where(progress.steps == 0, start, factor * progress.step.length)


def minimise(
    model: Callable[[Any, Any], QuadraticModel], start: Flat, args: Any, box: Box, rules: Rules, max_steps: int
) -> Progress:
    """The steps of `solver.least_squares` in NumPy, with nothing to compile, or in JAX for a batch; not differentiable.

    ``model`` is a function of (y, args); ``start`` is clipped to the box. The reason of the last state is the step
    limit where that was reached.
    """
    form = None
    if namespace(start, args) is not np:
        form = jax.eval_shape(model, start, args).gram
        form = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), form)
    progress = while_loop(
        lambda progress: (progress.reason == RUNNING) & (progress.steps < max_steps),
        lambda progress: advance(progress, model(progress.step.trial, args), box, rules),
        begin(start, box, form),
    )
    ended = namespace(progress).where(progress.reason == RUNNING, MAX_STEPS, progress.reason).astype(np.int32)
    return eqx.tree_at(lambda p: p.reason, progress, ended)
