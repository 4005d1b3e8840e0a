"""The steps of the bounded Levenberg-Marquardt: from one evaluated model to the next trial, for any number of slots.

Minimises 1/2 |f(y)|^2 subject to lower <= y <= upper. A trial is accepted by what the model predicts for it (a clipped
step can point uphill, and is then refused). f is never evaluated outside the box. `active_set` makes the trials.
Sources: Marquardt 1963; More 1978 (scaling, tests); Nielsen 1999 (damping).
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .active_set import Box, Flat, Number, QuadraticModel, Step, choose, diagonal, norm, propose
from .reason import Reason, either

_EPSILON = float(jnp.finfo(jnp.float64).eps)


class Rules(NamedTuple):
    """When to stop, and how much the first step is damped."""

    rtol: float  # on the step, relative to |y| (both scaled)
    atol: float  # on the step, scaled
    gtol: float  # on the projected gradient: cosine between the residual and a column of J
    initial_damping: float | None  # relative to the largest curvature; None: steps are kept to a trust region instead


class Progress(eqx.Module):
    """State of one solve, or of a batch of them in slots, between two evaluations."""

    y: Flat  # accepted
    model: QuadraticModel  # at y
    optimality: Number  # at y; see `Box.optimality`
    step: Step  # its trial is where the next evaluation happens
    damping: Number
    growth: Number  # what the next refusal multiplies the damping by
    curvature: Flat  # running maximum of diag(J^T J)
    steps: Int[Array, "*slots"]  # evaluations
    accepted: Int[Array, "*slots"]
    reason: Reason


def begin(y: Flat, box: Box) -> Progress:
    """State before the first evaluation, which happens at the start clipped to the box."""
    y = box.clip(y)
    zero, none = jnp.zeros(y.shape[:-1]), jnp.zeros(y.shape[:-1], dtype=jnp.int64)
    return Progress(
        y=y,
        model=QuadraticModel(zero + jnp.inf, jnp.zeros_like(y), jnp.zeros((*y.shape, y.shape[-1]))),
        optimality=zero + jnp.inf,
        step=Step(y, zero, zero + jnp.inf),
        damping=zero,
        growth=zero + 2.0,
        curvature=jnp.zeros_like(y),
        steps=none,
        accepted=none,
        reason=either(zero == 0, Reason.running, Reason.running),
    )


def advance(progress: Progress, evaluated: QuadraticModel, box: Box, rules: Rules) -> Progress:
    """Accept or refuse the trial from its evaluated model, test for convergence, and propose the next trial."""
    first = progress.steps == 0
    finite = evaluated.finite()
    trial = progress.step.trial
    trial_optimality = box.optimality(trial, evaluated)
    accept = finite & (first | _improves(progress, evaluated, trial_optimality))
    y, model, optimality = choose(
        accept, (trial, evaluated, trial_optimality), (progress.y, progress.model, progress.optimality)
    )
    curvature = jnp.maximum(progress.curvature, diagonal(model.gram))
    scale = _scale(box, curvature)

    ratio = _ratio(progress, evaluated, accept)
    damping, growth = _next_damping(progress, ratio, accept)
    largest = jnp.max(scale**2 * curvature, axis=-1)
    # With less, rounding in the Gram matrix can make it indefinite.
    least = 1e3 * _EPSILON * largest
    initial = 0.0 if rules.initial_damping is None else rules.initial_damping * largest
    damping = jnp.maximum(jnp.where(first, initial, damping), least)
    radius = None
    if rules.initial_damping is None:
        trusted = jnp.where(_within_rounding(progress, evaluated), 1.0, ratio)
        radius = _next_radius(progress, y, model, scale, trusted, accept)
        radius = jnp.where(model.finite(), radius, jnp.inf)

    step, damping = propose(y, model, box, scale, damping, radius)

    # After an accepted trial the next step is tested: where it is too small to matter it is not taken, which saves the
    # last evaluation. After a refusal, the refused one. Both before clipping: a step that the box cuts to nothing says
    # only that the damping is still too small.
    small_step = jnp.where(accept, step.length, progress.step.length) <= rules.rtol * norm(y / scale) + rules.atol
    below_rounding = jnp.abs(progress.step.predicted) <= 4 * _EPSILON * progress.model.cost
    unclipped = norm((trial - progress.y) / scale) >= 0.5 * progress.step.length
    tiny = small_step | (below_rounding & unclipped & ~accept & finite)
    # Refusals alone made this step tiny, far from any minimum: the model is wrong (a false derivative, a kink).
    forced = ~accept & (progress.damping > 1e-3 * largest) & (optimality > 1e-6)
    reason = either(tiny, either(small_step, Reason.step, Reason.rounding), Reason.running)
    reason = either(tiny & forced, Reason.stalled, reason)
    reason = either(optimality <= rules.gtol, Reason.gradient, reason)
    reason = either(first & ~finite, Reason.nonfinite, reason)
    return Progress(
        y=y,
        model=model,
        optimality=optimality,
        step=step,
        damping=damping,
        growth=growth,
        curvature=curvature,
        steps=progress.steps + 1,
        accepted=progress.accepted + jnp.where(accept, 1, 0),
        reason=reason,
    )


def _improves(progress: Progress, evaluated: QuadraticModel, trial_optimality: Number) -> Bool[Array, "*slots"]:
    predicted = progress.step.predicted
    decreases = progress.model.cost - evaluated.cost > 1e-4 * predicted
    closer = trial_optimality < progress.optimality
    return (predicted > 0) & jnp.where(_within_rounding(progress, evaluated), closer, decreases)


def _within_rounding(progress: Progress, evaluated: QuadraticModel) -> Bool[Array, "*slots"]:
    # Close to the solution the decrease drowns in the rounding of the cost; the gradient still points downhill. (Tips
    # at 1 m that differ by 10 um lose five digits, hence the wide margin.)
    margin = 1e6 * _EPSILON * progress.model.cost
    return (progress.step.predicted < margin) & (jnp.abs(progress.model.cost - evaluated.cost) < margin)


def _ratio(progress: Progress, evaluated: QuadraticModel, accept: Bool[Array, "*slots"]) -> Number:
    """Actual to predicted decrease of an accepted step."""
    predicted = jnp.where(progress.step.predicted > 0, progress.step.predicted, 1.0)
    ratio = jnp.where(accept, (progress.model.cost - evaluated.cost) / predicted, 0.0)
    return jnp.where(jnp.isfinite(ratio), ratio, 0.0)


def _next_damping(progress: Progress, ratio: Number, accept: Bool[Array, "*slots"]) -> tuple[Number, Number]:
    # Nielsen's rule: shrink smoothly with the ratio, grow ever faster with refusals.
    shrink = jnp.clip(1.0 - (2.0 * ratio - 1.0) ** 3, 0.1, 2.0)
    damping = progress.damping * jnp.where(accept, shrink, progress.growth)
    return damping, jnp.where(accept, 2.0, 2.0 * progress.growth)


def _next_radius(
    progress: Progress, y: Flat, model: QuadraticModel, scale: Flat, ratio: Number, accept: Array
) -> Number:
    # As in trust-region methods. At first the distance of the start from 0: from a bad start a step of Gauss and Newton
    # can leave the region in which the residual depends on the unknowns at all (NIST's BoxBOD), and a step that is
    # damped a given amount may follow the steepest descent into the wrong valley (MGH10).
    start = norm(y / scale)
    start = jnp.where(start > 0, start, jnp.sqrt(2 * model.cost))
    factor = jnp.where(accept, jnp.where(ratio > 0.75, 2.0, jnp.where(ratio > 0.25, 1.0, 0.5)), 0.25)
    return jnp.where(progress.steps == 0, start, factor * progress.step.length)


def _scale(box: Box, curvature: Flat) -> Flat:
    if box.scale is not None:
        return box.scale
    return jnp.where(curvature > 0, 1.0 / jnp.sqrt(jnp.where(curvature > 0, curvature, 1.0)), 1.0)
