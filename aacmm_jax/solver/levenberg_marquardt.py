"""The steps of the bounded Levenberg-Marquardt: from one evaluated model to the next trial, for any number of lanes.

Minimises 1/2 |f(y)|^2 subject to lower <= y <= upper, with an active set: a parameter that sits on a bound while the
gradient pushes it outwards is left out of the damped step; the step is clipped to the box and judged by what the linear
model predicts for the *clipped* step (a clipped step can point uphill, and is then refused). f is never evaluated outside
the box.
Sources: Marquardt 1963; More 1978 (scaling, tests); Nielsen 1999 (damping); Bertsekas 1982 (active set of a projection).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jaxtyping import Array, Bool, Float, Int, PyTree

Flat = Float[Array, "*lanes p"]
Number = Float[Array, "*lanes"]
_EPSILON = float(jnp.finfo(jnp.float64).eps)


class Reason(eqx.Enumeration):
    """Why a solve ended."""

    running = "It has not ended."
    gradient = "Converged: the projected gradient is zero to the tolerance."
    step = "Converged: the last step is below the tolerance."
    rounding = "Converged: no step can lower the cost by more than rounding error."
    max_steps = "Not converged: the step limit was reached; allow more steps or start closer."
    stalled = "Not converged: no step lowers the cost although the gradient is not zero; is the residual smooth?"
    nonfinite = (
        "Not converged: the residual or its derivative is not finite at the start; check the data and the start."
    )


def reasons(numbers: Int[Array, "*lanes"]) -> Reason:
    """Reasons of many lanes from their numbers. (Equinox's own ``where`` takes a single predicate.)"""
    return eqx.tree_at(lambda item: item._value, Reason.running, numbers)


def numbers_of(reason: Reason) -> Int[Array, "*lanes"]:
    """The number of each lane's reason."""
    return jnp.asarray(reason._value)  # pyright: ignore[reportAttributeAccessIssue]


def either(pred: Bool[Array, "*lanes"], one: Reason, other: Reason) -> Reason:
    """Lane by lane, one reason or the other."""
    return reasons(jnp.where(pred, numbers_of(one), numbers_of(other)))


class Model(eqx.Module):
    """The quadratic model of the cost at one point: what one evaluation leaves for the step."""

    cost: Float[Array, "*lanes"]  # |f|^2 / 2
    gradient: Float[Array, "*lanes p"]  # J^T f
    gram: Float[Array, "*lanes p p"]  # J^T J

    def finite(self) -> Bool[Array, "*lanes"]:
        """Whether every number of it is finite."""
        sums = jnp.sum(self.gradient, axis=-1) + jnp.sum(self.gram, axis=(-2, -1))
        return jnp.isfinite(self.cost) & jnp.isfinite(sums)


class Box(eqx.Module):
    """The bounds as flat vectors, and the natural step of each unknown (None: the columns of J decide, as in MINPACK)."""

    lower: Flat
    upper: Flat
    scale: Flat | None

    def clip(self, y: Flat) -> Flat:
        """The nearest point of the box."""
        return jnp.clip(y, self.lower, self.upper)

    def pinned(self, y: Flat, gradient: Flat) -> Bool[Array, "*lanes p"]:
        """Unknowns on a bound with the gradient pushing outwards."""
        return ((y <= self.lower) & (gradient >= 0)) | ((y >= self.upper) & (gradient <= 0))


class Progress(eqx.Module):
    """State of one solve, or of many side by side in lanes, between two evaluations."""

    y: Flat  # accepted
    model: Model  # at y
    optimality: Number  # at y; see `optimality`
    trial: Flat  # where the next evaluation happens
    predicted: Number  # decrease of the cost that the model promises for the trial
    reach: Number  # scaled length of the damped step before it was clipped to the box
    damping: Number
    growth: Number  # what the next refusal multiplies the damping by
    curvature: Flat  # running maximum of diag(J^T J)
    steps: Int[Array, "*lanes"]  # evaluations
    accepted: Int[Array, "*lanes"]
    reason: Reason


class Rules(NamedTuple):
    """When to stop, and how cautiously to begin."""

    rtol: float  # on the step, relative to |y| (both scaled)
    atol: float  # on the step, scaled
    gtol: float  # on the projected gradient: cosine between the residual and a column of J
    initial_damping: float  # relative to the largest curvature


def begin(y: Flat, box: Box) -> Progress:
    """State before the first evaluation, which happens at the start clipped to the box."""
    y = box.clip(y)
    zero, none = jnp.zeros(y.shape[:-1]), jnp.zeros(y.shape[:-1], dtype=jnp.int64)
    return Progress(
        y=y,
        model=Model(zero + jnp.inf, jnp.zeros_like(y), jnp.zeros((*y.shape, y.shape[-1]))),
        optimality=zero + jnp.inf,
        trial=y,
        predicted=zero,
        reach=zero + jnp.inf,
        damping=zero,
        growth=zero + 2.0,
        curvature=jnp.zeros_like(y),
        steps=none,
        accepted=none,
        reason=either(zero == 0, Reason.running, Reason.running),
    )


def choose(pred: Bool[Array, "*lanes"], new: PyTree, old: PyTree) -> PyTree:
    """Lane by lane, the new tree or the old one."""

    def pick(one: Array, other: Array) -> Array:
        return jnp.where(pred.reshape(pred.shape + (1,) * (one.ndim - pred.ndim)), one, other)

    return jax.tree.map(pick, new, old)


def advance(progress: Progress, evaluated: Model, box: Box, rules: Rules) -> Progress:
    """Judge the trial from its evaluated model, test for convergence, and propose the next trial."""
    first = progress.steps == 0
    finite = evaluated.finite()
    reached = optimality(progress.trial, evaluated, box)
    accept = finite & (first | _improves(progress, evaluated, reached))
    y, model, found = choose(
        accept, (progress.trial, evaluated, reached), (progress.y, progress.model, progress.optimality)
    )
    curvature = jnp.maximum(progress.curvature, jnp.diagonal(model.gram, axis1=-2, axis2=-1))
    scale = _scale(box, curvature)

    damping, growth = _next_damping(progress, evaluated, accept)
    largest = jnp.max(scale**2 * curvature, axis=-1)
    damping = jnp.where(first, rules.initial_damping * largest, damping)
    # Below this floor rounding in the Gram matrix can make it indefinite.
    damping = jnp.maximum(damping, 1e3 * _EPSILON * largest)

    trial, predicted, reach = propose(y, model, box, scale, damping)

    # After progress the step to come is judged: where that is too small to matter it is not taken, which spares the last
    # evaluation. After a refusal, the refused one. Both before clipping: a step that the box cuts to nothing says only that
    # the damping is still too small.
    small_step = jnp.where(accept, reach, progress.reach) <= rules.rtol * _norm(y / scale) + rules.atol
    hopeless = jnp.abs(progress.predicted) <= 4 * _EPSILON * progress.model.cost
    unclipped = _norm((progress.trial - progress.y) / scale) >= 0.5 * progress.reach
    tiny = small_step | (hopeless & unclipped & ~accept & finite)
    # Refusals alone made this step tiny, far from any minimum: the model is wrong (a false derivative, a kink).
    forced = ~accept & (progress.damping > 1e-3 * largest) & (found > 1e-6)
    reason = either(tiny, either(small_step, Reason.step, Reason.rounding), Reason.running)
    reason = either(tiny & forced, Reason.stalled, reason)
    reason = either(found <= rules.gtol, Reason.gradient, reason)
    reason = either(first & ~finite, Reason.nonfinite, reason)
    return Progress(
        y=y,
        model=model,
        optimality=found,
        trial=trial,
        predicted=predicted,
        reach=reach,
        damping=damping,
        growth=growth,
        curvature=curvature,
        steps=progress.steps + 1,
        accepted=progress.accepted + jnp.where(accept, 1, 0),
        reason=reason,
    )


def propose(y: Flat, model: Model, box: Box, scale: Flat, damping: Number) -> tuple[Flat, Number, Number]:
    """The damped step on the unpinned unknowns, clipped to the box: next trial, predicted decrease of the cost, and the
    scaled length of the step before clipping.

    Solves (S J^T J S + damping I) z = -S J^T f with S = diag(scale) and y + S z as the unclipped trial. Unknowns that the
    step would carry through a bound are put on it and the rest solved again, once: without that, strongly coupled
    unknowns zigzag along a bound.
    """
    pinned = box.pinned(y, model.gradient)
    gram = scale[..., :, None] * model.gram * scale[..., None, :]
    identity = jnp.eye(y.shape[-1], dtype=bool).reshape((1,) * (y.ndim - 1) + (y.shape[-1],) * 2)

    def solve(fixed: Bool[Array, "*lanes p"], shift: Flat) -> Flat:
        rest = -scale * model.gradient - _times(gram, shift / scale)
        inside = ~fixed
        matrix = jnp.where(inside[..., :, None] & inside[..., None, :], gram, 0.0)
        matrix = matrix + jnp.where(identity, jnp.where(fixed, 1.0, damping[..., None])[..., None, :], 0.0)
        factor = jnp.linalg.cholesky(matrix, symmetrize_input=False)
        z = jsl.cho_solve((factor, True), jnp.where(fixed, 0.0, rest)[..., None])[..., 0]
        return jnp.where(fixed, shift, scale * z)

    def again(step: Flat) -> Flat:
        landed = box.clip(y + step)
        through = landed != y + step
        return solve(pinned | through, jnp.where(through, landed - y, 0.0))

    step = solve(pinned, jnp.zeros_like(y))
    reach = _norm(step / scale)
    # One test for all lanes: solving again changes nothing in a lane whose step stays inside.
    step = jax.lax.cond(jnp.any(box.clip(y + step) != y + step), again, lambda s: s, step)
    trial = box.clip(y + step)
    step = trial - y
    predicted = -jnp.sum(step * (model.gradient + 0.5 * _times(model.gram, step)), axis=-1)
    # A failed factorisation shows as NaN: stay, promise nothing, and let the damping grow.
    usable = jnp.isfinite(predicted)
    return choose(usable, (trial, predicted, reach), (y, jnp.zeros_like(predicted), jnp.full_like(reach, jnp.inf)))


def _improves(progress: Progress, evaluated: Model, reached: Number) -> Bool[Array, "*lanes"]:
    actual = progress.model.cost - evaluated.cost
    decreases = actual > 1e-4 * progress.predicted
    # Close to the solution the decrease drowns in the rounding of the cost; the gradient still tells up from down. (Tips at
    # 1 m that differ by 10 um lose five digits, hence the wide margin.)
    margin = 1e6 * _EPSILON * progress.model.cost
    blurred = (progress.predicted < margin) & (jnp.abs(actual) < margin)
    return (progress.predicted > 0) & jnp.where(blurred, reached < progress.optimality, decreases)


def _next_damping(progress: Progress, evaluated: Model, accept: Bool[Array, "*lanes"]) -> tuple[Number, Number]:
    # Nielsen's rule: shrink smoothly with the gain ratio, grow ever faster while steps are refused.
    promised = jnp.where(progress.predicted > 0, progress.predicted, 1.0)
    gain = jnp.where(accept, (progress.model.cost - evaluated.cost) / promised, 0.0)
    gain = jnp.where(jnp.isfinite(gain), gain, 0.0)
    shrink = jnp.clip(1.0 - (2.0 * gain - 1.0) ** 3, 0.1, 2.0)
    damping = progress.damping * jnp.where(accept, shrink, progress.growth)
    return damping, jnp.where(accept, 2.0, 2.0 * progress.growth)


def optimality(y: Flat, model: Model, box: Box) -> Number:
    """Largest projected coordinate step as a cosine: sqrt(h) |y - clip(y - g / h)| / |f|, with h = diag(J^T J).

    Away from bounds it is MINPACK's cosine between the residual and a column of J; it does not depend on units.
    """
    h = jnp.diagonal(model.gram, axis1=-2, axis2=-1)
    safe = jnp.where(h > 0, h, 1.0)
    moved = jnp.where(h > 0, jnp.sqrt(safe) * jnp.abs(y - box.clip(y - model.gradient / safe)), 0.0)
    return jnp.max(moved, axis=-1) / jnp.sqrt(2 * jnp.maximum(model.cost, jnp.finfo(jnp.float64).tiny))


def _times(matrix: Float[Array, "*lanes p p"], vector: Flat) -> Flat:
    return (matrix @ vector[..., None])[..., 0]


def _scale(box: Box, curvature: Flat) -> Flat:
    if box.scale is not None:
        return box.scale
    return jnp.where(curvature > 0, 1.0 / jnp.sqrt(jnp.where(curvature > 0, curvature, 1.0)), 1.0)


def _norm(vector: Flat) -> Number:
    return jnp.sqrt(jnp.sum(vector**2, axis=-1))
